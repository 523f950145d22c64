"""What a predicted motion of robot and object costs in all (RUMI, Eq 31)."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import Paths, PushRollouts
from rumi.planning.costs import InformationCost
from rumi.planning.reach_cost import ReachabilityCost
from sdf import skipped_work as savings
from sdf.voxel_grid import VoxelGrid


class TrajectoryCost:
    """Weighted sum of information and reachability cost, each left out where its weight is 0 (RUMI, Eq 31).

    Args:
        information: (X, Y, Z), nats.
        reachability: (X, Y, Z), in [0, 1]; needed where its weight is not 0.
        points_t: sensing points; x and y in the tool's frame, z in the world, or with `spatial` in its frame too.
        information_scale: beta_I.
        reachability_scale: beta_R.
        information_discount: factor by which information is worth less with each action until it is gathered.
        normalise: count information as a share of all there is.
        displaced_information: take the information to ride with the object (RUMI, Eq 29); False leaves the predicted
            displacement out of it (Eq 28), so that pushing the object along seems to gather what lies on the way.
        spatial: whether the tool moves in space.
    """

    def __init__(
        self,
        information: VoxelGrid,
        reachability: VoxelGrid | None,
        points_t: Float[Tensor, "M 3"],
        *,
        information_scale: float = 1.0,
        reachability_scale: float = 1.0,
        information_discount: float = 1.0,
        normalise: bool = True,
        displaced_information: bool = True,
        spatial: bool = False,
    ) -> None:
        self.information_scale, self.reachability_scale = information_scale, reachability_scale
        self.displaced_information = displaced_information
        self._information: InformationCost | None = None
        if information_scale > 0:
            self._information = InformationCost(
                information, points_t, spatial=spatial, discount=information_discount, normalise=normalise
            )
        self._reachability: ReachabilityCost | None = None
        if reachability_scale > 0:
            if reachability is None:
                raise ValueError(
                    "Expected reachability, one value a workspace point, since reachability_scale is "
                    f"{reachability_scale}, got None: give the map or set reachability_scale to 0"
                )
            self._reachability = ReachabilityCost(information, reachability)

    def __call__(self, rollouts: PushRollouts) -> Float[Tensor, "K"]:
        """Cost of each control sequence: the mean over its rollouts, of which the same ones are worked out once."""
        return mean_over_rollouts(rollouts, self._of_paths)

    def _of_paths(self, paths: Paths) -> Float[Tensor, "R"]:
        total = paths.configurations.new_zeros(len(paths.configurations))
        if self._information is not None:
            seen, moved = paths.riding() if self.displaced_information else paths.staying()
            total += self.information_scale * self._information(seen, moved)
        if self._reachability is not None:
            with savings.work("reachability_sums", alike=False) as work:
                moved = paths.displacements
                total += self.reachability_scale * self._reachability(moved, paths.turns, paths.pivot)
                work.count(moved[..., 0].numel(), moved[..., 0].numel() * self._reachability.points)
        return total


def mean_over_rollouts(rollouts: PushRollouts, of_paths: Callable[[Paths], Float[Tensor, "R"]]) -> Float[Tensor, "K"]:
    """Mean cost of each control sequence over its rollouts, of which the same ones are worked out once.

    Args:
        rollouts: of K sequences.
        of_paths: cost of R paths.
    """
    twin = rollouts.twin
    samples, count = twin.shape
    distinct = twin == torch.arange(count, device=twin.device)
    cost = rollouts.configurations.new_zeros(samples, count)
    with savings.work("rollouts_valued") as work:
        if savings.kept():
            work.count(int(distinct.sum()), distinct.numel())
        cost[distinct] = of_paths(rollouts.paths(distinct))
    return cost.gather(1, twin).mean(-1)
