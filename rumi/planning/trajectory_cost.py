"""What a predicted motion of robot and object costs in all (RUMI, Eq 31)."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import PushRollouts
from rumi.planning.costs import InformationCost
from rumi.planning.reach_cost import ReachabilityCost
from sdf import savings
from sdf.voxel_grid import VoxelGrid


def as_seen(
    configurations: Float[Tensor, "*b 3"],
    displacements: Float[Tensor, "*b 3"],
    turns: Float[Tensor, "*b"],
    pivot: Float[Tensor, "2"],
) -> Float[Tensor, "*b 3"]:
    """Configurations of the tool as they are to an object that has been moved, were it still at its old place."""
    cos, sin = turns.cos(), turns.sin()
    x, y = (configurations[..., :2] - pivot - displacements[..., :2]).unbind(-1)
    place = torch.stack((cos * x + sin * y, cos * y - sin * x), -1) + pivot
    return torch.cat((place, (configurations[..., 2] - turns)[..., None]), -1)


class TrajectoryCost:
    """Weighted sum of information and reachability cost, each left out where its weight is 0 (RUMI, Eq 31).

    Args:
        information: (X, Y, Z), nats.
        reachability: (X, Y, Z), in [0, 1]; needed where its weight is not 0.
        points_t: sensing points; x and y in the tool's frame, z in the world.
        information_scale: beta_I.
        reachability_scale: beta_R.
        information_discount: factor by which information is worth less with each action until it is gathered.
        normalise: count information as a share of all there is.
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
    ) -> None:
        self.information_scale, self.reachability_scale = information_scale, reachability_scale
        self._information: InformationCost | None = None
        if information_scale > 0:
            self._information = InformationCost(
                information, points_t, discount=information_discount, normalise=normalise
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
        twin = rollouts.twin
        samples, count = twin.shape
        distinct = twin == torch.arange(count, device=twin.device)
        paths, displacements = rollouts.configurations[:, :, 1:], rollouts.displacements[:, :, 1:]
        turns = None if rollouts.turns is None else rollouts.turns[:, :, 1:]
        cost = rollouts.configurations.new_zeros(samples, count)
        with savings.work("rollouts_valued") as work:
            if savings.kept():
                work.count(int(distinct.sum()), distinct.numel())
            cost[distinct] = self._of_paths(
                paths[distinct],
                displacements[distinct],
                None if turns is None else turns[distinct],
                rollouts.pivot,
            )
        return cost.gather(1, twin).mean(-1)

    def _of_paths(
        self,
        configurations: Float[Tensor, "R H 3"],
        displacements: Float[Tensor, "R H 3"],
        turns: Float[Tensor, "R H"] | None = None,
        pivot: Float[Tensor, "2"] | None = None,
    ) -> Float[Tensor, "R"]:
        total = configurations.new_zeros(len(configurations))
        if self._information is not None:
            if turns is None or pivot is None:
                gathered = self._information(configurations, displacements)
            else:
                # the information turns with the object: look from where it has not moved
                seen = as_seen(configurations, displacements, turns, pivot)
                gathered = self._information(seen, torch.zeros_like(displacements))
            total += self.information_scale * gathered
        if self._reachability is not None:
            with savings.work("reachability_sums", alike=False) as work:
                total += self.reachability_scale * self._reachability(displacements, turns, pivot)
                work.count(displacements[..., 0].numel(), displacements[..., 0].numel() * self._reachability.points)
        return total
