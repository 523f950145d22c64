"""The compiled CPU version of semantics and information; `information.py` has the definition."""

import math

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from sdf.compiled import Kernel
from sdf.grid_numba import block, lattice_of, layer_value, summed, value
from sdf.intrinsics_numba import put
from sdf.part_numba import indices
from sdf.posed import common_height
from sdf.posed_numba import placed_from, placed_upright_from, pose_planes, table_arguments

# points of one task, and numbers of the modes
_STEP = 32
SENSOR, SURROGATE, REVERSE, FORWARD = 0, 1, 2, 3
_LOG2E, _LN2_HIGH, _LN2_LOW, _LN2 = 1.4426950408889634, 0.693359375, -2.12194440e-4, math.log(2.0)


@intrinsic
def _scaled(typingctx, x, power):
    """X * 2**power, by the bits of a single float; the power is whole, from -126 to 127."""

    def generate(context, builder, signature, arguments):
        whole = ir.IntType(32)
        exponent = builder.add(builder.fptosi(arguments[1], whole), ir.Constant(whole, 127))
        factor = builder.bitcast(builder.shl(exponent, ir.Constant(whole, 23)), ir.FloatType())
        return builder.fmul(arguments[0], factor)

    return types.float32(x, power), generate


@intrinsic
def _split(typingctx, x):
    """Whole power and rest, from sqrt(1/2) to sqrt(2), of a single float above 0 that is not denormal."""

    def generate(context, builder, signature, arguments):
        whole = ir.IntType(32)
        root = ir.Constant(whole, 0x3F3504F3)
        bits = builder.sub(builder.bitcast(arguments[0], whole), root)
        power = builder.sitofp(builder.ashr(bits, ir.Constant(whole, 23)), ir.FloatType())
        rest = builder.add(builder.and_(bits, ir.Constant(whole, 0x7FFFFF)), root)
        return context.make_tuple(builder, signature.return_type, [power, builder.bitcast(rest, ir.FloatType())])

    return types.UniTuple(types.float32, 2)(x), generate


def _exp_minus(u):
    """exp(-u) of a number not below 0."""
    return math.exp(-u)


def _log(x):
    """Logarithm of a number above 0 that is not denormal."""
    return math.log(x)


_OPTIONS = {"error_model": "numpy", "forceinline": True, "fastmath": {"contract", "nsz"}}


@overload(_exp_minus, jit_options=_OPTIONS)
def _exp_minus_of(u):
    if u != types.float32:
        return lambda u: math.exp(-u)

    def single(u):
        # by a power of 2 and a series, correct to an ulp or two; below the smallest normal number it stays there
        f = np.float32
        t = u * f(_LOG2E)
        t = t if t < f(126.0) else f(126.0)
        n = f(np.int32(t + f(0.5)))
        u = u if u < f(87.3365) else f(87.3365)
        r = (n * f(_LN2_HIGH) - u) + n * f(_LN2_LOW)
        p = f(1.0 / 5040.0)
        p = p * r + f(1.0 / 720.0)
        p = p * r + f(1.0 / 120.0)
        p = p * r + f(1.0 / 24.0)
        p = p * r + f(1.0 / 6.0)
        p = p * r + f(0.5)
        p = p * r + f(1.0)
        p = p * r + f(1.0)
        return _scaled(p, -n)

    return single


@overload(_log, jit_options=_OPTIONS)
def _log_of(x):
    if x != types.float32:
        return lambda x: math.log(x)

    def single(x):
        f = np.float32
        power, rest = _split(x)
        z = (rest - f(1.0)) / (rest + f(1.0))
        s = z * z
        p = f(2.0 / 9.0)
        p = p * s + f(2.0 / 7.0)
        p = p * s + f(2.0 / 5.0)
        p = p * s + f(2.0 / 3.0)
        p = p * s + f(2.0)
        return power * f(_LN2) + z * p

    return single


@block
def _minus_p_log_p(p, tiny):
    return -p * _log(p if p > tiny else tiny)


@block
def _cost(v, outcome, settings):
    """Negative log-likelihood of an outcome (free, occupied, surface) at a signed distance, peakiness included."""
    none = type(v)(0.0)
    if outcome == 0:
        excess = -settings[3] - v
    elif outcome == 1:
        excess = v - settings[3]
    else:
        excess = abs(v)
    excess = excess if excess > none else none
    return excess * (settings[1] if outcome == 2 else settings[2])


@summed
def _divergence(v, log_weights, w, outcome, reverse, settings):
    """Information of one outcome, from the distances to all poses, their log-weights and weights.

    Of the costs less the least one: what all poses have in common says nothing, and would cost digits.
    """
    kind = type(settings[0])
    least = kind(np.inf)
    for j in range(len(v)):
        least = min(least, _cost(v[j], outcome, settings))
    most = kind(-np.inf)
    mean = kind(0.0)
    for j in range(len(v)):
        cost = _cost(v[j], outcome, settings) - least
        mean += w[j] * cost
        most = max(most, log_weights[j] - cost)
    total, weighted = kind(0.0), kind(0.0)
    for j in range(len(v)):
        cost = _cost(v[j], outcome, settings) - least
        share = _exp_minus(most - (log_weights[j] - cost))
        total += share
        weighted += share * cost
    log_evidence = most + _log(total)
    return mean + log_evidence if reverse else -weighted / total - log_evidence


def _field(chosen, points, rows, log_weights, weights, mode, settings, upright, table, semantics, information, part):
    flat, level, numbers, sizes = table
    lattice, height = lattice_of(numbers, sizes), (level[0], level[1])
    count, poses, real = information.shape[1], rows.shape[2], log_weights.shape[1]
    kind = type(settings[0])
    none, one, tiny = kind(0.0), kind(1.0), settings[6]
    sharpness, tolerance, margin = settings[4], settings[3], settings[5]
    for task in indices(part, (len(chosen) + _STEP - 1) // _STEP):
        v = np.empty(poses, rows.dtype)
        for number in range(task * _STEP, min((task + 1) * _STEP, len(chosen))):
            scene, point = chosen[number] // count, chosen[number] % count
            m, w = rows[scene].reshape(-1), weights[scene]
            place = chosen[number] % len(points)  # a row for each scene, or one for all
            x, y, z = points[place, 0], points[place, 1], points[place, 2]
            if upright:
                for j in range(poses):
                    x_o, y_o = placed_upright_from(m, poses, j, x, y)
                    put(v, j, layer_value(x_o, y_o, flat, lattice, height))
            else:
                for j in range(poses):
                    x_o, y_o, z_o = placed_from(m, poses, j, x, y, z)
                    put(v, j, value(x_o, y_o, z_o, flat, lattice))
            free, occupied, surface, own = none, none, none, none
            if_free, if_occupied, if_surface = none, none, none
            for j in range(poses):
                size = abs(v[j])
                excess = size - margin
                u = sharpness * (excess if excess > none else none)
                on = _exp_minus(u)
                off = one - on
                within = off if v[j] <= none else none
                occupied += w[j] * within
                free += w[j] * (off - within)
                surface += w[j] * on
                own += w[j] * (u * on + _minus_p_log_p(off, tiny))
                below, above = -tolerance - v[j], v[j] - tolerance
                if_free += w[j] * (below if below > none else none)
                if_occupied += w[j] * (above if above > none else none)
                if_surface += w[j] * size
            total = free + occupied + surface
            free, occupied, surface = free / total, occupied / total, surface / total
            if mode == SENSOR:
                gain = _minus_p_log_p(free, tiny) + _minus_p_log_p(occupied, tiny) + _minus_p_log_p(surface, tiny)
                gain -= own / total
            else:
                if mode == SURROGATE:
                    if_free = if_free * settings[2] / total
                    if_occupied = if_occupied * settings[2] / total
                    if_surface = if_surface * settings[1] / total
                else:
                    reverse, belief, found = mode == REVERSE, log_weights[scene], v[:real]
                    if_free = _divergence(found, belief, w, 0, reverse, settings)
                    if_occupied = _divergence(found, belief, w, 1, reverse, settings)
                    if_surface = _divergence(found, belief, w, 2, reverse, settings)
                gain = free * if_free + occupied * if_occupied + surface * if_surface
            semantics[scene, point, 0] = free
            semantics[scene, point, 1] = occupied
            semantics[scene, point, 2] = surface
            information[scene, point] = none if gain < none else gain


field = Kernel(_field, fast=True)
_MODES = {"sensor_mi": SENSOR, "surrogate": SURROGATE, "reverse_kl": REVERSE, "forward_kl": FORWARD}


def information_field(sdf, world_T_object, log_weights, points_w, near, mode, numbers):
    """Semantics and information of the points `near`, in one pass over the poses; others are void."""
    batch, poses = world_T_object.shape[:-3], world_T_object.shape[-3]
    scenes, count, dtype = math.prod(batch), points_w.shape[-2], points_w.dtype
    semantics = points_w.new_zeros(*batch, count, 3)
    semantics[..., 0] = 1.0
    information = points_w.new_zeros(*batch, count)
    log_weights = log_weights.detach().expand(*batch, poses)
    rows, weights = pose_planes(world_T_object, log_weights.exp()[..., None, :])
    settings = [
        1.0,
        numbers["peakiness"],
        numbers["peakiness"] * numbers["free_scale"],
        numbers["tolerance"],
        numbers["sharpness"],
        numbers["surface_tolerance"],
        torch.finfo(dtype).tiny,
    ]
    upright, (flat, _, *rest) = table_arguments(sdf, common_height(sdf, world_T_object, points_w), dtype)
    field(
        near.reshape(-1).nonzero()[:, 0].numpy(),
        points_w.detach().reshape(-1, 3).contiguous().numpy(),
        rows.numpy(),
        log_weights.reshape(scenes, poses).contiguous().numpy(),
        weights[:, 0].numpy(),
        _MODES[mode],
        torch.tensor(settings, dtype=dtype).numpy(),
        upright,
        (flat, *rest),
        semantics.view(scenes, count, 3).numpy(),
        information.view(scenes, count).numpy(),
    )
    return semantics, information
