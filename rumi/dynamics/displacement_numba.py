"""The compiled CPU version of the push rollouts; `displacement.py` has the definition.

Rollouts of one control sequence that have met the same so far are carried on as one group, which splits where some of
them touch and others do not: while nothing is touched, there is one group. One template for a tool that moves in a
plane and one that moves in space: in a plane `pz`, the heights of the tool's points, is None and fields have an axis
less, and numba compiles what needs them away.
"""

import math

import numpy as np
import torch

from rumi.dynamics.base import PushRollouts
from rumi.robot.tool_numba import residual, step_within
from sdf.compiled import Kernel, bare
from sdf.grid_numba import at, put
from sdf.part_numba import indices
from sdf.voxel_grid import VoxelGrid

# columns of a group's state
_X, _Y, _Z, _YAW, _WAY_X, _WAY_Y, _WAY_Z, _WAY_YAW, _OFFSET_X, _OFFSET_Y, _COS, _SIN = range(12)


@bare
def _value(grid, channel, x, y, z):
    """Multilinear value of a channel at lattice coordinates; zero fades in outside."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    value = 0.0
    if grid.ndim == 4:
        k = math.floor(z)
        c = z - k
        for di in range(2):
            for dj in range(2):
                for dk in range(2):
                    u, v, w = i + di, j + dj, k + dk
                    if 0 <= u < grid.shape[0] and 0 <= v < grid.shape[1] and 0 <= w < grid.shape[2]:
                        share = (a if di else 1.0 - a) * (b if dj else 1.0 - b) * (c if dk else 1.0 - c)
                        value += share * grid[u, v, w, channel]
    else:
        for di in range(2):
            for dj in range(2):
                if 0 <= i + di < grid.shape[0] and 0 <= j + dj < grid.shape[1]:
                    value += (a if di else 1.0 - a) * (b if dj else 1.0 - b) * grid[i + di, j + dj, channel]
    return value


@bare
def _bound(bound, x, y, z):
    """What the bound holds at the node next to lattice coordinates; 0 outside. A single node holds everywhere."""
    if bound.ndim == 3:
        if bound.size == 1:
            return bound[0, 0, 0]
        i, j, k = math.floor(x + 0.5), math.floor(y + 0.5), math.floor(z + 0.5)
        inside = 0 <= i < bound.shape[0] and 0 <= j < bound.shape[1] and 0 <= k < bound.shape[2]
        return bound[i, j, k] if inside else 0.0
    i = 0 if bound.shape[0] == 1 else math.floor(x + 0.5)
    j = 0 if bound.shape[1] == 1 else math.floor(y + 0.5)
    return bound[i, j] if 0 <= i < bound.shape[0] and 0 <= j < bound.shape[1] else 0.0


@bare
def _touch(
    x,
    y,
    z,
    cos,
    sin,
    level,
    px,
    py,
    pz,
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
):
    """Greatest contact probability of the tool's points if it is above `level`, and the first point that has it.

    Discs, in space balls, are looked into in the order of what they may hold, until none left can hold as much as was
    found.
    """
    width, depth, height, scale, tie = int(sizes[0]), int(sizes[1]), int(sizes[2]), sizes[3], sizes[4]
    kind, across, one = flat.dtype.type, np.int32(height), np.int32(1)
    slab = np.int32(depth * height)
    none, last_x, last_y, last_z = kind(0.0), kind(width - 1.001), kind(depth - 1.001), kind(height - 1.001)
    possible = False
    for d in range(len(centres)):
        cx = (x + cos * centres[d, 0] - sin * centres[d, 1] - bound_origin[0]) * scale
        cy = (y + sin * centres[d, 0] + cos * centres[d, 1] - bound_origin[1]) * scale
        cz = 0.0 if pz is None else (z + centres[d, 2] - bound_origin[2]) * scale
        ahead[d] = _bound(bound, cx, cy, cz)
        possible |= ahead[d] > level
    if not possible:
        return 0.0, -1, False
    # the field is padded by two nodes of zeros on each side, on which all that lies outside lands
    place_x, place_y = kind((x - origin[0]) * scale + 2.0), kind((y - origin[1]) * scale + 2.0)
    turn_x, turn_y = kind(cos * scale), kind(sin * scale)
    if pz is not None:
        place_z, rise = kind((z - origin[2]) * scale + 2.0), kind(scale)
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
        for n in range(first, last):
            u = place_x + turn_x * at(px, n) - turn_y * at(py, n)
            v = place_y + turn_y * at(px, n) + turn_x * at(py, n)
            u, v = u if u > none else none, v if v > none else none
            u, v = u if u < last_x else last_x, v if v < last_y else last_y
            i, j = np.int32(u), np.int32(v)
            a, b = u - kind(i), v - kind(j)
            if pz is None:
                near = i * slab + j
                far = near + slab
                low, high = at(flat, near), at(flat, far)
                low += b * (at(flat, near + one) - low)
                high += b * (at(flat, far + one) - high)
            else:
                w = place_z + rise * at(pz, n)
                w = w if w > none else none
                w = w if w < last_z else last_z
                k = np.int32(w)
                c = w - kind(k)
                near = i * slab + j * across + k
                low = at(flat, near) + c * (at(flat, near + one) - at(flat, near))
                side = near + across
                high = at(flat, side) + c * (at(flat, side + one) - at(flat, side))
                low += b * (high - low)
                near += slab
                first_far = at(flat, near) + c * (at(flat, near + one) - at(flat, near))
                side = near + across
                high = at(flat, side) + c * (at(flat, side + one) - at(flat, side))
                high = first_far + b * (high - first_far)
            put(likely, n, low + a * (high - low))
        for n in range(first, last):
            most = max(most, likely[n])
    best, first = -1, len(px)
    if level < most:
        for d in range(len(centres)):
            if ahead[d] == -2.0:
                for n in range(starts[d], starts[d + 1]):
                    if likely[n] >= most - tie and order[n] < first:
                        best, first = n, order[n]
    return most, best, True


@bare
def _pushes(x, y, z, cos, sin, tx, ty, tz, dx, dy, dz, normal, origin, scale, push_cosine):
    """Whether the motion of the tool's point goes into the surface within the push angle, in space also sideways."""
    tiny = 1e-6
    gx, gy = (x + cos * tx - sin * ty - origin[0]) * scale, (y + sin * tx + cos * ty - origin[1]) * scale
    gz = 0.0
    if normal.ndim == 4:
        gz = (z + tz - origin[2]) * scale
    nx, ny, nz = _value(normal, 0, gx, gy, gz), _value(normal, 1, gx, gy, gz), _value(normal, 2, gx, gy, gz)
    if normal.ndim == 4:
        level = math.sqrt(nx * nx + ny * ny)
        length, moved = math.sqrt(level * level + nz * nz), math.sqrt(dx * dx + dy * dy + dz * dz)
        inward = -(nx * dx + ny * dy + nz * dz)
        return inward > push_cosine * length * moved and length > tiny and moved > tiny and level >= abs(nz)
    length, moved = math.sqrt(nx * nx + ny * ny + nz * nz), math.sqrt(dx * dx + dy * dy)
    return -(nx * dx + ny * dy) > push_cosine * length * moved and length > tiny and moved > tiny


@bare
def _sample(k, start, controls, draws, action, body, pz, fields, discs, arm, sizes, rules, scratch, out):
    """All rollouts of control sequence k."""
    # arrays in tuples are counted in and out wherever they are taken out: once here
    px, py, starts, order = body
    flat, origin, normal = fields
    bound, bound_origin, centres = discs
    tables, base, bounds, limits = arm
    states, moved, contact, duplicate_of, checks = out
    every_state, every_flag, every_group, every_ahead, every_likely = scratch
    state, strayed, stuck = every_state[k], every_flag[k, 0], every_flag[k, 1]
    group, ahead, likely = every_group[k], every_ahead[k], every_likely[k]
    push_cosine, holds, mini_steps = rules[0], rules[1] > 0.0, int(rules[2])
    scale = sizes[3]
    _, rollouts, horizon, parts = draws.shape
    groups, checked = 1, 0
    free_x, free_y, free_z, free_yaw = float(start[0]), float(start[1]), 0.0, float(start[-1])
    if pz is not None:
        free_z = float(start[2])
    left = residual(free_x, free_y, free_z, free_yaw, tables, base, limits)
    state[0, _X], state[0, _Y], state[0, _Z], state[0, _YAW] = free_x, free_y, free_z, free_yaw
    state[0, _COS], state[0, _SIN] = math.cos(free_yaw), math.sin(free_yaw)
    for m in range(rollouts):
        for axis in range(len(start)):
            states[k, m, 0, axis] = start[axis]
        for axis in range(3):
            moved[k, m, 0, axis] = 0.0
    for h in range(horizon):
        ux, uy = controls[k, h, 0] * action[0], controls[k, h, 1] * action[1]
        if pz is None:
            uz, uyaw = 0.0, controls[k, h, 2] * action[2]
        else:
            uz, uyaw = controls[k, h, 2] * action[2], controls[k, h, 3] * action[3]
        free_x, free_y, free_z, free_yaw, left, _, _ = step_within(
            free_x,
            free_y,
            free_z,
            free_yaw,
            free_x + ux,
            free_y + uy,
            free_z + uz,
            free_yaw + uyaw,
            left,
            tables,
            base,
            bounds,
            limits,
        )
        for g in range(groups):
            x, y, z, yaw = state[g, _X], state[g, _Y], state[g, _Z], state[g, _YAW]
            to_x, to_y, to_z, to_yaw = free_x, free_y, free_z, free_yaw
            if strayed[g]:
                rest = residual(x, y, z, yaw, tables, base, limits)
                to_x, to_y, to_z, to_yaw, _, _, _ = step_within(
                    x, y, z, yaw, x + ux, y + uy, z + uz, yaw + uyaw, rest, tables, base, bounds, limits
                )
            stuck[g] = False
            state[g, _WAY_X] = (to_x - x) / mini_steps
            state[g, _WAY_Y] = (to_y - y) / mini_steps
            state[g, _WAY_Z] = (to_z - z) / mini_steps
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
                z, yaw = state[g, _Z] + state[g, _WAY_Z], state[g, _YAW] + state[g, _WAY_YAW]
                cos, sin = math.cos(yaw), math.sin(yaw)
                u, v = x - state[g, _OFFSET_X], y - state[g, _OFFSET_Y]
                most, point, looked = _touch(
                    u,
                    v,
                    z,
                    cos,
                    sin,
                    level,
                    px,
                    py,
                    pz,
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
                    tx, ty, tz = px[point], py[point], 0.0
                    if pz is not None:
                        tz = pz[point]
                    dx = (cos - state[g, _COS]) * tx - (sin - state[g, _SIN]) * ty + state[g, _WAY_X]
                    dy = (sin - state[g, _SIN]) * tx + (cos - state[g, _COS]) * ty + state[g, _WAY_Y]
                    dz = state[g, _WAY_Z]
                    pushed = _pushes(u, v, z, cos, sin, tx, ty, tz, dx, dy, dz, normal, origin, scale, push_cosine)
                    if not every:
                        groups += 1
                        for column in range(state.shape[1]):
                            state[those, column] = state[g, column]
                        strayed[those] = strayed[g]
                        stuck[those] = False
                    if pushed:
                        state[those, _X], state[those, _Y], state[those, _Z] = x, y, z
                        state[those, _YAW], state[those, _COS], state[those, _SIN] = yaw, cos, sin
                        state[those, _OFFSET_X] += dx
                        state[those, _OFFSET_Y] += dy
                    else:
                        strayed[those] = True
                        stuck[those] = holds
                if those != g:
                    state[g, _X], state[g, _Y], state[g, _Z] = x, y, z
                    state[g, _YAW], state[g, _COS], state[g, _SIN] = yaw, cos, sin
        for m in range(rollouts):
            g = group[m]
            states[k, m, h + 1, 0], states[k, m, h + 1, 1] = state[g, _X], state[g, _Y]
            if pz is None:
                states[k, m, h + 1, 2] = state[g, _YAW]
            else:
                states[k, m, h + 1, 2], states[k, m, h + 1, 3] = state[g, _Z], state[g, _YAW]
            moved[k, m, h + 1, 0], moved[k, m, h + 1, 1] = state[g, _OFFSET_X], state[g, _OFFSET_Y]
            moved[k, m, h + 1, 2] = 0.0
    checks[k] = checked
    for m in range(rollouts):
        duplicate_of[k, m] = m
        for other in range(m):
            if group[other] == group[m]:
                duplicate_of[k, m] = other
                break


def _push_rollouts(start, controls, draws, action, body, pz, fields, discs, arm, sizes, rules, scratch, out, part):
    for k in indices(part, len(controls)):
        _sample(k, start, controls, draws, action, body, pz, fields, discs, arm, sizes, rules, scratch, out)


push_rollouts = Kernel(_push_rollouts)


def _spread(values, widths, margin, result, part):
    rows, columns = values.shape
    middle = len(widths) // 2
    for x in indices(part, len(result)):
        found = result[x]
        for row in range(len(widths)):
            source = x + row - 2 * middle
            if widths[row] >= 0 and 0 <= source < rows:
                for shift in range(margin - widths[row], margin + widths[row] + 1):
                    for y in range(columns):
                        found[y + shift] = max(found[y + shift], values[source, y])


spread = Kernel(_spread, fast=True)


class CompiledRollouts:
    """The compiled version of `rollout_drawn`, for a tool that moves in a plane or in space.

    Skipped, with the same result: points of discs that cannot hold the greatest contact probability; and all of a
    rollout that has met the same as another of its control sequence so far.

    Args:
        model: whose fields, points and bound are looked up.
        tie: contact probabilities closer than this are equal.
    """

    def __init__(self, model, tie):
        probability, normal = model.grids
        self._spatial = model.tool.spatial
        axes = 3 if self._spatial else 2
        centres = model.points.new_zeros(1, 3)
        # without a bound, one disc that may always touch
        bound = VoxelGrid(torch.ones_like(probability.values[:1, :1, :1]), probability.origin, probability.spacing)
        if model.bound is not None:
            centres, bound = model.bound.centres_t, model.bound.grid
        owner = torch.cdist(model.points[:, :axes], centres[:, :axes]).argmin(-1)
        starts = torch.searchsorted(owner.sort().values, torch.arange(len(centres) + 1))
        order = owner.argsort(stable=True)
        values = [
            grid if self._spatial else grid[:, :, 0] for grid in (probability.values, normal.values, bound.values)
        ]
        padded = torch.nn.functional.pad(values[0], [2] * 2 * axes)
        along, across, up = _arrays(*model.points[order].unbind(-1))
        self._body = (along, across, *_arrays(starts, order))
        self._heights = up if self._spatial else None
        self._fields = _arrays(padded.flatten(), probability.origin, values[1])
        self._discs = _arrays(values[2], bound.origin, centres)
        (self._action,) = _arrays(model.tool.scale)
        self._arm = model.tool.arm_arrays()
        self._sizes = np.array((*padded.shape, *(1,) * (3 - axes), 1.0 / probability.spacing, tie))
        settings = model.settings
        holds = settings.hazard != "per_mini_step"
        self._rules = np.array((math.cos(settings.push_angle), holds, settings.mini_steps))
        self._mini_steps = settings.mini_steps

    def __call__(self, configuration, controls, uniforms):
        """The rollouts that given uniform numbers lead to."""
        (samples, horizon, _), rollouts = controls.shape, uniforms.shape[1]
        states = controls.new_empty(samples, rollouts, horizon + 1, len(configuration))
        moved = controls.new_empty(samples, rollouts, horizon + 1, 3)
        contact = torch.empty(samples, rollouts, horizon, dtype=torch.bool)
        duplicate_of = torch.empty(samples, rollouts, dtype=torch.long)
        checks = torch.zeros(samples, dtype=torch.long)
        push_rollouts(
            *_arrays(configuration, controls, uniforms),
            self._action,
            self._body,
            self._heights,
            self._fields,
            self._discs,
            self._arm,
            self._sizes,
            self._rules,
            self._scratch(samples, rollouts),
            tuple(part.numpy() for part in (states, moved, contact, duplicate_of, checks)),
        )
        whole = samples * rollouts * horizon * self._mini_steps
        return PushRollouts(states, moved, contact, int(checks.sum()) / max(1, whole), duplicate_of)

    def _scratch(self, samples, rollouts):
        """Room to work in, by control sequence: state, flags and number of each group; bounds; probabilities."""
        return (
            np.zeros((samples, rollouts, 12)),
            np.zeros((samples, 2, rollouts), np.bool_),
            np.zeros((samples, rollouts), np.int64),
            np.empty((samples, len(self._discs[2]))),
            np.empty((samples, len(self._body[0])), self._fields[0].dtype),
        )


def _arrays(*tensors):
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)
