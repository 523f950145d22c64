"""Where the arm can take a tool that moves in space: tables of reach at several heights."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.reach import Reach
from rumi.robot.reach_table import ReachSettings, ReachTable, reach_table
from sdf.check import check_shape

HEIGHTS_M = (0.03, 0.115, 0.20)
"""Of the tables: the workspace's heights and the middle, between which the limits move by centimetres and evenly."""


class SpatialReach(Reach):
    """`Reach` of a level tool at (x, y, z, yaw), linear in height between tables and constant beyond them.

    Args:
        tables: errors at the nodes, one table a height.
        heights_m: of the tables, evenly spaced, rising.
        settings: what the tables were made with (its height is not used).
        base: (x, y, yaw) of the arm's base in the world, metres and radians.
    """

    def __init__(
        self,
        tables: Sequence[ReachTable],
        heights_m: Sequence[float],
        settings: ReachSettings | None = None,
        base: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        steps = [b - a for a, b in itertools.pairwise(heights_m)]
        if not steps or len(tables) != len(heights_m) or min(steps) <= 0 or max(steps) - min(steps) > 1e-9:
            raise UsageError(
                f"Expected a table for each of two or more heights that rise evenly, got {len(tables)} tables for "
                f"{tuple(heights_m)}"
            )
        stack = ReachTable(*(torch.stack([getattr(table, name) for table in tables]) for name in ReachTable._fields))
        super().__init__(stack, settings, base)
        self.heights_m = tuple(map(float, heights_m))

    @classmethod
    def of_arm(
        cls,
        base: tuple[float, float, float] = (0.0, 0.0, 0.0),
        settings: ReachSettings | None = None,
        *,
        cache_dir: Path | None = None,
        heights_m: Sequence[float] = HEIGHTS_M,
        base_below_m: float = 0.0,
    ) -> Self:
        """Solve the inverse kinematics (seconds a height) or take its tables from `cache_dir`; see `Reach.of_arm`.

        Heights are above the world's floor, `base_below_m` below which the arm's base is.
        """
        settings = settings or ReachSettings()
        above = [replace(settings, height_m=height + base_below_m) for height in heights_m]
        tables = [reach_table(one, cache_dir=cache_dir) for one in above]
        return cls(tables, heights_m, settings, base)

    def _oriented(self, points_w: Tensor, yaws: Sequence[float]) -> Float[Tensor, "*b R Q"]:
        check_shape("points_w", points_w, "(*b, 3)", last=(3,))
        if len(yaws) == 0:
            raise ValueError("Expected yaws to hold at least one angle, got none")
        turns = self.base[2] + torch.tensor(tuple(yaws), dtype=points_w.dtype, device=points_w.device)
        places = points_w[..., None, :].expand(*points_w.shape[:-1], len(turns), 3)
        return torch.cat((places, turns[:, None].expand(*places.shape[:-1], 1)), -1)

    def _locate(self, q: Tensor) -> tuple[Float[Tensor, "*b D"], Float[Tensor, "*b"]]:
        radius, direction, yaw = self.relative(q)
        last = (self.position.shape[1] - 1) * self.settings.radius_step_m
        low, high = self.heights_m[0], self.heights_m[-1]
        place = (
            yaw.abs() * (2.0 / math.pi) - 1.0,
            radius * (2.0 / last) - 1.0,
            (q[..., 2] - low) * (2.0 / (high - low)) - 1.0,
        )
        return torch.stack(place, -1), self._beyond(radius, direction, last)
