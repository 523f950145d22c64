"""The compiled CPU version of the discrepancy over a tabulated SDF; `discrepancy.py` has the definition."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sdf import skipped_work
from sdf.compiled import Kernel
from sdf.grid_numba import Arrays, block, fast, grid_arguments, lattice_of, value
from sdf.grid_sdf import GridSDF
from sdf.intrinsics_numba import at
from sdf.part_numba import indices
from sensors.tiles import Tiles, steepness, tiles
from sensors.tiles_numba import WHOLE, local, near_points


class Prepared(NamedTuple):
    """What every kernel takes in front of its own arguments.

    Attributes:
        poses: (B, N, 4, 4).
        scene: the points of B scenes.
        grid: the table.
        steepness: its greatest slope.
    """

    poses: np.ndarray
    scene: Tiles
    grid: Arrays
    steepness: np.floating


@block
def placed(pose):
    """The twelve numbers of a pose (3 or 4, 4): its rotation row by row, then its origin."""
    return (
        pose[0, 0],
        pose[0, 1],
        pose[0, 2],
        pose[1, 0],
        pose[1, 1],
        pose[1, 2],
        pose[2, 0],
        pose[2, 1],
        pose[2, 2],
        pose[0, 3],
        pose[1, 3],
        pose[2, 3],
    )


@fast
def _surface_cost(points, count, pose, flat, lattice):
    total = flat.dtype.type(0.0)
    room, given = points.shape[1], points.reshape(-1)
    for m in range(count):
        x, y, z = local(at(given, m), at(given, room + m), at(given, 2 * room + m), pose)
        total += abs(value(x, y, z, flat, lattice))
    return total


@fast
def _hinge_cost(points, count, pose, flat, lattice, alpha):
    total = zero = flat.dtype.type(0.0)
    room, given = points.shape[1], points.reshape(-1)
    for m in range(count):
        x, y, z = local(at(given, m), at(given, room + m), at(given, 2 * room + m), pose)
        short = alpha - at(given, 3 * room + m) * value(x, y, z, flat, lattice)
        total += short if short > zero else zero
    return total


def _discrepancy(poses, scene, grid, steepness, free_scale, alpha, result, looked, part):
    surface, hinged, signs, small_first, small_balls, large_first, large_balls, counts = scene
    flat, numbers, sizes = grid
    batch, each = result.shape
    for row in indices(part, batch * each):
        b, n = row // each, row % each
        lattice = lattice_of(numbers, sizes)
        pose = placed(poses[b, n])
        own = (hinged[b], signs[b], small_first[b], small_balls[b], large_first[b], large_balls[b], counts[b])
        near, count = near_points(own, pose, flat, lattice, steepness, alpha, WHOLE)
        looked[b, n] = count + counts[b, 0]
        hinge = _hinge_cost(near, count, pose, flat, lattice, alpha)
        result[b, n] = free_scale * hinge + _surface_cost(surface[b], counts[b, 0], pose, flat, lattice)


_DISCREPANCY = Kernel(_discrepancy)


def prepare(sdf: GridSDF, frame_T_object: Tensor, points: Tensor, semantics: Tensor, valid: Tensor) -> Prepared:
    """Poses (*b, N, 4, 4) and points (*b, M, 3) with semantics (*b, M), of which the valid ones count."""
    dtype = frame_T_object.dtype
    poses = frame_T_object.detach().reshape(-1, *frame_T_object.shape[-3:]).contiguous().numpy()
    # a little more than it is, for its rounding
    slope = poses.dtype.type(steepness(sdf) * (1.0 + 1e-6))
    return Prepared(poses, tiles(points, semantics, valid, 0.5 * sdf.diagonal), grid_arguments(sdf, dtype), slope)


def discrepancy(ready: Prepared, frame_T_object: Tensor, free_scale: float, alpha: float) -> Tensor:
    """Discrepancy (*b, N) of each pose."""
    kind = ready.poses.dtype.type
    result = torch.empty(frame_T_object.shape[:-2], dtype=frame_T_object.dtype)
    looked = np.empty(ready.poses.shape[:2], np.int64)
    with skipped_work.work("observed_points") as work:
        _DISCREPANCY(*ready, kind(free_scale), kind(alpha), result.view(ready.poses.shape[:2]).numpy(), looked)
        work.count(float(looked.sum()), float(ready.scene.counts[:, :2].sum()) * len(ready.poses[0]))
    return result
