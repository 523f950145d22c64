"""The compiled CPU version of updates by a pose reading; `pose_reading.py` has the definition."""

import math

from sdf.compiled import Kernel, bare
from sdf.part_numba import indices

_LOG_TAU = math.log(2.0 * math.pi)


@bare
def _wrapped(angle):
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@bare
def _log_normal(x, y, yaw, first, second, third):
    total = x * x / first + y * y / second + yaw * yaw / third + math.log(first) + math.log(second) + math.log(third)
    return -0.5 * (total + 3.0 * _LOG_TAU)


@bare
def _log_add(first, second):
    high, low = max(first, second), min(first, second)
    return high if low == -math.inf else high + math.log1p(math.exp(low - high))


def _update_by_reading(
    before,
    pushed,
    log_weights,
    normal,
    chance,
    value,
    noise,
    others,
    back,
    old_variance,
    pose,
    after,
    mean,
    by_other,
    old,
    numbers,
    sums,
    part,
):
    still, way_variance, radius, log_told, log_outlier, log_repeats = numbers
    for _ in indices(part, 1):
        for k in range(len(back)):
            old[k] = _log_normal(
                value[0] - back[k, 0],
                value[1] - back[k, 1],
                _wrapped(value[2] - back[k, 2]),
                old_variance[k, 0],
                old_variance[k, 1],
                old_variance[k, 2],
            )
        repeated = log_repeats + old[len(back) - 1]
        for a in range(len(others)):
            by_other[a] = -math.inf
        total = -math.inf
        told_sum, untold_sum = -math.inf, -math.inf
        for n in range(len(pushed)):
            x, y = pushed[n, 0] - before[n, 0], pushed[n, 1] - before[n, 1]
            way = math.sqrt(x * x + y * y) + radius * abs(pushed[n, 2] - before[n, 2])
            metres = still * still + way_variance * way
            turn = metres / (radius * radius)
            off_x, off_y, off_yaw = value[0] - pushed[n, 0], value[1] - pushed[n, 1], _wrapped(value[2] - pushed[n, 2])
            told = log_told + _log_normal(off_x, off_y, off_yaw, metres + noise[0], metres + noise[1], turn + noise[2])
            untold = -math.inf
            for a in range(len(others)):
                other = _log_normal(
                    off_x,
                    off_y,
                    off_yaw,
                    metres + noise[0] + others[a, 0],
                    metres + noise[1] + others[a, 1],
                    turn + noise[2] + others[a, 2],
                )
                by_other[a] = _log_add(by_other[a], log_weights[n] + other)
                if a < 2:
                    untold = _log_add(untold, log_outlier + other)
            both = _log_add(told, _log_add(untold, repeated))
            after[n] = log_weights[n] + both
            total = _log_add(total, after[n])
            told_sum = _log_add(told_sum, log_weights[n] + told)
            untold_sum = _log_add(untold_sum, log_weights[n] + untold)
            takes = 1.0 if chance[n] < math.exp(told - both) else 0.0
            for axis in range(3):
                variance = turn if axis == 2 else metres
                off = off_x if axis == 0 else off_y if axis == 1 else off_yaw
                gain = takes * variance / (variance + noise[axis])
                pose[n, axis] = pushed[n, axis] + gain * off + math.sqrt((1.0 - gain) * variance) * normal[n, axis]
        squares = 0.0
        mean[:] = 0.0
        for n in range(len(pushed)):
            after[n] -= total
            weight = math.exp(after[n])
            squares += weight * weight
            mean[0] += weight * (pose[n, 0] - pose[0, 0])
            mean[1] += weight * (pose[n, 1] - pose[0, 1])
            mean[2] += weight * _wrapped(pose[n, 2] - pose[0, 2])
        for axis in range(3):
            mean[axis] += pose[0, axis]
        sums[0], sums[1], sums[2] = total, math.exp(told_sum - total), math.exp(untold_sum - total)
        sums[3] = 1.0 / squares


update_by_reading = Kernel(_update_by_reading)
