"""The compiled CPU version of a step against the arm's reach; `tool.py` has the definition.

What limits a step comes as `Tool.arm_arrays` gives it, here `arm`: four arrays, the last of numbers. Tables are over
(radius, yaw), in space with heights before these, or (`ArmReach`) over (height, x, y, yaw): numba compiles
`if table.ndim == 3` away, of an argument alone; in a plane heights are handed through.
"""

import math

from sdf.compiled import bare


@bare
def _wrapped(angle):
    turned = angle + math.pi
    # most angles are there already; a remainder takes longer than all else
    return (turned if 0.0 <= turned < 2.0 * math.pi else turned % (2.0 * math.pi)) - math.pi


@bare
def _within(value, low, high):
    return min(max(value, low), high)


@bare
def _boxed(x, y, z, bounds):
    """A place within the bounds; in a plane heights are handed through."""
    if bounds.shape[1] == 3:
        z = _within(z, bounds[0, 2], bounds[1, 2])
    return _within(x, bounds[0, 0], bounds[1, 0]), _within(y, bounds[0, 1], bounds[1, 1]), z


@bare
def residual(x, y, z, yaw, table, base, limits):
    """What inverse kinematics leaves at a configuration, metres; linear between nodes, the last node's beyond them."""
    if limits[0] == 0.0:
        return 0.0
    return _residual_at(_place(x, y, z, table, base, limits), yaw, table, base, limits)


@bare
def _place(x, y, z, table, base, limits):
    """What the residual takes of a place, whatever the yaw is there: the way beyond the table, and three numbers."""
    if table.ndim == 4:
        layers, columns, rows = table.shape[0], table.shape[1], table.shape[2]
        u, v, w = (x - limits[7]) / limits[9], (y - limits[8]) / limits[9], (z - limits[5]) / limits[6]
        i, j, k = _within(u, 0.0, columns - 1.0), _within(v, 0.0, rows - 1.0), _within(w, 0.0, layers - 1.0)
        place = (limits[9] * (abs(u - i) + abs(v - j)), i, j, k)
    else:
        radius_step, sector, rows = limits[5], limits[6], table.shape[-2]
        dx, dy = x - base[0], y - base[1]
        radius, direction = math.sqrt(dx * dx + dy * dy), math.atan2(dy, dx)
        side = abs(_wrapped(direction - base[2]))
        beyond = max(radius - (rows - 1) * radius_step, 0.0) + radius * max(side - sector, 0.0)
        place = (beyond, direction, _within(radius / radius_step, 0.0, rows - 1.0), z)
    return place


@bare
def _residual_at(place, yaw, table, base, limits):
    """The residual at a place and yaw."""
    if table.ndim == 4:
        value = _residual_in_box(place, yaw, table, limits)
    else:
        value = _residual_about_base(place, yaw, table, limits)
    return value


@bare
def _residual_in_box(place, yaw, table, limits):
    """The residual from a table over (height, x, y, yaw), and the way beyond it."""
    layers, columns, rows, turns = table.shape
    beyond, i, j, k = place
    t = _within((_wrapped(yaw) + math.pi) / limits[10], 0.0, turns - 1.0)
    i0, j0, k0, t0 = (
        min(int(i), columns - 2),
        min(int(j), rows - 2),
        max(min(int(k), layers - 2), 0),
        min(int(t), turns - 2),
    )
    value = 0.0
    for corner in range(16):
        a, b, c, d = corner & 1, (corner >> 1) & 1, (corner >> 2) & 1, corner >> 3
        share = (i - i0 if a else 1.0 - (i - i0)) * (j - j0 if b else 1.0 - (j - j0))
        share *= (k - k0 if c else 1.0 - (k - k0)) * (t - t0 if d else 1.0 - (t - t0))
        if share > 0.0:
            value += share * table[min(k0 + c, layers - 1), i0 + a, j0 + b, t0 + d]
    return value + beyond


@bare
def _residual_about_base(place, yaw, table, limits):
    """The residual from a table over (radius, yaw from the radial direction), in space over height before these."""
    beyond, direction, u, z = place
    rows, columns = table.shape[-2], table.shape[-1]
    turned = abs(_wrapped(yaw - direction))
    v = _within(turned / math.pi * (columns - 1.0), 0.0, columns - 1.0)
    i, j = min(int(u), max(rows - 2, 0)), min(int(v), max(columns - 2, 0))
    a, b = u - i, v - j
    if table.ndim == 3:
        low, high, layers = limits[7], limits[8], table.shape[0]
        w = _within((z - low) / (high - low) * (layers - 1.0), 0.0, layers - 1.0)
        k = min(int(w), layers - 2)
        c = w - k
        value = 0.0
        for layer in range(2):
            share = c if layer else 1.0 - c
            for row in range(2):
                part = share * (a if row else 1.0 - a)
                first, second = table[k + layer, i + row, j], table[k + layer, i + row, j + 1]
                value += part * (first + b * (second - first))
    else:
        i1, j1 = min(i + 1, rows - 1), min(j + 1, columns - 1)
        near = table[i, j] + b * (table[i, j1] - table[i, j])
        far = table[i1, j] + b * (table[i1, j1] - table[i1, j])
        value = near + a * (far - near)
    return value + beyond


@bare
def _leg(x, y, z, yaw, to_x, to_y, to_z, to_yaw, limit, arm):
    """Where a leg from (x, y, z, yaw) ends, and the arm's residual there."""
    table, base, bounds, limits = arm
    aim = _place(to_x, to_y, to_z, table, base, limits)
    rest = _residual_at(aim, to_yaw, table, base, limits)
    if rest <= limit:
        return to_x, to_y, to_z, to_yaw, rest
    # as far as the arm gets on the straight way, a part of the leg at a time
    passed, parts = 0, int(limits[3])
    for part in range(1, parts):
        share = part / parts
        here_x, here_y, here_z = x + share * (to_x - x), y + share * (to_y - y), z + share * (to_z - z)
        if residual(here_x, here_y, here_z, yaw + share * (to_yaw - yaw), table, base, limits) > limit:
            break
        passed = part
    share = passed / parts
    x, y, z, yaw = x + share * (to_x - x), y + share * (to_y - y), z + share * (to_z - z), yaw + share * (to_yaw - yaw)
    # and from there round the limit: without the turn, along the circle, along it and turning with it
    rest = _residual_at(aim, yaw, table, base, limits)
    if rest <= limit:
        return to_x, to_y, to_z, yaw, rest
    from_x, from_y, aim_x, aim_y = x - base[0], y - base[1], to_x - base[0], to_y - base[1]
    stretch = math.sqrt(from_x * from_x + from_y * from_y) / max(math.sqrt(aim_x * aim_x + aim_y * aim_y), 1e-9)
    round_x = _within(base[0] + aim_x * stretch, bounds[0, 0], bounds[1, 0])
    round_y = _within(base[1] + aim_y * stretch, bounds[0, 1], bounds[1, 1])
    aim = _place(round_x, round_y, to_z, table, base, limits)
    rest = _residual_at(aim, to_yaw, table, base, limits)
    if rest <= limit:
        return round_x, round_y, to_z, to_yaw, rest
    carried = yaw + math.atan2(from_x * aim_y - from_y * aim_x, from_x * aim_x + from_y * aim_y)
    rest = _residual_at(aim, carried, table, base, limits)
    if rest <= limit:
        return round_x, round_y, to_z, carried, rest
    return x, y, z, yaw, residual(x, y, z, yaw, table, base, limits)


@bare
def step_within(x, y, z, yaw, to_x, to_y, to_z, to_yaw, left, arm):
    """Where a step from (x, y, z, yaw) ends, and the arm's residual there; `left` is it now."""
    table, base, bounds, limits = arm
    tolerance, slack, legs = limits[1], limits[2], int(limits[4])
    part_x, part_y, part_z, part_yaw = (to_x - x) / legs, (to_y - y) / legs, (to_z - z) / legs, (to_yaw - yaw) / legs
    to_x, to_y, to_z = _boxed(to_x, to_y, to_z, bounds)
    if limits[0] == 0.0:
        return to_x, to_y, to_z, to_yaw, 0.0
    rest = residual(to_x, to_y, to_z, to_yaw, table, base, limits)
    if rest <= max(left, tolerance) + slack:
        return to_x, to_y, to_z, to_yaw, rest
    for _ in range(legs):
        to_x, to_y, to_z = _boxed(x + part_x, y + part_y, z + part_z, bounds)
        limit = max(left, tolerance) + slack
        x, y, z, yaw, left = _leg(x, y, z, yaw, to_x, to_y, to_z, yaw + part_yaw, limit, arm)
    return x, y, z, yaw, left
