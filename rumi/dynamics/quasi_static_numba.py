"""The compiled CPU version of the quasi-static rollouts; `quasi_static.py` and `sliding.py` have the definition."""

import math

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from rumi.dynamics.base import PushRollouts, rigid_motions
from rumi.dynamics.sliding_numba import settled, slope, turned
from rumi.robot.border import BORDER_GROUP
from rumi.robot.tool_numba import residual, step_within
from sdf.compiled import Kernel, arrays_of, bare
from sdf.intrinsics_numba import at, next_to, node, pair, put
from sdf.part_numba import indices


@intrinsic
def _rank(typingctx, x):
    """A whole number that is the greater the greater a number is: loops that look for the greatest become vectors."""
    whole = {types.float32: types.int32, types.float64: types.int64}[x]

    def generate(context, builder, signature, arguments):
        kind = ir.IntType(whole.bitwidth)
        bits = builder.bitcast(arguments[0], kind)
        below = builder.ashr(bits, ir.Constant(kind, whole.bitwidth - 1))
        return builder.xor(bits, builder.lshr(below, ir.Constant(kind, 1)))

    return whole(x), generate


@intrinsic
def _ranked(typingctx, rank):
    """The number that has a rank."""
    number = {types.int32: types.float32, types.int64: types.float64}[rank]

    def generate(context, builder, signature, arguments):
        kind = ir.IntType(rank.bitwidth)
        below = builder.ashr(arguments[0], ir.Constant(kind, rank.bitwidth - 1))
        bits = builder.xor(arguments[0], builder.lshr(below, ir.Constant(kind, 1)))
        return builder.bitcast(bits, context.get_value_type(number))

    return number(rank), generate


@bare
def _deepest(x, y, cos, sin, px, py, order, groups, clears, values, flat, low_x, low_y, spacing, flatness, inside):
    """The tool's point that is deepest in the object, its depth, and how far the tool may go at least until it touches.

    The tool is at (x, y, cos, sin) in the object's frame. A point goes `flatness` metres, at least, until its depth has
    changed by one.
    """
    centres_x, centres_y, radii = groups
    kind, across = flat.dtype.type, np.int32(values.shape[1])
    zero, one = np.int32(0), np.int32(1)
    none, half, step, flatness = kind(0.0), kind(0.5), kind(spacing), kind(flatness)
    depth, best, first, gap = none, -1, len(px), kind(1e9)
    last_x, last_y = kind(values.shape[0] - 1.0), kind(values.shape[1] - 1.0)
    end_x, end_y = np.int32(values.shape[0] - 2), np.int32(values.shape[1] - 2)
    place_x, place_y = kind((x - low_x) / spacing), kind((y - low_y) / spacing)
    turn_x, turn_y = kind(cos / spacing), kind(sin / spacing)
    for group in range(len(radii)):
        u = place_x + turn_x * at(centres_x, group) - turn_y * at(centres_y, group)
        v = place_y + turn_y * at(centres_x, group) + turn_x * at(centres_y, group)
        a, b = u if u > none else none, v if v > none else none
        a, b = a if a < last_x else last_x, b if b < last_y else last_y
        far_x, far_y = step * (u - a), step * (v - b)
        beyond = far_x * far_x + far_y * far_y
        there = at(flat, node(np.int32(a + half), np.int32(b + half), zero, across, one))
        put(clears, group, (math.sqrt(there * there + beyond) if beyond > none else there) - at(radii, group))
    for group in range(len(radii)):
        clear = clears[group]
        if -clear < depth:
            gap = min(gap, clear)
            continue
        begin, most = group * BORDER_GROUP, _rank(kind(-1e9))
        for n in range(BORDER_GROUP):
            k = begin + n
            # beyond the table is outside of the object, as its border is
            u = place_x + turn_x * at(px, k) - turn_y * at(py, k)
            v = place_y + turn_y * at(px, k) + turn_x * at(py, k)
            u, v = u if u > none else none, v if v > none else none
            u, v = u if u < last_x else last_x, v if v < last_y else last_y
            i, j = np.int32(u), np.int32(v)
            i, j = i if i < end_x else end_x, j if j < end_y else end_y
            a, b = u - kind(i), v - kind(j)
            near = node(i, j, zero, across, one)
            far = next_to(near, across)
            low, low_next = pair(flat, near)
            high, high_next = pair(flat, far)
            low += b * (low_next - low)
            high += b * (high_next - high)
            within = -(low + a * (high - low))
            put(inside, n, within)
            rank = _rank(within)
            most = rank if rank > most else most
        if most < _rank(depth):
            gap = min(gap, max(clear, -_ranked(most) * flatness))
            continue
        for n in range(BORDER_GROUP):
            k = begin + n
            if inside[n] > depth or (inside[n] == depth and inside[n] > none and order[k] < first):
                depth, best, first = inside[n], k, order[k]
        gap = min(gap, none)
    return np.float64(depth), best, np.float64(gap)


@bare
def _sample(k, controls, action_scale, arm, path, poses, bodies, body, outline, numbers, counts, scratch, out):
    """All rollouts of control sequence k."""
    px, py, order, groups = body
    values, flat, low = outline
    low_x, low_y = low[0], low[1]
    spacing, flatness, reach, width = numbers[0], numbers[1], numbers[2], numbers[3]
    mini, passes = counts[0], counts[1]
    track, contact, alike, checks = out
    inside, clears, turns = scratch[0][k], scratch[1][k], scratch[2][k]
    actions = path.shape[1] - 1
    left = residual(path[k, 0, 0], path[k, 0, 1], 0.0, path[k, 0, 2], arm[0], arm[1], arm[3])
    # in double precision from the start: else numba compiles all that they are given to once for each
    free_x, free_y, free_yaw = np.float64(path[k, 0, 0]), np.float64(path[k, 0, 1]), np.float64(path[k, 0, 2])
    for h in range(actions):
        to_x, to_y = free_x + controls[k, h, 0] * action_scale[0], free_y + controls[k, h, 1] * action_scale[1]
        to_yaw = free_yaw + controls[k, h, 2] * action_scale[2]
        free_x, free_y, _, free_yaw, left = step_within(
            free_x, free_y, 0.0, free_yaw, to_x, to_y, 0.0, to_yaw, left, arm
        )
        path[k, h + 1, 0], path[k, h + 1, 1], path[k, h + 1, 2] = free_x, free_y, free_yaw
    for step in range(len(turns)):
        turns[step, 0] = 2.0  # no cosine: the tool's turn is worked out where the first rollout needs it
    checked, untouched = 0, -1
    for m in range(len(poses)):
        x, y, yaw = np.float64(poses[m, 0]), np.float64(poses[m, 1]), np.float64(poses[m, 2])
        cos, sin = np.float64(math.cos(poses[m, 2])), np.float64(math.sin(poses[m, 2]))
        slides = (
            bodies[m, 0],
            bodies[m, 1],
            bodies[m, 2],
            bodies[m, 3],
            bodies[m, 4],
            bodies[m, 5],
            bodies[m, 6],
            bodies[m, 7],
            bodies[m, 8],
        )
        track[k, m, 0, 0], track[k, m, 0, 1], track[k, m, 0, 2] = poses[m, 0], poses[m, 1], poses[m, 2]
        still, gap = True, 0.0  # metres that the tool may go before it can touch
        for action in range(actions):
            from_x, from_y, from_yaw = path[k, action, 0], path[k, action, 1], path[k, action, 2]
            way_x = (path[k, action + 1, 0] - from_x) / mini
            way_y = (path[k, action + 1, 1] - from_y) / mini
            way_yaw = (path[k, action + 1, 2] - from_yaw) / mini
            way = math.sqrt(way_x * way_x + way_y * way_y) + abs(way_yaw) * width
            back = turned(-way_yaw)
            for part in range(mini):
                gap -= way
                if gap > 0.0:
                    continue
                tool_x, tool_y = from_x + (part + 1) * way_x, from_y + (part + 1) * way_y
                apart = math.sqrt((tool_x - x) * (tool_x - x) + (tool_y - y) * (tool_y - y))
                if apart >= reach:
                    gap = apart - reach
                    continue
                checked += 1
                tool_yaw = from_yaw + (part + 1) * way_yaw
                step = action * mini + part
                if turns[step, 0] > 1.0:
                    turns[step, 0], turns[step, 1] = math.cos(tool_yaw), math.sin(tool_yaw)
                tool_cos, tool_sin = turns[step, 0], turns[step, 1]
                first = (x, y, yaw)
                for _ in range(passes):
                    dx, dy = tool_x - x, tool_y - y
                    turn_cos = tool_cos * cos + tool_sin * sin
                    turn_sin = tool_sin * cos - tool_cos * sin
                    place_x, place_y = cos * dx + sin * dy, cos * dy - sin * dx
                    depth, point, gap = _deepest(
                        place_x,
                        place_y,
                        turn_cos,
                        turn_sin,
                        px,
                        py,
                        order,
                        groups,
                        clears,
                        values,
                        flat,
                        low_x,
                        low_y,
                        spacing,
                        flatness,
                        inside,
                    )
                    if point < 0:
                        break
                    # where it stood was rounded to single precision, as the plain version takes it
                    own_cos, own_sin = (math.cos(yaw), math.sin(yaw)) if still else (cos, sin)
                    still, gap = False, 0.0
                    contact[k, m, action] = True
                    gx, gy = slope(
                        place_x + turn_cos * px[point] - turn_sin * py[point],
                        place_y + turn_sin * px[point] + turn_cos * py[point],
                        values,
                        low_x,
                        low_y,
                        spacing,
                    )
                    x, y, yaw, cos, sin = settled(
                        x,
                        y,
                        yaw,
                        own_cos,
                        own_sin,
                        first,
                        (tool_x, tool_y),
                        (way_x, way_y, way_yaw),
                        back,
                        tool_cos * px[point] - tool_sin * py[point],
                        tool_sin * px[point] + tool_cos * py[point],
                        gx,
                        gy,
                        depth,
                        0.0,
                        slides,
                    )
            if still:
                for axis in range(3):
                    track[k, m, action + 1, axis] = poses[m, axis]
            else:
                track[k, m, action + 1, 0], track[k, m, action + 1, 1] = x, y
                track[k, m, action + 1, 2] = yaw
        if still and untouched < 0:
            untouched = m
        alike[k, m] = untouched if still else m  # see `duplicates`
    checks[k] = checked


def _push_rollouts(
    controls, action_scale, arm, path, poses, bodies, body, outline, numbers, counts, scratch, out, part
):
    each = counts[2]  # control sequences of a scene
    for k in indices(part, len(path)):
        own = poses[k // each]
        _sample(k, controls, action_scale, arm, path, own, bodies, body, outline, numbers, counts, scratch, out)


push_rollouts = Kernel(_push_rollouts)


class CompiledRollouts:
    """The compiled version of `rollout_poses`.

    Skipped besides, with the same result: groups of the tool's points that are too far from the object to hold the
    deepest of them.

    Args:
        model: whose outline, points and friction are used.
    """

    def __init__(self, model):
        self._model = model
        border, outline = model.border, model.outline
        groups = arrays_of(*border.centres.unbind(-1), border.radii + outline.slack)
        self._body = (*arrays_of(*border.sets.flatten(0, 1).unbind(-1), border.groups.flatten()), groups)
        self._outline = arrays_of(outline.values, outline.values.flatten(), outline.origin.double())
        self._numbers = np.array((outline.spacing, 1.0 / outline.steepness, model.reach, border.radius))
        self._settings = model.settings

    def __call__(self, configuration, controls, poses, sliding):
        """The rollouts in which the object starts at given poses."""
        horizon, own = controls.shape[-2], self._settings
        shape = (*controls.shape[:-2], poses.shape[-2])
        samples, rollouts = math.prod(shape[:-1]), shape[-1]
        path = configuration[..., None, None, :].expand(*shape[:-1], horizon + 1, 3).reshape(-1, horizon + 1, 3)
        path, poses = path.contiguous(), poses.to(path)
        track = path.new_empty(samples, rollouts, horizon + 1, 3)
        contact = torch.zeros(samples, rollouts, horizon, dtype=torch.bool)
        alike, checks = torch.empty(shape, dtype=torch.long), torch.empty(samples, dtype=torch.long)
        push_rollouts(
            *arrays_of(controls.reshape(samples, horizon, controls.shape[-1]), self._model.tool.scale),
            self._model.tool.arm_arrays(),
            *arrays_of(path, poses.reshape(math.prod(shape[:-2]), rollouts, 3)),
            _bodies(sliding),
            self._body,
            self._outline,
            self._numbers,
            np.array((own.mini_steps, own.passes, max(1, shape[-2]))),
            (
                *(np.empty((samples, size), self._body[0].dtype) for size in (BORDER_GROUP, len(self._body[3][2]))),
                np.empty((samples, horizon * own.mini_steps, 2)),
            ),
            tuple(part.numpy() for part in (track, contact, alike.view(samples, rollouts), checks)),
        )
        shifts, turns = rigid_motions(
            poses.unsqueeze(-3).expand(*shape, 3).reshape(-1, 3),
            track.view(samples * rollouts, horizon + 1, 3),
            self._model.pivots(shape),
            contact.any(-1).flatten().nonzero()[:, 0],
        )
        contact = contact.view(*shape, horizon)
        return PushRollouts(
            path.view(*shape[:-1], 1, horizon + 1, 3).expand(*shape, horizon + 1, 3).contiguous(),
            shifts.view(*shape, horizon + 1, 3),
            contact,
            int(checks.sum()) / max(1, contact.numel() * own.mini_steps),
            alike,
            turns.view(*shape, horizon + 1),
            self._model.pivot,
        )


def _bodies(sliding):
    """(M, 9) in double precision: centre of friction, lever, friction, quartic limit surface."""
    quartic = sliding.lever.new_zeros(len(sliding.lever), 5) if sliding.quartic is None else sliding.quartic
    parts = (sliding.centre, sliding.lever[:, None], sliding.friction[:, None], quartic)
    return torch.cat(parts, -1).double().contiguous().numpy()
