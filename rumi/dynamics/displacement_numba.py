"""The compiled CPU version of the push rollouts; `displacement_rollouts.py` has the definition.

Rollouts of one control sequence that have met the same so far are carried on as one group, which splits where some of
them touch and others do not: while nothing is touched, there is one group. One template for a tool that moves in a
plane and one that moves in space: in a plane `pz`, the heights of the tool's points, is None and fields have an axis
less, and numba compiles what needs them away.
"""

import math

import numpy as np
import torch

from rumi.dynamics.base import PushRollouts
from rumi.dynamics.displacement_contact_numba import pushes, touch
from rumi.robot.tool_numba import residual, step_within
from sdf.compiled import Kernel, arrays_of, bare
from sdf.part_numba import indices
from sdf.voxel_grid import VoxelGrid

# columns of a group's state
_X, _Y, _Z, _YAW, _WAY_X, _WAY_Y, _WAY_Z, _WAY_YAW, _OFFSET_X, _OFFSET_Y, _COS, _SIN = range(12)


@bare
def _sample(k, start, controls, draws, action, body, pz, fields, discs, arm, sizes, rules, scratch, out):
    """All rollouts of control sequence k."""
    # arrays in tuples are counted in and out wherever they are taken out: once here
    px, py, _, _ = body
    tables, base, _, limits = arm
    _, origin, normal = fields
    states, moved, contact, duplicate_of, checks = out
    every_state, every_flag, every_group, every_ahead, every_likely = scratch
    state, strayed, stuck = every_state[k], every_flag[k, 0], every_flag[k, 1]
    group, ahead, likely = every_group[k], every_ahead[k], every_likely[k]
    push_cosine, holds, mini_steps, guarded = rules[0], rules[1] > 0.0, int(rules[2]), rules[3] > 0.0
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
        to_x, to_y, to_z, to_yaw = free_x + ux, free_y + uy, free_z + uz, free_yaw + uyaw
        free_x, free_y, free_z, free_yaw, left = step_within(
            free_x, free_y, free_z, free_yaw, to_x, to_y, to_z, to_yaw, left, arm
        )
        for g in range(groups):
            x, y, z, yaw = state[g, _X], state[g, _Y], state[g, _Z], state[g, _YAW]
            to_x, to_y, to_z, to_yaw = free_x, free_y, free_z, free_yaw
            if strayed[g]:
                rest = residual(x, y, z, yaw, tables, base, limits)
                to_x, to_y, to_z, to_yaw, _ = step_within(x, y, z, yaw, x + ux, y + uy, z + uz, yaw + uyaw, rest, arm)
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
                most, point, looked = touch(u, v, z, cos, sin, level, body, pz, fields, discs, sizes, ahead, likely)
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
                    pushed = pushes(u, v, z, cos, sin, tx, ty, tz, dx, dy, dz, normal, origin, scale, push_cosine)
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
                    if guarded or not pushed:
                        strayed[those] = True
                        stuck[those] = guarded or holds
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
        cover = model.cover
        # without a bound, one disc that may always touch
        bound = VoxelGrid(torch.ones_like(probability.values[:1, :1, :1]), probability.origin, probability.spacing)
        if model.bound is not None:
            bound = model.bound.grid
        values = [
            grid if self._spatial else grid[:, :, 0] for grid in (probability.values, normal.values, bound.values)
        ]
        padded = torch.nn.functional.pad(values[0], [2] * 2 * axes)
        along, across, up = arrays_of(*cover.sets.unbind(-1))
        self._body = (along, across, *arrays_of(cover.starts, cover.order))
        self._heights = up if self._spatial else None
        self._fields = arrays_of(padded.flatten(), probability.origin, values[1])
        # nodes of zeros about the bound, on which all that lies outside lands; a single node holds everywhere
        wide = [int(size > 1) for size in values[2].shape]
        around = torch.nn.functional.pad(values[2], [side for width in reversed(wide) for side in (width, width)])
        nodes, wide = (*around.shape, 1)[:3], (*wide, 0)[:3]
        first = [float(begin) - width * probability.spacing for begin, width in zip(bound.origin, wide, strict=True)]
        numbers = np.array((*first, *(size - 1 for size in nodes), nodes[1] * nodes[2], nodes[2]))
        self._discs = (*arrays_of(around.flatten()), numbers, *arrays_of(cover.centres.mT.flatten().to(around)))
        (self._action,) = arrays_of(model.tool.scale)
        self._arm = model.tool.arm_arrays()
        self._sizes = np.array((*padded.shape, *(1,) * (3 - axes), 1.0 / probability.spacing, tie))
        settings = model.settings
        holds = settings.hazard != "per_mini_step"
        self._rules = np.array((math.cos(settings.push_angle), holds, settings.mini_steps, settings.guarded))
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
            *arrays_of(configuration, controls, uniforms),
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
            np.empty((samples, len(self._discs[2]) // 3), self._fields[0].dtype),
            np.empty((samples, len(self._body[0])), self._fields[0].dtype),
        )
