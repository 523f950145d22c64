"""What a policy makes of predicted motions: their cost, and what each of their actions would gather."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import PushRollouts
from rumi.dynamics.tool_lookup import world_height
from rumi.planning.costs import InformationCost
from rumi.robot.tool import Tool
from sdf.voxel_grid import VoxelGrid

Gathered = Callable[[Float[Tensor, "R H Q"], Float[Tensor, "R H 3"]], Float[Tensor, "R"]]
"""What whole paths gather, from the configurations after each action and the object's displacements by then."""


@dataclass(frozen=True)
class Worth:
    """One belief's view of all motions.

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


def gathering(field: VoxelGrid, tool: Tool) -> InformationCost:
    """Minus what a tool's sensing points meet of a field along a path, each cell once."""
    sensing = world_height(tool.info, tool.height_m).to(field.values)
    return InformationCost(field, sensing, spatial=tool.spatial)


def gathered_by_action(gathered: Gathered, rollout: PushRollouts) -> Float[Tensor, "H"]:
    """What each action of one rollout (K = M = 1) gathers that those before it did not."""
    configurations, displacements = (x[0] for x in rollout.paths(torch.ones_like(rollout.touched)).riding())
    steps = torch.arange(len(configurations), device=configurations.device)
    # path h stands still after action h: standing still meets nothing new
    until = torch.minimum(steps[:, None], steps[None])
    total = gathered(configurations[until], displacements[until])
    return torch.diff(total, prepend=total.new_zeros(1)).clamp_min(0.0)
