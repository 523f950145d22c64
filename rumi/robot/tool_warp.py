"""The Warp version of a tool's free path; `tool.py` and `reach.py` have the definition.

A configuration is (x, y, z, yaw); in a plane z is 0. What limits a step comes as `Tool.arm_tensors` gives it: the table
of what inverse kinematics leaves, always of four axes; the arm's base (x, y, yaw); the bounds (2, D); and numbers,
which are the kind of table, the tolerance, the slack, the parts of a leg, the legs of a step, and where the table's
nodes are. Lanes share the parts of a leg.
"""

import math
from typing import Any

from torch import Tensor

from sdf import gpu
from sdf.lanes_warp import least

wp = gpu.warp()

FREE, ABOUT_BASE, IN_BOX = range(3)
"""No arm; a table over (height, -, radius, yaw); one over (height, x, y, yaw)."""


@wp.func
def _wrapped(angle: Any):
    whole = type(angle)(2.0 * math.pi)
    return angle - whole * wp.floor((angle + type(angle)(math.pi)) / whole)


@wp.func
def _share(place: Any, count: int):
    """Node below a place in a table's axis, and the way from there to the next one; the ends' beyond the ends."""
    inside = wp.clamp(place, type(place)(0.0), type(place)(count - 1))
    low = wp.clamp(int(inside), 0, wp.max(count - 2, 0))
    return low, inside - type(place)(low)


@wp.func
def _look_up(table: wp.array4d(dtype=Any), k: Any, i: Any, j: Any, w: Any):
    """Multilinear value of a table between its nodes, the last node's beyond them."""
    k0, c = _share(k, table.shape[0])
    i0, a = _share(i, table.shape[1])
    j0, b = _share(j, table.shape[2])
    w0, d = _share(w, table.shape[3])
    k1, i1 = wp.min(k0 + 1, table.shape[0] - 1), wp.min(i0 + 1, table.shape[1] - 1)
    j1, w1 = wp.min(j0 + 1, table.shape[2] - 1), wp.min(w0 + 1, table.shape[3] - 1)
    low = wp.lerp(
        wp.lerp(
            wp.lerp(table[k0, i0, j0, w0], table[k0, i0, j0, w1], d),
            wp.lerp(table[k0, i0, j1, w0], table[k0, i0, j1, w1], d),
            b,
        ),
        wp.lerp(
            wp.lerp(table[k0, i1, j0, w0], table[k0, i1, j0, w1], d),
            wp.lerp(table[k0, i1, j1, w0], table[k0, i1, j1, w1], d),
            b,
        ),
        a,
    )
    if k1 == k0:
        return low
    high = wp.lerp(
        wp.lerp(
            wp.lerp(table[k1, i0, j0, w0], table[k1, i0, j0, w1], d),
            wp.lerp(table[k1, i0, j1, w0], table[k1, i0, j1, w1], d),
            b,
        ),
        wp.lerp(
            wp.lerp(table[k1, i1, j0, w0], table[k1, i1, j0, w1], d),
            wp.lerp(table[k1, i1, j1, w0], table[k1, i1, j1, w1], d),
            b,
        ),
        a,
    )
    return wp.lerp(low, high, c)


@wp.func
def residual(q: Any, table: wp.array4d(dtype=Any), base: wp.array(dtype=Any), numbers: Any):
    """What inverse kinematics leaves at a configuration, metres; see `Reach.residual` and `ArmReach.residual`."""
    none = type(numbers[0])(0.0)
    kind = int(numbers[0])
    if kind == FREE:
        return none
    if kind == IN_BOX:
        low, rise, left, bottom = numbers[5], numbers[6], numbers[7], numbers[8]
        step, turn = numbers[9], numbers[10]
        i, j, k = (q[0] - left) / step, (q[1] - bottom) / step, (q[2] - low) / rise
        last_i, last_j = type(none)(table.shape[1] - 1), type(none)(table.shape[2] - 1)
        beyond = step * (wp.abs(i - wp.clamp(i, none, last_i)) + wp.abs(j - wp.clamp(j, none, last_j)))
        return _look_up(table, k, i, j, (_wrapped(q[3]) + type(none)(math.pi)) / turn) + beyond
    radius_step, sector, lowest, highest = numbers[5], numbers[6], numbers[7], numbers[8]
    x, y = q[0] - base[0], q[1] - base[1]
    radius, direction = wp.sqrt(x * x + y * y), wp.atan2(y, x)
    turned, side = wp.abs(_wrapped(q[3] - direction)), wp.abs(_wrapped(direction - base[2]))
    last = type(none)(table.shape[2] - 1) * radius_step
    beyond = wp.max(radius - last, none) + radius * wp.max(side - sector, none)
    height = none
    if highest > lowest:
        height = (q[2] - lowest) / (highest - lowest) * type(none)(table.shape[0] - 1)
    yaw = turned / type(none)(math.pi) * type(none)(table.shape[3] - 1)
    return _look_up(table, height, none, radius / radius_step, yaw) + beyond


@wp.func
def _boxed(q: Any, bounds: wp.array2d(dtype=Any)):
    z = q[2]
    if bounds.shape[1] == 3:
        z = wp.clamp(z, bounds[0, 2], bounds[1, 2])
    x, y = wp.clamp(q[0], bounds[0, 0], bounds[1, 0]), wp.clamp(q[1], bounds[0, 1], bounds[1, 1])
    return type(q)(x, y, z, q[3])


@wp.func
def _leg(
    q: Any,
    reached: Any,
    limit: Any,
    table: wp.array4d(dtype=Any),
    base: wp.array(dtype=Any),
    bounds: wp.array2d(dtype=Any),
    numbers: Any,
    lane: int,
):
    """Where a leg from q to `reached` ends, and the arm's residual there."""
    rest = residual(reached, table, base, numbers)
    if rest <= limit:
        return reached, rest
    # as far as the arm gets on the straight way, a part of the leg at a time
    parts, stopped = int(numbers[3]), int(numbers[3])
    for part in range(1 + lane, parts, wp.block_dim()):
        share = type(limit)(part) / type(limit)(parts)
        if residual(q + (reached - q) * share, table, base, numbers) > limit:
            stopped = part
            break
    passed = least(stopped) - 1
    halfway = q + (reached - q) * (type(limit)(passed) / type(limit)(parts))
    # and from there round the limit: without the turn, along the circle, along it and turning with it
    straight = type(q)(reached[0], reached[1], reached[2], halfway[3])
    rest = residual(straight, table, base, numbers)
    if rest <= limit:
        return straight, rest
    x, y, target_x, target_y = halfway[0] - base[0], halfway[1] - base[1], reached[0] - base[0], reached[1] - base[1]
    length = wp.max(wp.sqrt(target_x * target_x + target_y * target_y), type(limit)(1e-9))
    stretch = wp.sqrt(x * x + y * y) / length
    turning = _boxed(
        type(q)(base[0] + target_x * stretch, base[1] + target_y * stretch, reached[2], reached[3]), bounds
    )
    rest = residual(turning, table, base, numbers)
    if rest <= limit:
        return turning, rest
    swing = wp.atan2(x * target_y - y * target_x, x * target_x + y * target_y)
    carried = type(q)(turning[0], turning[1], turning[2], halfway[3] + swing)
    rest = residual(carried, table, base, numbers)
    if rest <= limit:
        return carried, rest
    return halfway, residual(halfway, table, base, numbers)


@wp.func
def step_within(
    q: Any,
    wanted: Any,
    left: Any,
    table: wp.array4d(dtype=Any),
    base: wp.array(dtype=Any),
    bounds: wp.array2d(dtype=Any),
    numbers: Any,
    lane: int,
):
    """Where a step from q to `wanted` ends, and the arm's residual there; `left` is it now. See `limited_step`."""
    reached = _boxed(wanted, bounds)
    if int(numbers[0]) == FREE:
        return reached, left
    rest = residual(reached, table, base, numbers)
    if rest <= wp.max(left, numbers[1]) + numbers[2]:
        return reached, rest
    legs = int(numbers[4])
    part = (wanted - q) / type(left)(legs)
    now, now_left = type(q)(q), type(left)(left)
    for _ in range(legs):
        limit = wp.max(now_left, numbers[1]) + numbers[2]
        now, now_left = _leg(now, _boxed(now + part, bounds), limit, table, base, bounds, numbers, lane)
    return now, now_left


@gpu.Kernel
def _free_path(
    starts: wp.array2d(dtype=Any),
    controls: wp.array3d(dtype=Any),
    scale: wp.array(dtype=Any),
    table: wp.array4d(dtype=Any),
    base: wp.array(dtype=Any),
    bounds: wp.array2d(dtype=Any),
    numbers: gpu.Numbers(11),
    path: wp.array3d(dtype=Any),
):
    k, lane = wp.tid()
    start, last = k * starts.shape[0] // controls.shape[0], starts.shape[1] - 1
    none = starts.dtype(0.0)
    x, y, z, yaw = starts[start, 0], starts[start, 1], none, starts[start, last]
    if last == 3:
        z = starts[start, 2]
    q = wp.vector(x, y, z, yaw)
    left = residual(q, table, base, numbers)
    for h in range(path.shape[1]):
        path[k, h, 0] = q[0]
        path[k, h, 1] = q[1]
        if last == 3:
            path[k, h, 2] = q[2]
        path[k, h, last] = q[3]
        if h < controls.shape[1]:
            way_x, way_y = controls[k, h, 0] * scale[0], controls[k, h, 1] * scale[1]
            way_z, way_yaw = none, controls[k, h, last] * scale[last]
            if last == 3:
                way_z = controls[k, h, 2] * scale[2]
            wanted = q + wp.vector(way_x, way_y, way_z, way_yaw)
            q, left = step_within(q, wanted, left, table, base, bounds, numbers, lane)


def free_path(limits: tuple[Any, ...], scale: Tensor, starts: Tensor, controls: Tensor) -> Tensor:
    """Paths (K, H + 1, Q) with their starts, of which S (S, Q) are shared evenly by K controls in turn.

    Args:
        limits: of the steps, `Tool.arm_tensors`.
        scale: of a control, `Tool.scale`.
        starts: configurations.
        controls: in [-1, 1].
    """
    path = controls.new_empty(len(controls), controls.shape[1] + 1, starts.shape[1])
    _free_path.launch(len(controls), starts, controls, scale.to(controls), *limits, path, lanes=True)
    return path
