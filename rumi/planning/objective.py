"""Objective of a policy: cost of predicted motions (RUMI, Eq 31), and the information that each action gathers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import Paths, PushRollouts
from rumi.dynamics.tool_lookup import world_height
from rumi.planning.costs import InformationCost
from rumi.planning.reach_cost import ReachabilityCost
from rumi.robot.tool import Tool
from sdf import backend, gpu, skipped_work
from sdf.containers import index
from sdf.voxel_grid import VoxelGrid

Gathered = Callable[[Float[Tensor, "R H Q"], Float[Tensor, "R H 3"]], Float[Tensor, "R"]]
"""What whole paths gather, from the configurations after each action and the object's displacements by then."""


@dataclass(frozen=True)
class Objective:
    """Objective of a policy under one belief: the cost of motions, and the information that each action gathers.

    Attributes:
        cost: of each control sequence (K,), from its rollouts.
        gathered: what a path gathers in all; never less for a longer path.
        maps: fields on the workspace lattice that the cost rests on, for figures.
        info: plain values to keep with the plan.
        skipped: costs that were left out, as 1, by name.
    """

    cost: Callable[[PushRollouts], Float[Tensor, "K"]]
    gathered: Gathered
    maps: dict[str, Tensor] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    skipped: dict[str, float] = field(default_factory=dict)


class TrajectoryCost:
    """Weighted sum of information and reachability cost, each left out where its weight is 0 (RUMI, Eq 31).

    Args:
        information: (X, Y, Z), nats.
        reachability: (X, Y, Z), in [0, 1]; needed where its weight is not 0.
        points_t: sensing points; x and y in the tool's frame, z in the world, or with `spatial` in its frame too.
        information_scale: beta_I.
        reachability_scale: beta_R.
        push_scale: weight of the way that the object is pushed, for each metre.
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
        push_scale: float = 0.0,
        information_discount: float = 1.0,
        normalise: bool = True,
        displaced_information: bool = True,
        spatial: bool = False,
    ) -> None:
        self.information_scale, self.reachability_scale = information_scale, reachability_scale
        self.push_scale, self.discount = push_scale, information_discount
        self.displaced_information, self.values = displaced_information, information.values
        self.information: InformationCost | None = None
        if information_scale > 0:
            self.information = InformationCost(
                information, points_t, spatial=spatial, discount=information_discount, normalise=normalise
            )
        self.reachability: ReachabilityCost | None = None
        if reachability_scale > 0:
            if reachability is None:
                raise ValueError(
                    "Expected reachability, one value a workspace point, since reachability_scale is "
                    f"{reachability_scale}, got None: give the map or set reachability_scale to 0"
                )
            self.reachability = ReachabilityCost(information, reachability)

    def __call__(self, rollouts: PushRollouts) -> Float[Tensor, "K"]:
        """Cost of each control sequence: the mean over its rollouts."""
        version = backend.dispatch("trajectory_cost", self.values, rollouts.configurations, rollouts.displacements)
        costs: Tensor = version(self, rollouts)
        return costs + self.push_scale * pushed_way(rollouts, self.discount) if self.push_scale > 0 else costs

    def of_paths(self, paths: Paths) -> Float[Tensor, "R"]:
        """Cost of single paths."""
        total = paths.configurations.new_zeros(len(paths.configurations))
        if self.information is not None:
            ridden = paths if self.displaced_information else Paths(*paths.object_fixed())
            total += self.information_scale * self.information(*ridden)
        if self.reachability is not None:
            with skipped_work.work("reachability_sums", alike=False) as work:
                moved = paths.displacements
                total += self.reachability_scale * self.reachability(moved, paths.turns, paths.pivot)
                work.count(moved[..., 0].numel(), moved[..., 0].numel() * self.reachability.points)
        return total


@backend.register("trajectory_cost")
def _trajectory_cost(cost: TrajectoryCost, rollouts: PushRollouts) -> Float[Tensor, "K"]:
    """Cost of each control sequence, of whose rollouts the same ones are worked out once."""
    return mean_over_rollouts(rollouts, cost.of_paths)


@backend.register("trajectory_cost", gpu.VERSION, gpu.supports, gpu.suits)
def _trajectory_cost_warp(cost: TrajectoryCost, rollouts: PushRollouts) -> Float[Tensor, "K"]:
    if rollouts.pivot is not None and rollouts.pivot.ndim > 1:  # of several scenes
        return _trajectory_cost(cost, rollouts)
    from rumi.planning.trajectory_cost_warp import trajectory_cost

    return trajectory_cost(cost, rollouts)


def pushed_way(rollouts: PushRollouts, discount: float = 1.0) -> Float[Tensor, "*b K"]:
    """How far each control sequence pushes the object in the mean over its rollouts, there and back, metres.

    Args:
        rollouts: of K sequences.
        discount: factor by which an action's way counts less with each action before it.
    """
    ways = torch.diff(rollouts.displacements, dim=-2).norm(dim=-1).mean(-2)
    return ways @ (discount ** torch.arange(ways.shape[-1], device=ways.device)).to(ways)


def mean_over_rollouts(
    rollouts: PushRollouts, of_paths: Callable[[Paths], Float[Tensor, "R"]]
) -> Float[Tensor, "*b K"]:
    """Mean cost of each control sequence over its rollouts, of which the same ones are worked out once.

    Args:
        rollouts: of K sequences.
        of_paths: cost of R paths.
    """
    duplicate_of = rollouts.duplicate_of
    distinct = duplicate_of == torch.arange(duplicate_of.shape[-1], device=duplicate_of.device)
    cost = rollouts.configurations.new_zeros(duplicate_of.shape)
    with skipped_work.work("rollouts_valued") as work:
        if skipped_work.kept():
            work.count(int(distinct.sum()), distinct.numel())
        cost[distinct] = of_paths(rollouts.paths(distinct))
    return cost.gather(-1, duplicate_of).mean(-1)


def cost_of_scenes(
    costs: Sequence[Callable[[PushRollouts], Float[Tensor, "K"]]], rollouts: PushRollouts
) -> Float[Tensor, "B K"]:
    """Costs of a batch of scenes, each by its own cost alone, so that a row is what the scene gives, to the bit.

    An object that never turns, beside one that may, is taken to turn by 0, which rounds otherwise. One after the other:
    sums of reach and cells of information are a scene's own, and take their time there.

    Args:
        costs: of each scene, such as a `TrajectoryCost`.
        rollouts: with the scenes' axis in front.

    Raises:
        ValueError: there are not as many costs as scenes.
    """
    if len(costs) != len(rollouts.configurations):
        raise ValueError(f"Expected a cost for each of {len(rollouts.configurations)} scenes, got {len(costs)}")
    return torch.stack([cost(index(rollouts, scene)) for scene, cost in enumerate(costs)])


def without(field: VoxelGrid, points: Float[Tensor, "M 3"]) -> VoxelGrid:
    """A field with zero in the cells of points."""
    index, inside = field.nearest_index(points)
    x, y, z = index[inside].unbind(-1)
    return field.with_values(field.values.index_put((x, y, z), field.values.new_zeros(())))


def sensing_points(tool: Tool, like: Tensor) -> Float[Tensor, "M 3"]:
    """Points by which a tool senses, at the heights that they have in the world while it keeps to its plane."""
    return world_height(tool.info, tool.height_m).to(like)


def gathering(field: VoxelGrid, tool: Tool, sensing: Float[Tensor, "M 3"] | None = None) -> InformationCost:
    """Minus what a tool's sensing points meet of a field along a path, each cell once."""
    points = sensing_points(tool, field.values) if sensing is None else sensing
    return InformationCost(field, points, spatial=tool.spatial)


def gathered_by_action(gathered: Gathered, rollout: PushRollouts) -> Float[Tensor, "H"]:
    """What each action of one rollout (K = M = 1) gathers that those before it did not."""
    configurations, displacements = rollout.first.in_object_frame()
    steps = torch.arange(len(configurations), device=configurations.device)
    # path h stands still after action h: standing still meets nothing new
    until = torch.minimum(steps[:, None], steps[None])
    total = gathered(configurations[until], displacements[until])
    return torch.diff(total, prepend=total.new_zeros(1)).clamp_min(0.0)
