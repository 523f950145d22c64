"""The fused CPU versions of the discrepancy and of its Gauss-Newton terms; `discrepancy.py` has the definitions."""

import numpy as np

from sdf.compiled import Kernel
from sdf.grid_numba import at, block, exact, fast, lattice_of, value, value_and_gradient
from sdf.part_numba import indices
from sensors.tiles_numba import local, near_points


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
        near, count = near_points(own, pose, flat, lattice, steepness, alpha, 0)
        looked[b, n] = count + counts[b, 0]
        hinge = _hinge_cost(near, count, pose, flat, lattice, alpha)
        result[b, n] = free_scale * hinge + _surface_cost(surface[b], counts[b, 0], pose, flat, lattice)


@fast
def terms_of(points, count, pose, flat, lattice, free_scale, alpha, terms):
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
def to_frame(terms, pose, gradient, hessian, work):
    """Gradient (6) and Hessian (6, 6) of a moving object, along the axes of the frame, from `terms_of`."""
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


def _normal_equations(poses, scene, grid, steepness, free_scale, alpha, objective, gradient, hessian, part):
    surface, hinged, signs, small_first, small_balls, large_first, large_balls, counts = scene
    flat, numbers, sizes = grid
    batch, each = objective.shape
    for row in indices(part, batch * each):
        b, n = row // each, row % each
        lattice = lattice_of(numbers, sizes)
        pose = placed(poses[b, n])
        own = (hinged[b], signs[b], small_first[b], small_balls[b], large_first[b], large_balls[b], counts[b])
        near, count = near_points(own, pose, flat, lattice, steepness, alpha, counts[b, 0])
        count = gather(surface[b], counts[b], near, count)
        terms, work = np.empty(28), np.empty((6, 6))
        terms_of(near, count, pose, flat, lattice, free_scale, alpha, terms)
        objective[b, n] = terms[0]
        to_frame(terms, pose, gradient[b, n], hessian[b, n], work)


discrepancy = Kernel(_discrepancy)
normal_equations = Kernel(_normal_equations)
