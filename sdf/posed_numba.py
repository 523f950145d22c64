"""The compiled CPU versions of distances at many poses; `posed.py` has the definition.

Results are (scenes, poses, points), flat. Poses come as the twelve numbers of object_T_world's upper rows, points by
coordinate, a row of them for each scene: row `which[scene]`.
"""

import math

import torch
from torch import Tensor

from sdf import se3
from sdf.base import SDFQuery
from sdf.batch import broadcast_shapes
from sdf.compiled import Kernel
from sdf.grid_numba import (
    Arrays,
    block,
    grid_arguments,
    lattice_of,
    layer_arguments,
    layer_value,
    layer_value_and_gradient,
    value,
    value_and_gradient,
)
from sdf.grid_sdf import GridSDF
from sdf.intrinsics_numba import at, put
from sdf.part_numba import indices

# points of one task: enough to be worth a thread's while
_STEP = 4096
# numbers that one vector instruction takes, where there are most
_LANES = 8


@block
def row(rows, scene, pose):
    """The twelve numbers of one pose."""
    m = rows[scene, pose]
    return m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], m[9], m[10], m[11]


@block
def placed(m, x, y, z):
    """A point in the object frame."""
    return (
        m[0] * x + m[1] * y + m[2] * z + m[3],
        m[4] * x + m[5] * y + m[6] * z + m[7],
        m[8] * x + m[9] * y + m[10] * z + m[11],
    )


@block
def placed_upright(m, x, y):
    """The same without its height, where the object is upright."""
    return m[0] * x + m[1] * y + m[3], m[4] * x + m[5] * y + m[7]


@block
def placed_from(planes, poses, j, x, y, z):
    """A point in the frame of object j, whose numbers lie one by one, `poses` apart."""
    return (
        at(planes, j) * x + at(planes, poses + j) * y + at(planes, 2 * poses + j) * z + at(planes, 3 * poses + j),
        at(planes, 4 * poses + j) * x
        + at(planes, 5 * poses + j) * y
        + at(planes, 6 * poses + j) * z
        + at(planes, 7 * poses + j),
        at(planes, 8 * poses + j) * x
        + at(planes, 9 * poses + j) * y
        + at(planes, 10 * poses + j) * z
        + at(planes, 11 * poses + j),
    )


@block
def placed_upright_from(planes, poses, j, x, y):
    """The same without its height, where the object is upright."""
    return (
        at(planes, j) * x + at(planes, poses + j) * y + at(planes, 3 * poses + j),
        at(planes, 4 * poses + j) * x + at(planes, 5 * poses + j) * y + at(planes, 7 * poses + j),
    )


def _look_up(rows, points, which, flat, rise, level, numbers, sizes, distance, gradient, part):
    """Distances, and gradients, of points at heights of their own, or at `level`, where one layer does.

    What belongs to a gradient or a level that is None numba compiles away.
    """
    lattice = lattice_of(numbers, sizes)
    if level is not None:  # read here: within the loop it would be read for each point
        height = (level[0], level[1])
    poses, count = rows.shape[1], points.shape[2]
    blocks = (count + _STEP - 1) // _STEP
    given = points.reshape(-1)
    for task in indices(part, rows.shape[0] * poses * blocks):
        owner, first = task // blocks, task % blocks * _STEP
        pose = row(rows, owner // poses, owner % poses)
        from_x = 3 * count * which[owner // poses]
        from_y, from_z, to = from_x + count, from_x + 2 * count, owner * count
        for i in range(first, min(first + _STEP, count)):
            x, y = at(given, from_x + i), at(given, from_y + i)
            if level is None:
                x_o, y_o, z_o = placed(pose, x, y, at(given, from_z + i))
            else:
                x_o, y_o = placed_upright(pose, x, y)
            if gradient is None:
                if level is None:
                    found = value(x_o, y_o, z_o, flat, lattice)
                else:
                    found = layer_value(x_o, y_o, flat, lattice, height)
                put(distance, to + i, found)
            else:
                if level is None:
                    found, along_x, along_y, along_z = value_and_gradient(x_o, y_o, z_o, flat, lattice)
                else:
                    found, along_x, along_y, along_z = layer_value_and_gradient(x_o, y_o, flat, rise, lattice, height)
                put(distance, to + i, found)
                put(gradient, 3 * (to + i), along_x)
                put(gradient, 3 * (to + i) + 1, along_y)
                put(gradient, 3 * (to + i) + 2, along_z)


_LOOK_UP = Kernel(_look_up, fast=True)


def posed_distance(sdf: GridSDF, world_T_object: Tensor, points_w: Tensor, height: Tensor | None) -> Tensor:
    """Distances (*b, N, M) by kernels; `height` is that of all points in all object frames, if there is one."""
    shape, scene = _scene(world_T_object, points_w)
    upright, (flat, rise, level, *table) = table_arguments(sdf, height, points_w.dtype)
    result = points_w.new_empty(shape)
    _LOOK_UP(*scene, flat, rise, level if upright else None, *table, result.view(-1).numpy(), None)
    return result


def posed_query(sdf: GridSDF, world_T_object: Tensor, points_w: Tensor, height: Tensor | None) -> SDFQuery:
    """The same with gradients (*b, N, M, 3) in the object frames."""
    shape, scene = _scene(world_T_object, points_w)
    upright, (flat, rise, level, *table) = table_arguments(sdf, height, points_w.dtype)
    value, gradient = points_w.new_empty(shape), points_w.new_empty(*shape, 3)
    found = value.view(-1).numpy(), gradient.view(-1).numpy()
    _LOOK_UP(*scene, flat, rise, level if upright else None, *table, *found)
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
    batch = broadcast_shapes(world_T_object.shape[:-3], given)
    poses, count = world_T_object.shape[-3], points_w.shape[-2]
    rows = se3.inverse(world_T_object.detach())[..., :3, :].expand(*batch, poses, 3, 4)
    places = points_w.detach().mT.reshape(-1, 3, count) if points_w.numel() else points_w.new_empty(0, 3, count)
    which = torch.arange(math.prod(given)).view(given).expand(batch).reshape(-1)
    scenes = math.prod(batch)
    arrays = (rows.reshape(scenes, poses, 12).contiguous(), places.contiguous(), which.contiguous())
    return torch.Size((*batch, poses, count)), tuple(array.numpy() for array in arrays)
