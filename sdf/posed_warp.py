"""The versions for a GPU of distances at many poses, a thread a pair; `posed.py` has the definition."""

import math
from typing import Any

import torch
from torch import Tensor

from sdf import gpu, se3
from sdf.base import SDFQuery
from sdf.batch import broadcast_shapes
from sdf.grid_sdf import GridSDF
from sdf.grid_warp import LATTICE, grid_arguments, placed, value, value_and_gradient

wp = gpu.warp()


@gpu.Kernel
def _distance(
    transforms: wp.array3d(dtype=Any),
    points: wp.array3d(dtype=Any),
    flat: wp.array(dtype=Any),
    numbers: gpu.Numbers(LATTICE),
    distance: wp.array3d(dtype=Any),
):
    scene, pose, point = wp.tid()
    row = scene * distance.shape[1] + pose
    p = placed(transforms, row, points[scene, point, 0], points[scene, point, 1], points[scene, point, 2])
    distance[scene, pose, point] = value(p[0], p[1], p[2], flat, numbers)


@gpu.Kernel
def _query(
    transforms: wp.array3d(dtype=Any),
    points: wp.array3d(dtype=Any),
    flat: wp.array(dtype=Any),
    numbers: gpu.Numbers(LATTICE),
    distance: wp.array3d(dtype=Any),
    gradient: wp.array4d(dtype=Any),
):
    scene, pose, point = wp.tid()
    row = scene * distance.shape[1] + pose
    p = placed(transforms, row, points[scene, point, 0], points[scene, point, 1], points[scene, point, 2])
    found = value_and_gradient(p[0], p[1], p[2], flat, numbers)
    distance[scene, pose, point] = found[0]
    for axis in range(3):
        gradient[scene, pose, point, axis] = found[axis + 1]


def posed_distance(sdf: GridSDF, world_T_object: Tensor, points_w: Tensor) -> Tensor:
    """Signed distances (..., N, M)."""
    batch, transforms, points = _flat(world_T_object, points_w)
    shape = (len(points), world_T_object.shape[-3], points_w.shape[-2])
    distance = points.new_empty(shape)
    _distance.launch(shape, transforms, points, *grid_arguments(sdf, points.dtype), distance)
    return distance.view(*batch, *shape[1:])


def posed_query(sdf: GridSDF, world_T_object: Tensor, points_w: Tensor) -> SDFQuery:
    """Signed distances (..., N, M) and gradients (..., N, M, 3)."""
    batch, transforms, points = _flat(world_T_object, points_w)
    shape = (len(points), world_T_object.shape[-3], points_w.shape[-2])
    distance, gradient = points.new_empty(shape), points.new_empty(*shape, 3)
    _query.launch(shape, transforms, points, *grid_arguments(sdf, points.dtype), distance, gradient)
    return SDFQuery(distance.view(*batch, *shape[1:]), gradient.view(*batch, *shape[1:], 3))


def _flat(world_T_object: Tensor, points_w: Tensor) -> tuple[torch.Size, Tensor, Tensor]:
    """Batch axes, transforms object_T_world (scenes * N, 4, 4), and points (scenes, M, 3)."""
    batch = torch.Size(broadcast_shapes(world_T_object.shape[:-3], points_w.shape[:-2]))
    poses, count, scenes = world_T_object.shape[-3], points_w.shape[-2], math.prod(batch)
    transforms = se3.inverse(world_T_object.detach()).expand(*batch, poses, 4, 4).reshape(scenes * poses, 4, 4)
    return batch, transforms, points_w.detach().expand(*batch, count, 3).reshape(scenes, count, 3)
