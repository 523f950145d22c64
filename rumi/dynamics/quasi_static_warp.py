"""The Warp version of the quasi-static rollouts, lanes for each; `quasi_static.py` and `sliding.py` define them.

Lanes share the groups of the tool's points among them, and each of them then moves the object alike.
"""

import math
from typing import Any

import torch
from torch import Tensor

from rumi.dynamics.base import PushRollouts
from rumi.dynamics.rollouts_warp import duplicates
from rumi.dynamics.sliding import Sliding
from rumi.dynamics.sliding_warp import (
    distance_at,
    gradient_at,
    place_of,
    pushed_out,
    rotated,
    rotated_back,
    turn_by,
)
from rumi.robot.border import BORDER_GROUP
from rumi.robot.tool_warp import free_path
from sdf import gpu
from sdf.lanes_warp import greatest, least

wp = gpu.warp()


@wp.func
def _deepest(
    place: Any,
    turn: Any,
    points: wp.array2d(dtype=Any),
    order: wp.array(dtype=wp.int64),
    centres: wp.array2d(dtype=Any),
    radii: wp.array(dtype=Any),
    values: wp.array2d(dtype=Any),
    origin: Any,
    spacing: Any,
    steepness: Any,
    slack: Any,
    lane: int,
):
    """The tool's point that is deepest in the object, its depth, and how far the tool may go at least until it touches.

    The tool is at (place, turn) in the object's frame. Depths of points change by `steepness` a metre, at most. The way
    is 0 where there is such a point, which is -1 where there is none.
    """
    depth, gap, best, first = type(spacing)(0.0), type(spacing)(1e9), int(-1), points.shape[0] + 0
    low = origin
    high = origin + type(origin)(type(spacing)(values.shape[0] - 1), type(spacing)(values.shape[1] - 1)) * spacing
    for group in range(lane, centres.shape[0], wp.block_dim()):
        centre = place + rotated(wp.vector(centres[group, 0], centres[group, 1]), turn)
        inside = wp.min(wp.max(low, centre), high)
        node = (inside - origin) / spacing
        there = values[int(node[0] + type(spacing)(0.5)), int(node[1] + type(spacing)(0.5))]
        beyond = wp.length(centre - inside)
        if beyond > type(spacing)(0.0):
            there = wp.sqrt(there * there + beyond * beyond)
        clear = there - (radii[group] + slack)
        if -clear < depth:
            gap = wp.min(gap, clear)
            continue
        nearest = type(spacing)(1e9)
        for k in range(BORDER_GROUP * group, BORDER_GROUP * (group + 1)):
            # beyond the table is outside of the object, as its border is
            point = place + rotated(wp.vector(points[k, 0], points[k, 1]), turn)
            distance = distance_at(point, values, origin, spacing)
            nearest = wp.min(nearest, distance)
            within = -distance
            if within > depth or (within == depth and within > type(spacing)(0.0) and int(order[k]) < first):
                depth = within
                best = k
                first = int(order[k])
        gap = wp.min(gap, wp.max(clear, nearest / steepness))
    most = greatest(depth)
    if most <= type(spacing)(0.0):
        return most, int(-1), least(gap)
    if depth < most:
        first = points.shape[0] + 0
    if least(first) != first:  # the first of the tool's points that are as deep
        best = -1
    return most, greatest(best), type(spacing)(0.0)


@wp.func
def _push(
    pose: Any,
    before: Any,
    after: Any,
    points: wp.array2d(dtype=Any),
    order: wp.array(dtype=wp.int64),
    centres: wp.array2d(dtype=Any),
    radii: wp.array(dtype=Any),
    values: wp.array2d(dtype=Any),
    origin: Any,
    spacing: Any,
    steepness: Any,
    slack: Any,
    passes: int,
    centre: Any,
    lever: Any,
    friction: Any,
    quartic: Any,
    lane: int,
):
    """Pose after one small motion of the tool, whether it was met, and how far the tool may go on; see `push`."""
    first = pose
    touched = bool(False)
    gap = type(spacing)(0.0)
    tool_turn = turn_by(after[2])
    for _ in range(passes):
        turn = turn_by(pose[2])
        place = rotated_back(place_of(after) - place_of(pose), turn)
        depth, index, gap = _deepest(
            place,
            rotated_back(tool_turn, turn),
            points,
            order,
            centres,
            radii,
            values,
            origin,
            spacing,
            steepness,
            slack,
            lane,
        )
        if index < 0:
            break
        touched = True
        arm = rotated(wp.vector(points[index, 0], points[index, 1]), tool_turn)
        gradient = gradient_at(place + rotated_back(arm, turn), values, origin, spacing)
        inward = -rotated(gradient / wp.max(wp.length(gradient), type(spacing)(1e-9)), turn)
        point = place_of(after) + arm
        pose = pushed_out(pose, first, before, after, point, inward, depth, centre, lever, friction, quartic)
    return pose, touched, gap


@gpu.Kernel
def _roll_out(
    path: wp.array3d(dtype=Any),
    poses: wp.array3d(dtype=Any),
    pivots: wp.array2d(dtype=Any),
    centre: wp.array2d(dtype=Any),
    lever: wp.array(dtype=Any),
    friction: wp.array(dtype=Any),
    quartic: wp.array2d(dtype=Any),
    points: wp.array2d(dtype=Any),
    order: wp.array(dtype=wp.int64),
    centres: wp.array2d(dtype=Any),
    radii: wp.array(dtype=Any),
    values: wp.array2d(dtype=Any),
    origin: wp.array(dtype=Any),
    numbers: gpu.Numbers(5),
    mini_steps: int,
    passes: int,
    configurations: wp.array4d(dtype=Any),
    displacements: wp.array4d(dtype=Any),
    turns: wp.array3d(dtype=Any),
    contact: wp.array3d(dtype=wp.bool),
    checked: wp.array2d(dtype=Any),
):
    k, m, lane = wp.tid()
    spacing, steepness, slack, reach, width = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    none = type(spacing)(0.0)
    scene = k * poses.shape[0] // path.shape[0]
    start = wp.vector(poses[scene, m, 0], poses[scene, m, 1], poses[scene, m, 2])
    pivot_arm = wp.vector(pivots[scene, 0], pivots[scene, 1]) - place_of(start)
    low = wp.vector(origin[0], origin[1])
    own_centre, own_quartic = wp.vector(centre[m, 0], centre[m, 1]), wp.vector(none, none, none, none, none)
    if quartic.shape[0] > 0:
        own_quartic = wp.vector(quartic[m, 0], quartic[m, 1], quartic[m, 2], quartic[m, 3], quartic[m, 4])
    now = start
    gap = none  # metres that the tool may go before it can touch
    count = int(0)
    for t in range(path.shape[1]):
        tool = wp.vector(path[k, t, 0], path[k, t, 1], path[k, t, 2])
        if t > 0:
            met = bool(False)
            begin = wp.vector(path[k, t - 1, 0], path[k, t - 1, 1], path[k, t - 1, 2])
            way = (tool - begin) / type(spacing)(mini_steps)
            far = wp.length(place_of(way)) + wp.abs(way[2]) * width
            for part in range(mini_steps):
                gap = gap - far
                if gap <= none:
                    before, after = begin + way * type(spacing)(part), begin + way * type(spacing)(part + 1)
                    apart = wp.length(place_of(after) - place_of(now))
                    if apart >= reach:
                        gap = apart - reach
                    else:
                        count += 1
                        now, touched, gap = _push(
                            now,
                            before,
                            after,
                            points,
                            order,
                            centres,
                            radii,
                            values,
                            low,
                            spacing,
                            steepness,
                            slack,
                            passes,
                            own_centre,
                            lever[m],
                            friction[m],
                            own_quartic,
                            lane,
                        )
                        met = met or touched
            contact[k, m, t - 1] = met
        for axis in range(lane, 3, wp.block_dim()):
            configurations[k, m, t, axis] = tool[axis]
        shift, turned = place_of(start) - place_of(start), now[2] - start[2]
        if not now == start:  # noqa: SIM201  (vectors have no `!=`)
            shift = place_of(now) - place_of(start) + (rotated(pivot_arm, turn_by(turned)) - pivot_arm)
        displacements[k, m, t, 0] = shift[0]
        displacements[k, m, t, 1] = shift[1]
        displacements[k, m, t, 2] = none
        turns[k, m, t] = turned
    steps = path.shape[0] * contact.shape[1] * contact.shape[2] * mini_steps
    checked[k, m] = type(spacing)(count) / type(spacing)(steps)


def rollouts(model: Any, configuration: Tensor, controls: Tensor, poses: Tensor, sliding: Sliding) -> PushRollouts:
    """The rollouts in which the object starts at given poses; see `QuasiStaticRollouts.rollout_poses`."""
    shape, horizon = (*controls.shape[:-2], poses.shape[-2]), controls.shape[-2]
    samples, count = math.prod(shape[:-1]), shape[-1]
    starts, controls = configuration.reshape(-1, 3), controls.reshape(samples, horizon, 3)
    path = free_path(model.limits, model.tool.scale, starts, controls)
    configurations, displacements = path.new_empty(2, samples, count, horizon + 1, 3)
    turns = path.new_empty(samples, count, horizon + 1)
    contact = path.new_empty(samples, count, horizon, dtype=torch.bool)
    checked = path.new_empty(samples, count)
    border, outline, settings = model.border, model.outline, model.settings
    quartic = turns.new_empty(0, 5) if sliding.quartic is None else sliding.quartic
    _roll_out.launch(
        (samples, count),
        path,
        poses.reshape(-1, count, 3).to(path),
        model.pivot.reshape(-1, 2),
        sliding.centre,
        sliding.lever,
        sliding.friction,
        quartic,
        border.sets.flatten(0, 1),
        border.groups.flatten(),
        border.centres,
        border.radii,
        outline.values,
        outline.origin,
        (outline.spacing, outline.steepness, outline.slack, model.reach, border.radius),
        settings.mini_steps,
        settings.passes,
        configurations,
        displacements,
        turns,
        contact,
        checked,
        lanes=True,
    )
    contact = contact.view(*shape, horizon)
    return PushRollouts(
        configurations.view(*shape, horizon + 1, 3),
        displacements.view(*shape, horizon + 1, 3),
        contact,
        checked.sum(),
        duplicates(contact),
        turns.view(*shape, horizon + 1),
        model.pivot,
    )
