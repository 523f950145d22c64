"""The compiled CPU version of the expected normal; `normal.py` has the definition."""

import math

from sdf.compiled import Kernel
from sdf.grid_numba import lattice_of, layer_value_and_gradient, value_and_gradient
from sdf.intrinsics_numba import at
from sdf.part_numba import indices
from sdf.posed import common_height
from sdf.posed_numba import placed_from, placed_upright_from, pose_planes, table_arguments


def _normal(chosen, points, rows, turned, upright, flat, rise, level, numbers, sizes, result, part):
    lattice, height = lattice_of(numbers, sizes), (level[0], level[1])
    count, poses = len(points), rows.shape[2]
    none = type(numbers[0])(0.0)
    for number in indices(part, len(chosen)):
        scene, point = chosen[number] // count, chosen[number] % count
        m, t = rows[scene].reshape(-1), turned[scene].reshape(-1)
        x, y, z = points[point, 0], points[point, 1], points[point, 2]
        along_x, along_y, along_z = none, none, none
        if upright:
            for j in range(poses):
                x_o, y_o = placed_upright_from(m, poses, j, x, y)
                _, a, b, c = layer_value_and_gradient(x_o, y_o, flat, rise, lattice, height)
                along_x += at(t, j) * a + at(t, poses + j) * b
                along_y += at(t, 3 * poses + j) * a + at(t, 4 * poses + j) * b
                along_z += at(t, 8 * poses + j) * c
        else:
            for j in range(poses):
                x_o, y_o, z_o = placed_from(m, poses, j, x, y, z)
                _, a, b, c = value_and_gradient(x_o, y_o, z_o, flat, lattice)
                along_x += at(t, j) * a + at(t, poses + j) * b + at(t, 2 * poses + j) * c
                along_y += at(t, 3 * poses + j) * a + at(t, 4 * poses + j) * b + at(t, 5 * poses + j) * c
                along_z += at(t, 6 * poses + j) * a + at(t, 7 * poses + j) * b + at(t, 8 * poses + j) * c
        result[scene, point, 0] = along_x
        result[scene, point, 1] = along_y
        result[scene, point, 2] = along_z


normal = Kernel(_normal, fast=True)


def expected_normal(sdf, world_T_object, log_weights, points_w, where):
    """One pass over the poses for each point of `where`, 0 elsewhere."""
    batch, poses, count = world_T_object.shape[:-3], world_T_object.shape[-3], len(points_w)
    turned = log_weights.exp()[..., None, None] * world_T_object[..., :3, :3]
    rows, turned = pose_planes(world_T_object, turned.expand(*batch, poses, 3, 3).reshape(*batch, poses, 9).mT)
    upright, table = table_arguments(sdf, common_height(sdf, world_T_object, points_w), points_w.dtype)
    result = points_w.new_zeros(*batch, count, 3)
    normal(
        where.expand(*batch, count).reshape(-1).nonzero()[:, 0].numpy(),
        points_w.detach().contiguous().numpy(),
        rows.numpy(),
        turned.numpy(),
        upright,
        *table,
        result.view(math.prod(batch), count, 3).numpy(),
    )
    return result
