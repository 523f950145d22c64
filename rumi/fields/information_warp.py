"""The versions for a GPU of semantics, information and normals, a thread a point.

`information.py` and `normal.py` have the definitions.
"""

import math
from typing import Any

import torch

from sdf import gpu
from sdf.grid_warp import LATTICE, grid_arguments, value, value_and_gradient, within

wp = gpu.warp()


@wp.func
def _minus_p_log_p(p: Any, tiny: Any):
    return -p * wp.log(wp.max(p, tiny))


@gpu.Kernel
def _field(
    near: wp.array2d(dtype=wp.bool),
    points: wp.array2d(dtype=Any),
    poses: wp.array3d(dtype=Any),
    weights: wp.array2d(dtype=Any),
    surrogate: wp.bool,
    settings: gpu.Numbers(6),
    flat: wp.array(dtype=Any),
    numbers: gpu.Numbers(LATTICE),
    semantics: wp.array3d(dtype=Any),
    information: wp.array2d(dtype=Any),
):
    scene, point = wp.tid()
    none, one = settings.dtype(0.0), settings.dtype(1.0)
    if not near[scene, point]:
        semantics[scene, point, 0] = one
        semantics[scene, point, 1] = none
        semantics[scene, point, 2] = none
        information[scene, point] = none
        return
    peakiness, free_scale, tolerance = settings[0], settings[1], settings[2]
    sharpness, margin, tiny = settings[3], settings[4], settings[5]
    free, occupied, surface = settings.dtype(0.0), settings.dtype(0.0), settings.dtype(0.0)  # `= none` would share it
    own, if_free = settings.dtype(0.0), settings.dtype(0.0)
    if_occupied, if_surface = settings.dtype(0.0), settings.dtype(0.0)
    count = weights.shape[1]
    for j in range(count):
        p = within(poses, scene * count + j, points[point, 0], points[point, 1], points[point, 2])
        v = value(p[0], p[1], p[2], flat, numbers)
        w = weights[scene, j]
        u = sharpness * wp.max(wp.abs(v) - margin, none)
        on = wp.exp(-u)
        off = one - on
        if v <= none:
            occupied += w * off
        else:
            free += w * off
        surface += w * on
        own += w * (u * on + _minus_p_log_p(off, tiny))
        if_free += w * wp.max(-tolerance - v, none)
        if_occupied += w * wp.max(v - tolerance, none)
        if_surface += w * wp.abs(v)
    total = free + occupied + surface
    free = free / total
    occupied = occupied / total
    surface = surface / total
    gain = settings.dtype(0.0)
    if surrogate:
        gain = peakiness * (free_scale * (free * if_free + occupied * if_occupied) + surface * if_surface) / total
    else:
        gain = _minus_p_log_p(free, tiny) + _minus_p_log_p(occupied, tiny) + _minus_p_log_p(surface, tiny) - own / total
    semantics[scene, point, 0] = free
    semantics[scene, point, 1] = occupied
    semantics[scene, point, 2] = surface
    information[scene, point] = wp.max(gain, none)


@gpu.Kernel
def _normal(
    where: wp.array2d(dtype=wp.bool),
    points: wp.array2d(dtype=Any),
    poses: wp.array3d(dtype=Any),
    weights: wp.array2d(dtype=Any),
    flat: wp.array(dtype=Any),
    numbers: gpu.Numbers(LATTICE),
    normal: wp.array3d(dtype=Any),
):
    scene, point = wp.tid()
    along_x, along_y, along_z = numbers.dtype(0.0), numbers.dtype(0.0), numbers.dtype(0.0)
    if where[scene, point]:
        count = weights.shape[1]
        for j in range(count):
            row = scene * count + j
            p = within(poses, row, points[point, 0], points[point, 1], points[point, 2])
            g = value_and_gradient(p[0], p[1], p[2], flat, numbers)
            w = weights[scene, j]
            along_x += w * (poses[row, 0, 0] * g[1] + poses[row, 0, 1] * g[2] + poses[row, 0, 2] * g[3])
            along_y += w * (poses[row, 1, 0] * g[1] + poses[row, 1, 1] * g[2] + poses[row, 1, 2] * g[3])
            along_z += w * (poses[row, 2, 0] * g[1] + poses[row, 2, 1] * g[2] + poses[row, 2, 2] * g[3])
    normal[scene, point, 0] = along_x
    normal[scene, point, 1] = along_y
    normal[scene, point, 2] = along_z


def information_field(sdf, world_T_object, log_weights, points_w, near, mode, numbers):
    """Semantics and information of the points `near`; others are void."""
    batch, scenes = _batch(world_T_object)
    count, dtype = len(points_w), points_w.dtype
    names = ("peakiness", "free_scale", "tolerance", "sharpness", "surface_tolerance")
    settings = [*(float(numbers[name]) for name in names), torch.finfo(dtype).tiny]
    semantics, information = points_w.new_empty(scenes, count, 3), points_w.new_empty(scenes, count)
    _field.launch(
        (scenes, count),
        near.reshape(scenes, count),
        points_w.detach(),
        *_posed(world_T_object, log_weights),
        mode == "surrogate",
        settings,
        *grid_arguments(sdf, dtype),
        semantics,
        information,
    )
    return semantics.view(*batch, count, 3), information.view(*batch, count)


def expected_normal(sdf, world_T_object, log_weights, points_w, where):
    """Mean normals of the points of `where`, 0 elsewhere."""
    batch, scenes = _batch(world_T_object)
    count = len(points_w)
    normal = points_w.new_empty(scenes, count, 3)
    _normal.launch(
        (scenes, count),
        where.expand(*batch, count).reshape(scenes, count),
        points_w.detach(),
        *_posed(world_T_object, log_weights),
        *grid_arguments(sdf, points_w.dtype),
        normal,
    )
    return normal.view(*batch, count, 3)


def _batch(world_T_object):
    """Batch axes, and the number of scenes."""
    batch = world_T_object.shape[:-3]
    return batch, math.prod(batch)


def _posed(world_T_object, log_weights):
    """Poses (scenes * N, 4, 4), and weights (scenes, N)."""
    poses = world_T_object.detach().reshape(-1, 4, 4)
    weights = log_weights.detach().expand(world_T_object.shape[:-2]).exp()
    return poses, weights.reshape(-1, world_T_object.shape[-3])
