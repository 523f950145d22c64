"""One object at many poses as the arrays that the fused CPU kernels take."""

import math

import torch
from torch import Tensor

from sdf import se3
from sdf.base import SDFQuery
from sdf.grid_fused import Arrays, grid_arguments, layer_arguments
from sdf.grid_sdf import GridSDF
from sdf.posed_numba import distance, layer_distance, layer_query, query

# numbers that one vector instruction takes, where there are most
_LANES = 8


def fused_distance(sdf: GridSDF, world_T_object: Tensor, points_w: Tensor, height: Tensor | None) -> Tensor:
    """Distances (*b, N, M) by kernels; `height` is that of all points in all object frames, if there is one."""
    shape, scene = _scene(world_T_object, points_w)
    upright, table = table_arguments(sdf, height, points_w.dtype)
    result = points_w.new_empty(shape)
    (layer_distance if upright else distance)(*scene, *table, result.view(-1).numpy())
    return result


def fused_query(sdf: GridSDF, world_T_object: Tensor, points_w: Tensor, height: Tensor | None) -> SDFQuery:
    """The same with gradients (*b, N, M, 3) in the object frames."""
    shape, scene = _scene(world_T_object, points_w)
    upright, table = table_arguments(sdf, height, points_w.dtype)
    value, gradient = points_w.new_empty(shape), points_w.new_empty(*shape, 3)
    (layer_query if upright else query)(*scene, *table, value.view(-1).numpy(), gradient.view(-1).numpy())
    return SDFQuery(value, gradient)


def table_arguments(sdf: GridSDF, height: Tensor | None, dtype: torch.dtype) -> tuple[bool, Arrays]:
    """What a kernel takes of the table: whether one layer does, values, slopes, level, numbers and sizes.

    Without a common height, all values, no slopes, and a level that is not looked at.
    """
    flat, numbers, sizes = grid_arguments(sdf, dtype)
    if height is None:
        return False, (flat, flat[:0], numbers[:2], numbers, sizes)
    return True, (*layer_arguments(sdf, height, dtype), numbers, sizes)


def pose_planes(world_T_object: Tensor, *more: Tensor) -> tuple[Tensor, ...]:
    """Poses (*b, N, 4, 4) for a loop over them: (scenes, 12, N'), the twelve numbers of object_T_world one by one.

    N' is N up to a whole number of vector instructions: the last pose is repeated, and what stands in `more`,
    (*b, c, N), is filled up with 0 to (scenes, c, N').
    """
    scenes, poses = math.prod(world_T_object.shape[:-3]), world_T_object.shape[-3]
    rows = se3.inverse(world_T_object.detach())[..., :3, :].reshape(scenes, poses, 12).mT
    spare = -poses % _LANES
    parts = [part.detach().reshape(scenes, part.shape[-2], poses) for part in more]
    if spare and poses:
        rows = torch.cat((rows, rows[..., -1:].expand(-1, -1, spare)), -1)
        parts = [torch.nn.functional.pad(part, (0, spare)) for part in parts]
    return tuple(part.contiguous() for part in (rows, *parts))


def _scene(world_T_object: Tensor, points_w: Tensor) -> tuple[torch.Size, Arrays]:
    """Shape of the result, and poses (scenes, N, 12), points (rows, 3, M) and the row of each scene."""
    given = points_w.shape[:-2]
    batch = torch.broadcast_shapes(world_T_object.shape[:-3], given)
    poses, count = world_T_object.shape[-3], points_w.shape[-2]
    rows = se3.inverse(world_T_object.detach())[..., :3, :].expand(*batch, poses, 3, 4)
    places = points_w.detach().mT.reshape(-1, 3, count) if points_w.numel() else points_w.new_empty(0, 3, count)
    which = torch.arange(math.prod(given)).view(given).expand(batch).reshape(-1)
    scenes = math.prod(batch)
    arrays = (rows.reshape(scenes, poses, 12).contiguous(), places.contiguous(), which.contiguous())
    return torch.Size((*batch, poses, count)), tuple(array.numpy() for array in arrays)
