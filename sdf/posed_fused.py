"""One object at many poses as the arrays that the fused CPU kernels take."""

import math

import torch
from torch import Tensor

from sdf import se3
from sdf.base import SDFQuery
from sdf.grid_fused import Arrays, grid_arguments, layer_arguments
from sdf.grid_sdf import GridSDF
from sdf.posed_numba import distance, layer_distance, layer_query, query


def fused_distance(sdf: GridSDF, world_T_object: Tensor, points_w: Tensor, height: Tensor | None) -> Tensor:
    """Distances (*b, N, M) by kernels; `height` is that of all points in all object frames, if there is one."""
    shape, scene = _scene(world_T_object, points_w)
    result = points_w.new_empty(shape)
    kernel = distance if height is None else layer_distance
    kernel(*scene, *table_arguments(sdf, height, points_w.dtype), result.view(-1).numpy())
    return result


def fused_query(sdf: GridSDF, world_T_object: Tensor, points_w: Tensor, height: Tensor | None) -> SDFQuery:
    """The same with gradients (*b, N, M, 3) in the object frames."""
    shape, scene = _scene(world_T_object, points_w)
    value, gradient = points_w.new_empty(shape), points_w.new_empty(*shape, 3)
    kernel = query if height is None else layer_query
    kernel(
        *scene,
        *table_arguments(sdf, height, points_w.dtype),
        value.view(-1).numpy(),
        gradient.view(-1).numpy(),
    )
    return SDFQuery(value, gradient)


def table_arguments(sdf: GridSDF, height: Tensor | None, dtype: torch.dtype) -> Arrays:
    """What a kernel takes of the table: (values, numbers, sizes) or, at one height, (layer, rise, level, ...)."""
    flat, numbers, sizes = grid_arguments(sdf, dtype)
    return (flat, numbers, sizes) if height is None else (*layer_arguments(sdf, height, dtype), numbers, sizes)


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
