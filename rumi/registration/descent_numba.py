"""The compiled CPU version of a Gauss-Newton descent, pose by pose; `descent.py` has the definition."""

import math

import numpy as np
import torch

from sdf.compiled import Kernel
from sdf.grid_numba import exact, fast, lattice_of, value, value_and_gradient
from sdf.intrinsics_numba import at, put
from sdf.part_numba import indices
from sensors.discrepancy_numba import placed, prepare
from sensors.tiles_numba import local, near_points


@fast
def violable(near, count, pose, flat, lattice, margin, centre, reach):
    """Keeps the points less than `margin` from being violated, of free ones those in reach; how many."""
    far = np.empty(count, flat.dtype)
    room, given = near.shape[1], near.reshape(-1)
    for n in range(count):
        x, y, z = local(at(given, n), at(given, room + n), at(given, 2 * room + n), pose)
        put(far, n, at(given, 3 * room + n) * value(x, y, z, flat, lattice))
    left = 0
    for n in range(count):
        if far[n] < margin:
            x, y, z = near[0, n] - centre[0], near[1, n] - centre[1], near[2, n] - centre[2]
            if near[3, n] < 0 or not math.sqrt(x * x + y * y + z * z) > reach:
                for row in range(4):
                    near[row, left] = near[row, n]
                left += 1
    return left


@fast
def _terms(points, count, pose, flat, lattice, free_scale, alpha, terms):
    """Objective, gradient (6) and upper Hessian (21) of points (x, y, z, sign; 0 for surface) into `terms`.

    The tangent is that of an object that stays while the points move, along the object's axes.
    """
    zero, one, half = flat.dtype.type(0.0), flat.dtype.type(1.0), flat.dtype.type(0.5)
    cost = g0 = g1 = g2 = g3 = g4 = g5 = zero
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = zero
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = zero
    room, given = points.shape[1], points.reshape(-1)
    for m in range(count):
        x, y, z = local(at(given, m), at(given, room + m), at(given, 2 * room + m), pose)
        v, a, b, c = value_and_gradient(x, y, z, flat, lattice)
        d, e, f = y * c - z * b, z * a - x * c, x * b - y * a
        sign = at(given, 3 * room + m)
        surface = sign == zero
        short = alpha - sign * v
        residual = v if surface else (-sign * short if short > zero else zero)
        weight = one if surface else (free_scale if short > zero else zero)
        pull = weight * residual
        cost += pull * residual
        g0 += pull * a
        g1 += pull * b
        g2 += pull * c
        g3 += pull * d
        g4 += pull * e
        g5 += pull * f
        p, q, r, s, t, u = weight * a, weight * b, weight * c, weight * d, weight * e, weight * f
        h00 += p * a
        h01 += p * b
        h02 += p * c
        h03 += p * d
        h04 += p * e
        h05 += p * f
        h11 += q * b
        h12 += q * c
        h13 += q * d
        h14 += q * e
        h15 += q * f
        h22 += r * c
        h23 += r * d
        h24 += r * e
        h25 += r * f
        h33 += s * d
        h34 += s * e
        h35 += s * f
        h44 += t * e
        h45 += t * f
        h55 += u * f
    terms[0] = half * cost
    terms[1], terms[2], terms[3], terms[4], terms[5], terms[6] = g0, g1, g2, g3, g4, g5
    terms[7], terms[8], terms[9], terms[10], terms[11], terms[12] = h00, h01, h02, h03, h04, h05
    terms[13], terms[14], terms[15], terms[16], terms[17] = h11, h12, h13, h14, h15
    terms[18], terms[19], terms[20], terms[21] = h22, h23, h24, h25
    terms[22], terms[23], terms[24], terms[25], terms[26], terms[27] = h33, h34, h35, h44, h45, h55


@exact
def _to_frame(terms, pose, gradient, hessian, work):
    """Gradient (6) and Hessian (6, 6) of a moving object, along the axes of the frame, from `_terms`."""
    k = 7
    for i in range(6):
        for j in range(i, 6):
            work[i, j] = work[j, i] = terms[k]
            k += 1
    for half in range(2):
        for i in range(3):
            gradient[3 * half + i] = -(
                pose[3 * i] * terms[1 + 3 * half]
                + pose[3 * i + 1] * terms[2 + 3 * half]
                + pose[3 * i + 2] * terms[3 + 3 * half]
            )
    # R H R^T by blocks: rows first, columns into the result
    for half in range(2):
        for j in range(6):
            x, y, z = work[3 * half, j], work[3 * half + 1, j], work[3 * half + 2, j]
            for i in range(3):
                work[3 * half + i, j] = pose[3 * i] * x + pose[3 * i + 1] * y + pose[3 * i + 2] * z
    for half in range(2):
        for j in range(6):
            x, y, z = work[j, 3 * half], work[j, 3 * half + 1], work[j, 3 * half + 2]
            for i in range(3):
                hessian[j, 3 * half + i] = pose[3 * i] * x + pose[3 * i + 1] * y + pose[3 * i + 2] * z


@exact
def gather(surface, counts, near, count):
    """Puts the surface points behind the first `count` of `near`; how many there are then."""
    for m in range(counts[0]):
        near[0, count + m], near[1, count + m], near[2, count + m] = surface[0, m], surface[1, m], surface[2, m]
        near[3, count + m] = 0.0
    return count + counts[0]


@exact
def _solve(matrix, vector, size):
    """Solves in place by Cholesky; False where the matrix is not positive definite."""
    for j in range(size):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 0.0:
            return False
        matrix[j, j] = math.sqrt(pivot)
        for i in range(j + 1, size):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = rest / matrix[j, j]
    for i in range(size):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]
    return True


@exact
def copy(source, target):
    """Copies a matrix; by an assignment of all at once a third of the kernel's compiling would go to its error."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@exact
def retract(pose, step, out):
    """Shifts the origin by the first three of a step (6) and turns about it by the others (Rodrigues)."""
    x, y, z = step[3], step[4], step[5]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    a = math.sin(angle) / angle if angle > 1e-8 else 1.0
    b = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 1e-8 else 0.5
    turn = (
        1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y,
        b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x,
        b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y),
    )  # fmt: skip
    for i in range(3):
        for j in range(3):
            out[i, j] = turn[3 * i] * pose[0, j] + turn[3 * i + 1] * pose[1, j] + turn[3 * i + 2] * pose[2, j]
        out[i, 3] = pose[i, 3] + step[i]


@exact
def _step(gradient, hessian, freedom, damping, floor, lever, limits, system, step):
    """A damped step (6), no longer than `limits`, and the decrease that the quadratic model predicts for it."""
    size = len(freedom)
    for i in range(size):
        for j in range(size):
            system[i, j] = hessian[freedom[i], freedom[j]]
        system[i, i] += damping * system[i, i] + floor * (1e-6 if freedom[i] < 3 else lever * lever)
    short = step[6:]
    for i in range(size):
        short[i] = -gradient[freedom[i]]
    if not _solve(system, short, size):
        return False, 0.0
    for k in range(6):
        step[k] = 0.0
    for i in range(size):
        step[freedom[i]] = short[i]
    for half in range(2):
        square = 0.0
        for k in range(3 * half, 3 * half + 3):
            square += step[k] * step[k]
        share = math.sqrt(square) / limits[half]
        if share > 1.0:
            for k in range(3 * half, 3 * half + 3):
                step[k] /= share
    decrease = 0.0
    for i in range(6):
        decrease -= gradient[i] * step[i]
        for j in range(6):
            decrease -= 0.5 * step[i] * hessian[i, j] * step[j]
    return True, decrease


def _descend(
    poses, scene, grid, steepness, free_scale, alpha, margin, centres, reaches,
    freedom, lever, iterations, limits, enough, result, passes, part,
):  # fmt: skip
    surface, hinged, signs, small_first, small_balls, large_first, large_balls, counts = scene
    flat, numbers, sizes = grid
    batch, each = passes.shape
    size = len(freedom)
    for row in indices(part, batch * each):
        b, n = row // each, row % each
        lattice = lattice_of(numbers, sizes)
        own = (hinged[b], signs[b], small_first[b], small_balls[b], large_first[b], large_balls[b], counts[b])
        start = placed(poses[b, n])
        near, count = near_points(own, start, flat, lattice, steepness, margin, counts[b, 0])
        count = violable(near, count, start, flat, lattice, margin, centres[b], reaches[b])
        count = gather(surface[b], counts[b], near, count)
        floor = max(counts[b, 0], 1)
        terms, gradient, hessian, work = np.empty(28), np.empty(6), np.empty((6, 6)), np.empty((6, 6))
        system, step = np.empty((size, size)), np.empty(12)
        pose, candidate = result[b, n], np.empty((4, 4), poses.dtype)
        copy(poses[b, n], candidate)
        copy(candidate, pose)
        _terms(near, count, start, flat, lattice, free_scale, alpha, terms)
        _to_frame(terms, start, gradient, hessian, work)
        objective, damping, done = terms[0], 1e-3, 1
        for _ in range(iterations):
            found, decrease = _step(gradient, hessian, freedom, damping, floor, lever, limits, system, step)
            if found and decrease <= enough * objective:
                break
            if found:
                retract(pose, step, candidate)
                place = placed(candidate)
                _terms(near, count, place, flat, lattice, free_scale, alpha, terms)
                done += 1
            if found and terms[0] < objective:
                copy(candidate, pose)
                _to_frame(terms, place, gradient, hessian, work)
                objective, damping = terms[0], max(damping * 0.2, 1e-6)
            else:
                damping = min(damping * 20.0, 1e6)
        passes[b, n] = done


_kernel = Kernel(_descend)


def given(sdf, discrepancy, frame_T_object, observation, search, settings):
    """What every descent's kernel takes at first, and a place for the poses that it finds (b, N, 4, 4)."""
    ready = prepare(sdf, frame_T_object, observation.points, observation.semantics, observation.valid)
    kind, poses = ready.poses.dtype.type, torch.from_numpy(ready.poses)
    origin = poses[..., :3, 3]
    centre = 0.5 * (origin.amin(1) + origin.amax(1))
    reach = discrepancy.radius + (origin - centre[:, None]).norm(dim=-1).amax(1)
    arguments = (
        *ready,
        kind(float(discrepancy.free_scale)),
        kind(-float(discrepancy.tolerance)),
        kind(settings.margin_m),
        centre.contiguous().numpy(),
        reach.numpy(),
        np.array((0, 1, 5) if search == "SE(2)" else (0, 1, 2, 3, 4, 5)),
    )
    return arguments, torch.empty_like(poses)


def descend(sdf, discrepancy, frame_T_object, observation, search, settings):
    """What `descent.descend` gives by Gauss-Newton; each pose stops by itself.

    Skipped, with the same result: free and occupied points that a pose cannot violate within the margin, ball by ball.
    """
    arguments, result = given(sdf, discrepancy, frame_T_object, observation, search, settings)
    _kernel(
        *arguments,
        settings.lever_m,
        settings.iterations,
        np.array((settings.step_limit_m, settings.step_limit_rad)),
        settings.enough,
        result.numpy(),
        np.empty(result.shape[:2], np.int64),
    )
    return result.view(frame_T_object.shape)
