"""The Warp version of the displacement rollouts, lanes for each; `displacement_rollouts.py` has the definition."""

import math
from typing import Any

import torch
from torch import Tensor

from rumi.dynamics.base import PushRollouts
from rumi.dynamics.displacement_contact_warp import placed, pushes, touch, value_at
from rumi.dynamics.rollouts_warp import duplicates
from rumi.dynamics.sliding_warp import turn_by
from rumi.robot.tool_warp import free_path, residual, step_within
from sdf import gpu

wp = gpu.warp()


@wp.func
def _configuration(path: wp.array3d(dtype=Any), k: int, t: int):
    """(x, y, z, yaw), z 0 in a plane."""
    last = path.shape[2] - 1
    z = path.dtype(0.0)
    if last == 3:
        z = path[k, t, 2]
    return wp.vector(path[k, t, 0], path[k, t, 1], z, path[k, t, last])


@wp.func
def _place(q: Any, offset: Any):
    """Where the tool is for an object that has been moved."""
    return wp.vector(q[0] - offset[0], q[1] - offset[1], q[2])


@gpu.Kernel
def _roll_out(
    path: wp.array3d(dtype=Any),
    controls: wp.array3d(dtype=Any),
    draws: wp.array4d(dtype=Any),
    scale: wp.array(dtype=Any),
    table: wp.array4d(dtype=Any),
    base: wp.array(dtype=Any),
    bounds: wp.array2d(dtype=Any),
    limits: gpu.Numbers(11),
    points: wp.array2d(dtype=Any),
    order: wp.array(dtype=wp.int64),
    starts: wp.array(dtype=wp.int64),
    discs: wp.array2d(dtype=Any),
    bound: wp.array3d(dtype=Any),
    bound_origin: wp.array(dtype=Any),
    probability: wp.array4d(dtype=Any),
    normals: wp.array4d(dtype=Any),
    origin: wp.array(dtype=Any),
    numbers: gpu.Numbers(3),
    mini_steps: int,
    holds: bool,
    guarded: bool,
    configurations: wp.array4d(dtype=Any),
    displacements: wp.array4d(dtype=Any),
    contact: wp.array3d(dtype=wp.bool),
    checked: wp.array2d(dtype=Any),
):
    k, m, lane = wp.tid()
    per_metre, tie, push_cosine = numbers[0], numbers[1], numbers[2]
    none, last = type(tie)(0.0), path.shape[2] - 1
    low = wp.vector(origin[0], origin[1], origin[2])
    now = _configuration(path, k, 0)
    offset = wp.vector(none, none)
    strayed = bool(False)  # was held up, hence off the free path
    count = int(0)
    for t in range(path.shape[1]):
        if t > 0:
            end = _configuration(path, k, t)
            if strayed:
                wanted = _configuration(controls, k, t - 1)
                z = none
                if last == 3:
                    z = scale[2]
                wanted = now + wp.cw_mul(wanted, wp.vector(scale[0], scale[1], z, scale[last]))
                left = residual(now, table, base, limits)
                end, left = step_within(now, wanted, left, table, base, bounds, limits, lane)
            way = (end - now) / type(tie)(mini_steps)
            met, stuck = bool(False), bool(False)  # held up, and would be again at every mini step left of this step
            for part in range(mini_steps):
                if not stuck:
                    free = now + way
                    turn = turn_by(free[3])
                    place = _place(free, offset)
                    point, looked = touch(
                        place,
                        turn,
                        draws[k, m, t - 1, wp.min(part, draws.shape[3] - 1)],
                        points,
                        order,
                        starts,
                        discs,
                        bound,
                        bound_origin,
                        probability,
                        low,
                        per_metre,
                        tie,
                        lane,
                    )
                    if looked:
                        count += 1
                    if point < 0:
                        now = free
                    else:
                        met = True
                        own = wp.vector(points[point, 0], points[point, 1], points[point, 2])
                        there = placed(place, turn, own)
                        level = wp.vector(own[0], own[1], none)
                        motion = placed(_place(free - now, wp.vector(none, none)), turn - turn_by(now[3]), level)
                        normal = wp.vector(
                            value_at(there, normals, 0, low, per_metre),
                            value_at(there, normals, 1, low, per_metre),
                            value_at(there, normals, 2, low, per_metre),
                        )
                        if pushes(normal, motion, push_cosine, last == 3):
                            offset = offset + wp.vector(motion[0], motion[1])
                            now = free
                            if guarded:
                                strayed = True
                                stuck = True
                        else:
                            strayed = True
                            stuck = holds or guarded
            contact[k, m, t - 1] = met
        configurations[k, m, t, 0] = now[0]
        configurations[k, m, t, 1] = now[1]
        if last == 3:
            configurations[k, m, t, 2] = now[2]
        configurations[k, m, t, last] = now[3]
        displacements[k, m, t, 0] = offset[0]
        displacements[k, m, t, 1] = offset[1]
        displacements[k, m, t, 2] = none
    steps = path.shape[0] * contact.shape[1] * contact.shape[2] * mini_steps
    checked[k, m] = type(tie)(count) / type(tie)(steps)


def rollouts(model: Any, configuration: Tensor, controls: Tensor, uniforms: Tensor, tie: float) -> PushRollouts:
    """The rollouts that given uniform numbers lead to; see `DisplacementRollouts.rollout_drawn`."""
    (samples, horizon, size), count, settings = controls.shape, uniforms.shape[1], model.settings
    path = free_path(model.limits, model.tool.scale, configuration[None], controls)
    configurations = path.new_empty(samples, count, horizon + 1, size)
    displacements = path.new_empty(samples, count, horizon + 1, 3)
    contact = path.new_empty(samples, count, horizon, dtype=torch.bool)
    checked = path.new_empty(samples, count)
    field, cover = model.field, model.cover
    probability = field.probability
    bound = probability.values.new_ones(1, 1, 1) if model.bound is None else model.bound.grid.values
    _roll_out.launch(
        (samples, count),
        path,
        controls,
        uniforms,
        model.tool.scale.to(controls),
        *model.limits,
        cover.sets,
        cover.order,
        cover.starts,
        cover.centres,
        bound,
        probability.origin if model.bound is None else model.bound.grid.origin,
        probability.values[..., None],
        field.normal.values,
        probability.origin,
        (1.0 / probability.spacing, tie, math.cos(settings.push_angle)),
        settings.mini_steps,
        settings.hazard != "per_mini_step",
        settings.guarded,
        configurations,
        displacements,
        contact,
        checked,
        lanes=True,
    )
    return PushRollouts(
        configurations,
        displacements,
        contact,
        checked.sum(),
        duplicates(contact),
    )
