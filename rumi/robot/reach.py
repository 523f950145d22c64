"""Reachability: configurations that the arm reaches, and the reachability field r(x) of the workspace (RUMI, IV-H)."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rumi.errors import UsageError
from rumi.robot.reach_table import SECTOR_RAD, ReachSettings, ReachTable, reach_table
from sdf.check import check_shape
from sdf.so3 import wrap

HEIGHTS_M = (0.03, 0.115, 0.20)
"""Of the tables: the workspace's heights and the middle, between which the limits move by centimetres and evenly."""

YAWS_RAD = tuple(math.radians(angle) for angle in range(-60, 61, 15))
"""Orientations that `Reach.field` averages over, relative to the arm's forward direction."""


def reachability(
    position_error: Float[Tensor, "*b R"],
    rotation_error: Float[Tensor, "*b R"],
    rotation_scale: float = 0.1,
    largest_error: float = 0.4,
) -> Float[Tensor, "*b"]:
    """Reachability between 0 and 1 from the errors of R goal orientations (RUMI, Eq 30).

    Args:
        position_error: (*b, R), metres that inverse kinematics leaves.
        rotation_error: (*b, R), radians that it leaves.
        rotation_scale: metres that one radian counts as (alpha_R).
        largest_error: metres of mean error at which reachability is 0 (e_m).
    """
    mean = (position_error + rotation_scale * rotation_error).mean(-1)
    return (largest_error - mean).clamp_min(0.0) / largest_error


class Reach(nn.Module):
    """Residual of the arm's inverse kinematics for a level tool at (x, y, yaw).

    A lookup in a table over (distance from the base's axis, yaw relative to the radial direction); `solve_table`
    says why two axes are enough. Beyond the table and outside its sector errors grow by the way back to it.

    Args:
        table: errors at the nodes.
        settings: what the table was made with.
        base: (x, y, yaw) of the arm's base in the world, metres and radians.
    """

    def __init__(
        self,
        table: ReachTable,
        settings: ReachSettings | None = None,
        base: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        super().__init__()
        self.settings = settings or ReachSettings()
        self.register_buffer("position", table.position.to(torch.float32))
        self.register_buffer("rotation", table.rotation.to(torch.float32))
        self.register_buffer("base", torch.tensor(base, dtype=torch.float32))
        self.heights_m: tuple[float, ...] = ()
        self.position: Tensor
        self.rotation: Tensor
        self.base: Tensor

    @classmethod
    def of_arm(
        cls,
        base: tuple[float, float, float] = (0.0, 0.0, 0.0),
        settings: ReachSettings | None = None,
        *,
        cache_dir: Path | None = None,
    ) -> Self:
        """Solve the inverse kinematics (seconds) or take its table from `cache_dir`.

        Args:
            base: (x, y, yaw) of the arm's base in the world, metres and radians.
            settings: the arm and the table's size.
            cache_dir: folder to keep the table in; None keeps nothing.
        """
        settings = settings or ReachSettings()
        return cls(reach_table(settings, cache_dir=cache_dir), settings, base)

    def errors(self, q: Float[Tensor, "*b Q"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """Position error (m) and rotation error (rad) that remain at configurations (x, y, yaw)."""
        place, beyond = self._locate(q)
        position, rotation = _look_up(torch.stack((self.position, self.rotation)), place)
        return position + beyond, rotation

    @property
    def left(self) -> Float[Tensor, "*Z R Y"]:
        """Position error plus the metres that the rotation error counts as, at the table's nodes."""
        return self.position + self.settings.rotation_scale_m * self.rotation

    words = "of the arm"
    """What a run relies on."""

    _spatial = False

    @property
    def nodes(self) -> tuple[float, ...]:
        """Where the table's nodes are, for `tool_numba`: step of the radius, sector, lowest and highest."""
        return (self.settings.radius_step_m, SECTOR_RAD, *self.heights_m[:1], *self.heights_m[-1:])

    def residual(self, q: Float[Tensor, "*b Q"]) -> Float[Tensor, "*b"]:
        """Position error plus the metres that the rotation error counts as, which decides what is reachable."""
        place, beyond = self._locate(q)
        (left,) = _look_up(self.left[None], place)
        return left + beyond

    def reachable(self, q: Float[Tensor, "*b Q"]) -> Bool[Tensor, "*b"]:
        """Whether the arm gets there: the residual is within the tolerance."""
        return self.residual(q) <= self.settings.tolerance_m

    def relative(self, q: Float[Tensor, "*b Q"]) -> tuple[Tensor, Tensor, Tensor]:
        """Distance from the base's axis (m), angle from its forward direction, yaw relative to the radial one."""
        offset = q[..., :2] - self.base[:2]
        direction = torch.atan2(offset[..., 1], offset[..., 0])
        return offset.norm(dim=-1), wrap(direction - self.base[2]), wrap(q[..., -1] - direction)

    def field(self, points_w: Float[Tensor, "*b 3"], *, yaws: Sequence[float] = YAWS_RAD) -> Float[Tensor, "*b"]:
        """Reachability r(x) of points: the tool is sent there in each orientation (RUMI, Eq 30).

        The tool works at one height, so that z of the points plays no part.

        Args:
            points_w: (*b, 3), metres.
            yaws: orientations of the tool, radians from the arm's forward direction.
        """
        return reachability(*self.errors(self._oriented(points_w, yaws)), self.settings.rotation_scale_m)

    def _oriented(self, points_w: Tensor, yaws: Sequence[float]) -> Float[Tensor, "*b R Q"]:
        check_shape("points_w", points_w, "(*b, 3)", last=(3,))
        if len(yaws) == 0:
            raise ValueError("Expected yaws to hold at least one angle, got none")
        turns = self.base[2] + torch.tensor(tuple(yaws), dtype=points_w.dtype, device=points_w.device)
        axes = 3 if self._spatial else 2
        places = points_w[..., None, :axes].expand(*points_w.shape[:-1], len(turns), axes)
        return torch.cat((places, turns[:, None].expand(*places.shape[:-1], 1)), -1)

    def _locate(self, q: Tensor) -> tuple[Float[Tensor, "*b D"], Float[Tensor, "*b"]]:
        """Place of each configuration in the table, (yaw, radius) in [-1, 1], and metres beyond the table."""
        radius, direction, yaw = self.relative(q)
        last = (self.position.shape[0] - 1) * self.settings.radius_step_m
        place = torch.stack((yaw.abs() * (2.0 / math.pi) - 1.0, radius * (2.0 / last) - 1.0), -1)
        return place, self._beyond(radius, direction, last)

    def _beyond(self, radius: Tensor, direction: Tensor, last: float) -> Float[Tensor, "*b"]:
        """Metres beyond the table, whose last radius is `last`."""
        return (radius - last).clamp_min(0.0) + radius * (direction.abs() - SECTOR_RAD).clamp_min(0.0)


class SpatialReach(Reach):
    """`Reach` of a level tool at (x, y, z, yaw), linear in height between tables and constant beyond them.

    Args:
        tables: errors at the nodes, one table a height.
        heights_m: of the tables, evenly spaced, rising.
        settings: what the tables were made with (its height is not used).
        base: (x, y, yaw) of the arm's base in the world, metres and radians.
    """

    _spatial = True

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
        base_below_m: float = 0.0,
    ) -> Self:
        """Solve the inverse kinematics (seconds a height) or take its tables from `cache_dir`; see `Reach.of_arm`.

        Heights are above the world's floor, `base_below_m` below which the arm's base is.
        """
        settings = settings or ReachSettings()
        above = [replace(settings, height_m=height + base_below_m) for height in HEIGHTS_M]
        tables = [reach_table(one, cache_dir=cache_dir) for one in above]
        return cls(tables, HEIGHTS_M, settings, base)

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


def _look_up(tables: Float[Tensor, "C *nodes"], place: Float[Tensor, "*b D"]) -> tuple[Tensor, ...]:
    """Multilinear values of C tables of D axes, each (*b); beyond the last node the last node's."""
    axes = place.shape[-1]
    rows = place.reshape(*(1,) * axes, -1, axes)
    found = torch.nn.functional.grid_sample(
        tables[None].to(place), rows, mode="bilinear", padding_mode="border", align_corners=True
    )
    return tuple(channel.reshape(place.shape[:-1]) for channel in found.flatten(2)[0])
