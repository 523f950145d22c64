"""Poses and points as arrays, for the fused kernels over a tabulated SDF."""

from typing import NamedTuple, TypeGuard

import numpy as np
import torch
from torch import Tensor

from sdf import skipped_work as savings
from sdf.base import SDF
from sdf.grid_fused import Arrays, grid_arguments
from sdf.grid_fused import takes as grid_takes
from sdf.grid_sdf import GridSDF
from sensors.discrepancy import NormalEquations
from sensors.tiles import Tiles, steepness, tiles


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


def takes(sdf: SDF, frame_T_object: Tensor, points: Tensor) -> TypeGuard[GridSDF]:
    """Whether the fused versions can: a tabulated SDF, some poses and points, of the same scenes and one kind."""
    alike = frame_T_object.shape[:-3] == points.shape[:-2]
    return alike and points.numel() > 0 and frame_T_object.numel() > 0 and grid_takes(sdf, frame_T_object, points)


def prepare(sdf: GridSDF, frame_T_object: Tensor, points: Tensor, semantics: Tensor, valid: Tensor) -> Prepared:
    """Poses (*b, N, 4, 4) and points (*b, M, 3) with semantics (*b, M), of which the valid ones count."""
    dtype = frame_T_object.dtype
    poses = frame_T_object.detach().reshape(-1, *frame_T_object.shape[-3:]).contiguous().numpy()
    # a little more than it is, for its rounding
    slope = poses.dtype.type(steepness(sdf) * (1.0 + 1e-6))
    return Prepared(poses, tiles(points, semantics, valid, 0.5 * sdf.diagonal), grid_arguments(sdf, dtype), slope)


def discrepancy(ready: Prepared, frame_T_object: Tensor, free_scale: float, alpha: float) -> Tensor:
    """Discrepancy (*b, N) of each pose."""
    from sensors.discrepancy_numba import discrepancy as kernel

    kind = ready.poses.dtype.type
    result = torch.empty(frame_T_object.shape[:-2], dtype=frame_T_object.dtype)
    looked = np.empty(ready.poses.shape[:2], np.int64)
    with savings.work("observed_points") as work:
        kernel(*ready, kind(free_scale), kind(alpha), result.view(ready.poses.shape[:2]).numpy(), looked)
        work.count(float(looked.sum()), float(ready.scene.counts[:, :2].sum()) * len(ready.poses[0]))
    return result


def normal_equations(ready: Prepared, frame_T_object: Tensor, free_scale: float, alpha: float) -> NormalEquations:
    """Objective, gradient and Gauss-Newton Hessian of each pose."""
    from sensors.discrepancy_numba import normal_equations as kernel

    kind, flat = ready.poses.dtype.type, ready.poses.shape[:2]
    results = [
        torch.empty(*frame_T_object.shape[:-2], *size, dtype=frame_T_object.dtype) for size in ((), (6,), (6, 6))
    ]
    arrays = (result.view(*flat, *result.shape[frame_T_object.ndim - 2 :]).numpy() for result in results)
    kernel(*ready, kind(free_scale), kind(alpha), *arrays)
    return NormalEquations(*results)
