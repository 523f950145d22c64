"""Table of the residuals of the arm's inverse kinematics, and its cache on disk."""

import json
import logging
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.robot.arm import Arm, ArmGeometry
from sdf import se3
from sdf.cache import content_key, keep_arrays, load_arrays

VERSION = 1
"""Of the table's contents: raise it when the same settings give other numbers."""

SECTOR_RAD = math.radians(80.0)
"""The table holds for goals within this angle of the arm's forward direction."""

# elbow up, wrist over, shoulder turned aside: together they find the best pose of every goal that was tried
STARTS = (
    (0.0, 0.6, 0.0, -1.2, 0.0, 1.0, 0.0),
    (-0.8, 1.4, -0.6, -0.1, -0.6, -0.9, -1.3),
    (0.1, -0.2, 0.1, 1.1, -0.2, -1.1, 2.0),
    (-0.1, -0.3, 0.2, 0.7, -0.6, 1.0, -0.5),
    (0.0, 0.6, 0.0, 1.2, 0.0, -1.0, 0.0),
    (0.0, 0.8, 0.0, -1.2, 1.5, 1.0, 0.0),
    (0.0, 0.8, 0.0, -1.2, -1.5, 1.0, 0.0),
)

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReachSettings:
    """Settings of the table of reach.

    Attributes:
        arm: the arm's geometry.
        height_m: height of the level tool above the arm's base.
        max_radius_m: largest distance of the tool from the base's axis in the table.
        radius_step_m: spacing of the table in radius.
        yaw_steps: intervals of the table between a tool that points away from the base and one that points at it.
        rotation_scale_m: metres that a radian of rotation error counts as, in the inverse kinematics and in what
            is reachable.
        tolerance_m: a configuration is reachable where its residual is at most this.
        coarse: every how many table nodes the inverse kinematics tries all its starts; the rest start from these.
    """

    arm: ArmGeometry = field(default_factory=ArmGeometry)
    height_m: float = 0.045
    max_radius_m: float = 1.4
    radius_step_m: float = 0.01
    yaw_steps: int = 60
    rotation_scale_m: float = 0.1
    tolerance_m: float = 0.005
    coarse: int = 4


class ReachTable(NamedTuple):
    """Errors that inverse kinematics leaves, over (radius, relative yaw from 0 to pi).

    Attributes:
        position: (R, Y), metres.
        rotation: (R, Y), radians.
    """

    position: Float[Tensor, "R Y"]
    rotation: Float[Tensor, "R Y"]


def reach_table(settings: ReachSettings, *, cache_dir: Path | None = None) -> ReachTable:
    """The table for an arm, from the cache if it is there.

    Args:
        settings: the arm and the table's size.
        cache_dir: folder to keep the table in; None keeps nothing.
    """
    if cache_dir is None:
        return solve_table(settings)
    path = Path(cache_dir) / f"reach-{_key(settings)}.npz"
    table = _load(path, settings)
    if table is None:
        table = solve_table(settings)
        keep_arrays(path, {key: value.numpy() for key, value in table._asdict().items()})
    return table


def table_shape(settings: ReachSettings) -> tuple[int, int]:
    """Nodes along radius and relative yaw."""
    return round(settings.max_radius_m / settings.radius_step_m) + 1, settings.yaw_steps + 1


def solve_table(settings: ReachSettings) -> ReachTable:
    """Inverse kinematics at every node of the table; takes seconds.

    Two symmetries leave a table of two axes for a planar tool (x, y, yaw). Joint 1 turns the whole arm about the
    base's vertical axis, so that errors depend on the distance from that axis and on the yaw relative to the radial
    direction, as long as joint 1 stays within its limits: it is held to its limit less `SECTOR_RAD` here, so that a
    solution can be turned to any goal in that sector. And the arm is its own mirror image (the mirror turns the
    joints about z the other way, and all limits are symmetric), so that only relative yaws from 0 to pi are needed.
    """
    arm = Arm(settings.arm.urdf())
    limits = arm.high.clone()
    limits[0] -= SECTOR_RAD
    radii, yaws = table_shape(settings)
    radius = torch.arange(radii, dtype=torch.float64) * settings.radius_step_m
    yaw = torch.arange(yaws, dtype=torch.float64) * (math.pi / settings.yaw_steps)
    grid = torch.stack(torch.meshgrid(radius, yaw, indexing="ij"), -1)
    goals = se3.from_planar(
        torch.stack((grid[..., 0], torch.zeros_like(grid[..., 0]), grid[..., 1]), -1), settings.height_m
    )
    _logger.info("solving the arm's reach: %d goals", radii * yaws)
    joints, position, rotation = _solve_coarse(arm, goals, limits, settings)
    _logger.info("solving the arm's reach: coarse nodes done, filling in")
    for rows, columns in _neighbour_starts(joints.shape[:2], (radii, yaws), settings.coarse):
        result = arm.solve(
            goals.reshape(-1, 4, 4),
            joints[rows, columns].reshape(-1, joints.shape[-1]),
            low=-limits,
            high=limits,
            rotation_scale_m=settings.rotation_scale_m,
            iterations=16,
        )
        found = torch.stack((result.position_error, result.rotation_error)).reshape(2, radii, yaws)
        better = _cost(found[0], found[1], settings) < _cost(position, rotation, settings)
        position, rotation = torch.where(better, found[0], position), torch.where(better, found[1], rotation)
    _logger.info("solving the arm's reach: done")
    return ReachTable(position, rotation)


def _cost(position: Tensor, rotation: Tensor, settings: ReachSettings) -> Tensor:
    return position.square() + (settings.rotation_scale_m * rotation).square()


def _coarse_nodes(count: int, stride: int) -> Tensor:
    nodes = torch.arange(0, count, stride)
    return nodes if int(nodes[-1]) == count - 1 else torch.cat((nodes, torch.tensor([count - 1])))


def _solve_coarse(
    arm: Arm, goals: Float[Tensor, "R Y 4 4"], limits: Float[Tensor, "J"], settings: ReachSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """Best joints at every coarse node, and errors on the full table (infinite where not yet solved)."""
    rows = _coarse_nodes(goals.shape[0], settings.coarse)
    columns = _coarse_nodes(goals.shape[1], settings.coarse)
    chosen = goals[rows][:, columns]
    flat = chosen.reshape(-1, 4, 4)
    starts = torch.tensor(STARTS, dtype=goals.dtype)
    result = arm.solve(
        flat.repeat(len(starts), 1, 1),
        starts.repeat_interleave(len(flat), 0),
        low=-limits,
        high=limits,
        rotation_scale_m=settings.rotation_scale_m,
    )
    errors = torch.stack((result.position_error, result.rotation_error)).reshape(2, len(starts), len(flat))
    best = _cost(errors[0], errors[1], settings).argmin(0)
    index = torch.arange(len(flat))
    joints = result.joints.reshape(len(starts), len(flat), -1)[best, index]
    full = torch.full((2, *goals.shape[:2]), torch.inf, dtype=goals.dtype)
    full[:, rows[:, None], columns] = errors[:, best, index].reshape(2, len(rows), len(columns))
    return joints.reshape(len(rows), len(columns), -1), full[0], full[1]


def _neighbour_starts(coarse: tuple[int, ...], fine: tuple[int, int], stride: int) -> list[tuple[Tensor, Tensor]]:
    """For every node the four coarse nodes about it: index pairs (R, Y)."""
    low = [torch.arange(count) // stride for count in fine]
    high = [(torch.arange(count) + stride - 1) // stride for count in fine]
    low, high = ([ends[axis].clamp_max(coarse[axis] - 1) for axis in range(2)] for ends in (low, high))
    return [
        (rows[:, None].expand(*fine), columns[None].expand(*fine))
        for rows in (low[0], high[0])
        for columns in (low[1], high[1])
    ]


def _key(settings: ReachSettings) -> str:
    content = {key: value for key, value in asdict(settings).items() if key != "tolerance_m"}
    text = json.dumps({"version": VERSION, "starts": STARTS, "sector": SECTOR_RAD, **content}, sort_keys=True)
    return content_key(text)


def _load(path: Path, settings: ReachSettings) -> ReachTable | None:
    arrays = load_arrays(path, ReachTable._fields)
    if arrays is None:
        return None
    for array in arrays.values():
        if array.shape != table_shape(settings) or array.dtype != np.float64 or not np.isfinite(array).all():
            _logger.warning("the reach table %s holds a table of shape %s: solving it again", path, array.shape)
            return None
    return ReachTable(*(torch.from_numpy(arrays[name]) for name in ReachTable._fields))
