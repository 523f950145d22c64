"""The fused CPU version of the push rollouts; `displacement.py` has the definition.

Rollouts of one control sequence that have met the same so far are carried on as one group, which splits where some of
them touch and others do not: while nothing is touched, there is one group.
"""

import math

import numpy as np

from rumi.robot.tool_numba import residual, step_within
from sdf.compiled import Kernel, bare
from sdf.grid_numba import at, put
from sdf.part_numba import indices

# columns of a group's state
_X, _Y, _YAW, _WAY_X, _WAY_Y, _WAY_YAW, _OFFSET_X, _OFFSET_Y, _COS, _SIN = range(10)


@bare
def _value(grid, channel, x, y):
    """Bilinear value of a channel at lattice coordinates; zero fades in outside."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    value = 0.0
    for di in range(2):
        for dj in range(2):
            if 0 <= i + di < grid.shape[0] and 0 <= j + dj < grid.shape[1]:
                value += (a if di else 1.0 - a) * (b if dj else 1.0 - b) * grid[i + di, j + dj, channel]
    return value


@bare
def _bound(bound, x, y):
    """What the bound holds at the node next to lattice coordinates; 0 outside."""
    i = 0 if bound.shape[0] == 1 else math.floor(x + 0.5)
    j = 0 if bound.shape[1] == 1 else math.floor(y + 0.5)
    return bound[i, j] if 0 <= i < bound.shape[0] and 0 <= j < bound.shape[1] else 0.0


@bare
def _touch(
    x, y, cos, sin, level, px, py, starts, order, flat, origin, bound, bound_origin, centres, sizes, ahead, likely
):
    """Greatest contact probability of the tool's points if it is above `level`, and the first point that has it.

    Discs are looked into in the order of what they may hold, until none left can hold as much as was found.
    """
    width, height, scale, tie = int(sizes[0]), int(sizes[1]), sizes[2], sizes[3]
    kind, across, one = flat.dtype.type, np.int32(height), np.int32(1)
    none, last_x, last_y = kind(0.0), kind(width - 1.001), kind(height - 1.001)
    possible = False
    for d in range(len(centres)):
        cx = (x + cos * centres[d, 0] - sin * centres[d, 1] - bound_origin[0]) * scale
        cy = (y + sin * centres[d, 0] + cos * centres[d, 1] - bound_origin[1]) * scale
        ahead[d] = _bound(bound, cx, cy)
        possible |= ahead[d] > level
    if not possible:
        return 0.0, -1, False
    place_x, place_y = kind((x - origin[0]) * scale + 2.0), kind((y - origin[1]) * scale + 2.0)
    turn_x, turn_y = kind(cos * scale), kind(sin * scale)
    most = none
    while True:
        disc, highest = -1, max(most, level) - tie
        for d in range(len(centres)):
            if ahead[d] >= highest:
                disc, highest = d, ahead[d]
        if disc < 0:
            break
        ahead[disc] = -2.0
        first, last = starts[disc], starts[disc + 1]
        for k in range(first, last):
            # the field is padded by two nodes of zeros on each side, on which all that lies outside lands
            u = place_x + turn_x * at(px, k) - turn_y * at(py, k)
            v = place_y + turn_y * at(px, k) + turn_x * at(py, k)
            u, v = u if u > none else none, v if v > none else none
            u, v = u if u < last_x else last_x, v if v < last_y else last_y
            i, j = np.int32(u), np.int32(v)
            a, b = u - kind(i), v - kind(j)
            near = i * across + j
            far = near + across
            low, high = at(flat, near), at(flat, far)
            low += b * (at(flat, near + one) - low)
            high += b * (at(flat, far + one) - high)
            put(likely, k, low + a * (high - low))
        for k in range(first, last):
            most = max(most, likely[k])
    best, first = -1, len(px)
    if level < most:
        for d in range(len(centres)):
            if ahead[d] == -2.0:
                for k in range(starts[d], starts[d + 1]):
                    if likely[k] >= most - tie and order[k] < first:
                        best, first = k, order[k]
    return most, best, True


@bare
def _pushes(x, y, cos, sin, tx, ty, dx, dy, normal, origin, scale, push_cosine):
    """Whether the motion (dx, dy) of the tool's point (tx, ty) goes into the surface within the push angle."""
    tiny = 1e-6
    gx, gy = (x + cos * tx - sin * ty - origin[0]) * scale, (y + sin * tx + cos * ty - origin[1]) * scale
    nx, ny, nz = _value(normal, 0, gx, gy), _value(normal, 1, gx, gy), _value(normal, 2, gx, gy)
    length, moved = math.sqrt(nx * nx + ny * ny + nz * nz), math.sqrt(dx * dx + dy * dy)
    return -(nx * dx + ny * dy) > push_cosine * length * moved and length > tiny and moved > tiny


@bare
def _sample(k, start, controls, draws, action, body, fields, discs, arm, sizes, rules, scratch, out):
    """All rollouts of control sequence k."""
    # arrays in tuples are counted in and out wherever they are taken out: once here
    px, py, starts, order = body
    flat, origin, normal = fields
    bound, bound_origin, centres = discs
    table, base, bounds, limits = arm
    states, moved, contact, twin, checks = out
    every_state, every_flag, every_group, every_ahead, every_likely = scratch
    state, strayed, stuck = every_state[k], every_flag[k, 0], every_flag[k, 1]
    group, ahead, likely = every_group[k], every_ahead[k], every_likely[k]
    push_cosine, holds, mini_steps = rules[0], rules[1] > 0.0, int(rules[2])
    scale = sizes[2]
    _, rollouts, horizon, parts = draws.shape
    groups, checked = 1, 0
    free_x, free_y, free_yaw = float(start[0]), float(start[1]), float(start[2])
    left = residual(free_x, free_y, free_yaw, table, base, limits)
    state[0, _X], state[0, _Y], state[0, _YAW] = free_x, free_y, free_yaw
    state[0, _COS], state[0, _SIN] = math.cos(free_yaw), math.sin(free_yaw)
    for m in range(rollouts):
        for axis in range(3):
            states[k, m, 0, axis] = start[axis]
            moved[k, m, 0, axis] = 0.0
    for h in range(horizon):
        ux, uy, uyaw = controls[k, h, 0] * action[0], controls[k, h, 1] * action[1], controls[k, h, 2] * action[2]
        free_x, free_y, free_yaw, left = step_within(
            free_x, free_y, free_yaw, free_x + ux, free_y + uy, free_yaw + uyaw, left, table, base, bounds, limits
        )
        for g in range(groups):
            x, y, yaw = state[g, _X], state[g, _Y], state[g, _YAW]
            to_x, to_y, to_yaw = free_x, free_y, free_yaw
            if strayed[g]:
                rest = residual(x, y, yaw, table, base, limits)
                to_x, to_y, to_yaw, _ = step_within(
                    x, y, yaw, x + ux, y + uy, yaw + uyaw, rest, table, base, bounds, limits
                )
            stuck[g] = False
            state[g, _WAY_X] = (to_x - x) / mini_steps
            state[g, _WAY_Y] = (to_y - y) / mini_steps
            state[g, _WAY_YAW] = (to_yaw - yaw) / mini_steps
        for m in range(rollouts):
            contact[k, m, h] = False
        for mini in range(mini_steps):
            part = min(mini, parts - 1)
            for g in range(groups):  # those that split off below have done this mini step
                if stuck[g]:
                    continue
                level = 2.0
                for m in range(rollouts):
                    if group[m] == g:
                        level = min(level, draws[k, m, h, part])
                x, y = state[g, _X] + state[g, _WAY_X], state[g, _Y] + state[g, _WAY_Y]
                yaw = state[g, _YAW] + state[g, _WAY_YAW]
                cos, sin = math.cos(yaw), math.sin(yaw)
                u, v = x - state[g, _OFFSET_X], y - state[g, _OFFSET_Y]
                most, point, looked = _touch(
                    u,
                    v,
                    cos,
                    sin,
                    level,
                    px,
                    py,
                    starts,
                    order,
                    flat,
                    origin,
                    bound,
                    bound_origin,
                    centres,
                    sizes,
                    ahead,
                    likely,
                )
                checked += looked
                those = -1  # the group of those that touch
                if point >= 0:
                    every = True
                    for m in range(rollouts):
                        if group[m] == g and not draws[k, m, h, part] < most:
                            every = False
                    those = g if every else groups
                    for m in range(rollouts):
                        if group[m] == g and draws[k, m, h, part] < most:
                            group[m] = those
                            contact[k, m, h] = True
                    tx, ty = px[point], py[point]
                    dx = (cos - state[g, _COS]) * tx - (sin - state[g, _SIN]) * ty + state[g, _WAY_X]
                    dy = (sin - state[g, _SIN]) * tx + (cos - state[g, _COS]) * ty + state[g, _WAY_Y]
                    pushed = _pushes(u, v, cos, sin, tx, ty, dx, dy, normal, origin, scale, push_cosine)
                    if not every:
                        groups += 1
                        for column in range(state.shape[1]):
                            state[those, column] = state[g, column]
                        strayed[those] = strayed[g]
                        stuck[those] = False
                    if pushed:
                        state[those, _X], state[those, _Y], state[those, _YAW] = x, y, yaw
                        state[those, _COS], state[those, _SIN] = cos, sin
                        state[those, _OFFSET_X] += dx
                        state[those, _OFFSET_Y] += dy
                    else:
                        strayed[those] = True
                        stuck[those] = holds
                if those != g:
                    state[g, _X], state[g, _Y], state[g, _YAW] = x, y, yaw
                    state[g, _COS], state[g, _SIN] = cos, sin
        for m in range(rollouts):
            g = group[m]
            states[k, m, h + 1, 0], states[k, m, h + 1, 1] = state[g, _X], state[g, _Y]
            states[k, m, h + 1, 2] = state[g, _YAW]
            moved[k, m, h + 1, 0], moved[k, m, h + 1, 1] = state[g, _OFFSET_X], state[g, _OFFSET_Y]
            moved[k, m, h + 1, 2] = 0.0
    checks[k] = checked
    for m in range(rollouts):
        twin[k, m] = m
        for other in range(m):
            if group[other] == group[m]:
                twin[k, m] = other
                break


def _push_rollouts(start, controls, draws, action, body, fields, discs, arm, sizes, rules, scratch, out, part):
    for k in indices(part, len(controls)):
        _sample(k, start, controls, draws, action, body, fields, discs, arm, sizes, rules, scratch, out)


push_rollouts = Kernel(_push_rollouts)
