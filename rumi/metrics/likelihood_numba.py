"""The compiled CPU version of a belief's agreement with itself; `likelihood.py` has the definition."""

import math

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from sdf.compiled import Kernel
from sdf.grid_numba import block, exact, fast, lattice_of, value
from sdf.intrinsics_numba import at, put
from sdf.part_numba import indices

_LOG2_E = 1.0 / math.log(2.0)
# ln 2 in two parts, of which a whole number times the first is exact
_LN2_HIGH = 0.693145751953125
_LN2_LOW = math.log(2.0) - _LN2_HIGH
_MANY = 16  # points from which on vector instructions are full of them; of fewer points they are filled with poses
_SERIES = tuple(1.0 / math.factorial(k) for k in range(14))


@intrinsic
def _power_of_two(typingctx, exponent, like):
    """2 to a whole number (32 bits), by the bits of a float of the kind of `like`, in whose range it must be."""

    def generate(context, builder, signature, arguments):
        double = signature.return_type == types.float64
        integer, target, bias, mantissa = (
            (ir.IntType(64), ir.DoubleType(), 1023, 52) if double else (ir.IntType(32), ir.FloatType(), 127, 23)
        )
        whole = builder.sext(arguments[0], integer) if double else arguments[0]
        bits = builder.shl(builder.add(whole, ir.Constant(integer, bias)), ir.Constant(integer, mantissa))
        return builder.bitcast(bits, target)

    return like(exponent, like), generate


@intrinsic
def _rounded(typingctx, x):
    """The whole number next to a float not above 0, 32 bits."""

    def generate(context, builder, signature, arguments):
        half = ir.Constant(arguments[0].type, -0.5)
        return builder.fptosi(builder.fadd(arguments[0], half), ir.IntType(32))

    return types.int32(x), generate


@block
def decay(x):
    """The exponential of a number not above 0, to a few units in the last place; below -80 as of -80."""
    kind = type(x)
    x = x if x > kind(-80.0) else kind(-80.0)
    whole = _rounded(x * kind(_LOG2_E))
    rest = (x - kind(whole) * kind(_LN2_HIGH)) - kind(whole) * kind(_LN2_LOW)
    result = kind(_SERIES[12])
    result = result * rest + kind(_SERIES[11])
    result = result * rest + kind(_SERIES[10])
    result = result * rest + kind(_SERIES[9])
    result = result * rest + kind(_SERIES[8])
    result = result * rest + kind(_SERIES[7])
    result = result * rest + kind(_SERIES[6])
    result = result * rest + kind(_SERIES[5])
    result = result * rest + kind(_SERIES[4])
    result = result * rest + kind(_SERIES[3])
    result = result * rest + kind(_SERIES[2])
    result = result * rest + kind(1.0)
    result = result * rest + kind(1.0)
    return result * _power_of_two(whole, x)


@block
def _from_to(a, b):
    """Twelve numbers of a^-1 b, of poses (4, 4)."""
    x, y, z = b[0, 3] - a[0, 3], b[1, 3] - a[1, 3], b[2, 3] - a[2, 3]
    return (
        a[0, 0] * b[0, 0] + a[1, 0] * b[1, 0] + a[2, 0] * b[2, 0],
        a[0, 0] * b[0, 1] + a[1, 0] * b[1, 1] + a[2, 0] * b[2, 1],
        a[0, 0] * b[0, 2] + a[1, 0] * b[1, 2] + a[2, 0] * b[2, 2],
        a[0, 1] * b[0, 0] + a[1, 1] * b[1, 0] + a[2, 1] * b[2, 0],
        a[0, 1] * b[0, 1] + a[1, 1] * b[1, 1] + a[2, 1] * b[2, 1],
        a[0, 1] * b[0, 2] + a[1, 1] * b[1, 2] + a[2, 1] * b[2, 2],
        a[0, 2] * b[0, 0] + a[1, 2] * b[1, 0] + a[2, 2] * b[2, 0],
        a[0, 2] * b[0, 1] + a[1, 2] * b[1, 1] + a[2, 2] * b[2, 1],
        a[0, 2] * b[0, 2] + a[1, 2] * b[1, 2] + a[2, 2] * b[2, 2],
        a[0, 0] * x + a[1, 0] * y + a[2, 0] * z,
        a[0, 1] * x + a[1, 1] * y + a[2, 1] * z,
        a[0, 2] * x + a[1, 2] * y + a[2, 2] * z,
    )


@block
def _carried(x, y, z, pose):
    """A point in the frame that a pose of twelve numbers leads to."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[9],
        pose[3] * x + pose[4] * y + pose[5] * z + pose[10],
        pose[6] * x + pose[7] * y + pose[8] * z + pose[11],
    )


@fast
def _pair(points, count, pose, flat, lattice, tolerance, distances):
    """How far each point is beyond the tolerance; gives the sum of the distances."""
    zero = total = flat.dtype.type(0.0)
    for m in range(count):
        x, y, z = _carried(at(points, m), at(points, count + m), at(points, 2 * count + m), pose)
        distance = abs(value(x, y, z, flat, lattice))
        total += distance
        excess = distance - tolerance
        put(distances, m, excess if excess > zero else zero)
    return total


@fast
def _mix(mixture, weight, sharpness, distances):
    """Adds a particle's share of the likelihood of each point."""
    for m in range(len(mixture)):
        mixture[m] += weight * decay(-sharpness * distances[m])


@exact
def _log_likelihood(points, m, poses, truth, log_weights, flat, lattice, sharpness, tolerance):
    """The same of one point by logarithms, where no float holds the sum."""
    most, room = -math.inf, len(points) // 3
    logs = np.empty(len(poses))
    for i in range(len(poses)):
        pose = _from_to(poses[i], truth)
        x, y, z = _carried(at(points, m), at(points, room + m), at(points, 2 * room + m), pose)
        excess = np.float64(abs(value(x, y, z, flat, lattice)) - tolerance)
        logs[i] = log_weights[i] - sharpness * max(excess, 0.0)
        most = max(most, logs[i])
    total = 0.0
    for i in range(len(poses)):
        total += math.exp(logs[i] - most)
    return most + math.log(total)


@block
def _relative(poses, truth, relative):
    """Twelve numbers of each pose^-1 truth, number by number."""
    each = len(poses)
    for i in range(each):
        pose = _from_to(poses[i], truth)
        for k in range(12):
            relative[k * each + i] = pose[k]


@block
def _of(relative, each, i):
    """Twelve numbers of one of so many poses."""
    return (
        at(relative, i),
        at(relative, each + i),
        at(relative, 2 * each + i),
        at(relative, 3 * each + i),
        at(relative, 4 * each + i),
        at(relative, 5 * each + i),
        at(relative, 6 * each + i),
        at(relative, 7 * each + i),
        at(relative, 8 * each + i),
        at(relative, 9 * each + i),
        at(relative, 10 * each + i),
        at(relative, 11 * each + i),
    )


@fast
def _across(x, y, z, relative, flat, lattice, tolerance, sharpness, distances, likely):
    """Distance and likelihood of a point by each of many poses."""
    zero, each = flat.dtype.type(0.0), len(likely)
    for i in range(each):
        u, v, w = _carried(x, y, z, _of(relative, each, i))
        distance = abs(value(u, v, w, flat, lattice))
        put(distances, i, distance)
        excess = distance - tolerance
        put(likely, i, decay(-sharpness * (excess if excess > zero else zero)))


@exact
def _add(totals, distances):
    """Adds a distance to each total."""
    for i in range(len(totals)):
        totals[i] += distances[i]


@block
def _mixed(weights, likely):
    """Sum of likelihoods by weight, one after the other, as `_mix` adds them up."""
    total = likely.dtype.type(0.0)
    for i in range(len(likely)):
        total += weights[i] * likely[i]
    return total


def _self_agreement(poses, log_weights, truths, points, grid, sharpness, tolerance, nll, distance, part):
    flat, numbers, sizes = grid
    batch, each = nll.shape
    count, believed = len(points) // 3, poses.shape[1]
    mixture, distances = np.empty(count, flat.dtype), np.empty(max(count, believed), flat.dtype)
    relative, totals = np.empty(12 * believed, flat.dtype), np.empty(believed, flat.dtype)
    weights, likely = np.empty(believed, flat.dtype), np.empty(believed, flat.dtype)
    weighed = np.int64(-1)
    for row in indices(part, batch * each):
        b, j = np.int64(row // each), row % each
        if b != weighed:
            weighed = b
            for i in range(believed):
                weights[i] = math.exp(log_weights[b, i])
        lattice = lattice_of(numbers, sizes)
        total, truth = 0.0, truths[b, j]
        if count < _MANY:
            _relative(poses[b], truth, relative)
            totals[:] = 0.0
            for m in range(count):
                x, y, z = points[m], points[count + m], points[2 * count + m]
                _across(x, y, z, relative, flat, lattice, tolerance, sharpness, distances, likely)
                _add(totals, distances)
                mixture[m] = _mixed(weights, likely)
            for i in range(believed):
                total += totals[i]
        else:
            mixture[:] = 0.0
            for i in range(believed):
                pose = _from_to(poses[b, i], truth)
                total += _pair(points, count, pose, flat, lattice, tolerance, distances)
                _mix(mixture, weights[i], sharpness, distances)
        distance[b, j] = total / (believed * max(count, 1))
        log = 0.0
        for m in range(count):
            if mixture[m] > 1e-20:
                log += math.log(mixture[m])
            else:
                log += _log_likelihood(points, m, poses[b], truth, log_weights[b], flat, lattice, sharpness, tolerance)
        nll[b, j] = -log


self_agreement = Kernel(_self_agreement)
