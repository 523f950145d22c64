"""The compiled CPU version of a descent by Adam, pose by pose; `descent.py` has the definition."""

import math

import numpy as np

from rumi.registration.descent_numba import copy, gather, given, retract, violable
from sdf.compiled import Kernel
from sdf.grid_numba import exact, fast, lattice_of, value_and_gradient
from sdf.intrinsics_numba import at
from sdf.part_numba import indices
from sensors.discrepancy_numba import placed
from sensors.tiles_numba import local, near_points


@fast
def _gradient(points, count, pose, flat, lattice, free_scale, alpha, sums):
    """Gradient (6) of points (x, y, z, sign; 0 for surface), which move while the object stays, along its axes."""
    zero = flat.dtype.type(0.0)
    g0 = g1 = g2 = g3 = g4 = g5 = zero
    room, given = points.shape[1], points.reshape(-1)
    for m in range(count):
        x, y, z = local(at(given, m), at(given, room + m), at(given, 2 * room + m), pose)
        v, a, b, c = value_and_gradient(x, y, z, flat, lattice)
        sign = at(given, 3 * room + m)
        short = alpha - sign * v
        pull = v if sign == zero else (-sign * short * free_scale if short > zero else zero)
        g0 += pull * a
        g1 += pull * b
        g2 += pull * c
        g3 += pull * (y * c - z * b)
        g4 += pull * (z * a - x * c)
        g5 += pull * (x * b - y * a)
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = g0, g1, g2, g3, g4, g5


@exact
def _step(sums, pose, freedom, iteration, rate, moments, step):
    """Adam's step (6) of an object that moves, along the axes of the frame; `moments` are the two means (2, 6)."""
    for k in freedom:
        half, i = k // 3, k % 3
        slope = -(
            pose[3 * i] * sums[3 * half] + pose[3 * i + 1] * sums[3 * half + 1] + pose[3 * i + 2] * sums[3 * half + 2]
        )
        moments[0, k] = 0.9 * moments[0, k] + 0.1 * slope
        moments[1, k] = 0.999 * moments[1, k] + 0.001 * slope * slope
        mean = moments[0, k] / (1.0 - 0.9**iteration)
        spread = math.sqrt(moments[1, k] / (1.0 - 0.999**iteration))
        step[k] = -rate * mean / (spread + 1e-8)


def _descend_adam(
    poses, scene, grid, steepness, free_scale, alpha, margin, centres, reaches, freedom, iterations, rounds, rate,
    result, part,
):  # fmt: skip
    surface, hinged, signs, small_first, small_balls, large_first, large_balls, counts = scene
    flat, numbers, sizes = grid
    batch, each = result.shape[:2]
    for row in indices(part, batch * each):
        b, n = row // each, row % each
        lattice = lattice_of(numbers, sizes)
        own = (hinged[b], signs[b], small_first[b], small_balls[b], large_first[b], large_balls[b], counts[b])
        start = placed(poses[b, n])
        near, count = near_points(own, start, flat, lattice, steepness, margin, counts[b, 0])
        count = violable(near, count, start, flat, lattice, margin, centres[b], reaches[b])
        count = gather(surface[b], counts[b], near, count)
        sums, step, moments = np.empty(6, flat.dtype), np.zeros(6), np.zeros((2, 6))
        pose, before = result[b, n], np.empty((4, 4), poses.dtype)
        copy(poses[b, n], pose)
        for _ in range(rounds):
            for k in range(6):
                moments[0, k] = moments[1, k] = 0.0
            for iteration in range(1, iterations + 1):
                place = placed(pose)
                _gradient(near, count, place, flat, lattice, free_scale, alpha, sums)
                _step(sums, place, freedom, iteration, rate, moments, step)
                copy(pose, before)
                retract(before, step, pose)


_kernel = Kernel(_descend_adam)


def descend(sdf, discrepancy, frame_T_object, observation, search, settings):
    """What `descent.descend` gives by Adam."""
    arguments, result = given(sdf, discrepancy, frame_T_object, observation, search, settings)
    _kernel(*arguments, settings.iterations, settings.rounds, settings.learning_rate, result.numpy())
    return result.view(frame_T_object.shape)
