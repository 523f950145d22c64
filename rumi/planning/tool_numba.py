"""The fused CPU version of a step against the arm's reach; `tool.py` has the definition."""

import math

import numba
from numba import prange

from sdf.fused import Kernel


@numba.njit(cache=True, error_model="numpy")
def _wrapped(angle):
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@numba.njit(cache=True, error_model="numpy")
def _residual(x, y, yaw, table, radius_step, sector, base):
    """What inverse kinematics leaves at a configuration, metres; bilinear in the table, the last node's beyond it."""
    dx, dy = x - base[0], y - base[1]
    radius, direction = math.sqrt(dx * dx + dy * dy), math.atan2(dy, dx)
    turned, side = abs(_wrapped(yaw - direction)), abs(_wrapped(direction - base[2]))
    rows, columns = table.shape
    last = (rows - 1) * radius_step
    beyond = max(radius - last, 0.0) + radius * max(side - sector, 0.0)
    u = min(max(radius / radius_step, 0.0), rows - 1.0)
    v = min(max(turned / math.pi * (columns - 1.0), 0.0), columns - 1.0)
    i, j = min(int(u), max(rows - 2, 0)), min(int(v), max(columns - 2, 0))
    i1, j1 = min(i + 1, rows - 1), min(j + 1, columns - 1)
    a, b = u - i, v - j
    low = table[i, j] + b * (table[i, j1] - table[i, j])
    high = table[i1, j] + b * (table[i1, j1] - table[i1, j])
    return low + a * (high - low) + beyond


@numba.njit(cache=True, error_model="numpy")
def _within(value, low, high):
    return min(max(value, low), high)


def _step_within(q, wanted, residual, table, radius_step, sector, base, bounds, tolerance, slack, parts, reached, left):
    for r in prange(len(q)):
        x, y, yaw = q[r, 0], q[r, 1], q[r, 2]
        to_x = _within(wanted[r, 0], bounds[0, 0], bounds[1, 0])
        to_y = _within(wanted[r, 1], bounds[0, 1], bounds[1, 1])
        to_yaw = wanted[r, 2]
        limit = max(residual[r], tolerance) + slack
        rest = _residual(to_x, to_y, to_yaw, table, radius_step, sector, base)
        if rest > limit:
            # as far as the arm gets on the straight way, a part of the step at a time
            passed = 0
            for part in range(1, parts):
                share = part / parts
                if (
                    _residual(
                        x + share * (to_x - x),
                        y + share * (to_y - y),
                        yaw + share * (to_yaw - yaw),
                        table,
                        radius_step,
                        sector,
                        base,
                    )
                    > limit
                ):
                    break
                passed = part
            share = passed / parts
            x, y, yaw = x + share * (to_x - x), y + share * (to_y - y), yaw + share * (to_yaw - yaw)
            # and from there round the limit: without the turn, along the circle, along it and turning with it
            from_x, from_y, aim_x, aim_y = x - base[0], y - base[1], to_x - base[0], to_y - base[1]
            stretch = math.sqrt(from_x * from_x + from_y * from_y) / max(math.sqrt(aim_x * aim_x + aim_y * aim_y), 1e-9)
            round_x = _within(base[0] + aim_x * stretch, bounds[0, 0], bounds[1, 0])
            round_y = _within(base[1] + aim_y * stretch, bounds[0, 1], bounds[1, 1])
            swing = math.atan2(from_x * aim_y - from_y * aim_x, from_x * aim_x + from_y * aim_y)
            turn = to_yaw
            to_yaw = yaw
            rest = _residual(to_x, to_y, to_yaw, table, radius_step, sector, base)
            if rest > limit:
                to_x, to_y, to_yaw = round_x, round_y, turn
                rest = _residual(to_x, to_y, to_yaw, table, radius_step, sector, base)
            if rest > limit:
                to_yaw = yaw + swing
                rest = _residual(to_x, to_y, to_yaw, table, radius_step, sector, base)
            if rest > limit:
                to_x, to_y, to_yaw = x, y, yaw
                rest = _residual(x, y, yaw, table, radius_step, sector, base)
        reached[r, 0], reached[r, 1], reached[r, 2], left[r] = to_x, to_y, to_yaw, rest


step_within = Kernel(_step_within)
