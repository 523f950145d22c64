"""The compiled CPU version of a reading's way into the belief; `pushed_pose_reading.py` has the definition."""

import math

import numpy as np

from rumi.dynamics.along_path_numba import advanced, measure, sliding_at
from sdf.compiled import Kernel, bare
from sdf.part_numba import indices

_LOG_TAU = math.log(2.0 * math.pi)


@bare
def _wrapped(angle):
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@bare
def _log_normal(x, y, yaw, first, second, third):
    total = x * x / first + y * y / second + yaw * yaw / third
    return -0.5 * (total + math.log(first * second * third) + 3.0 * _LOG_TAU)


@bare
def _log_add(first, second):
    high, low = max(first, second), min(first, second)
    return high if low == -math.inf else high + math.log1p(math.exp(low - high))


@bare
def _log_sum(terms):
    most, total = -math.inf, 0.0
    for n in range(len(terms)):
        most = max(most, terms[n])
    if most == -math.inf:
        return most
    for n in range(len(terms)):
        total += math.exp(terms[n] - most)
    return most + math.log(total)


@bare
def _log_old(reading, trail, last, lags, variance, old):
    """Densities of a reading about poses that it may repeat; see `PoseReading.back`."""
    for k in range(len(old)):
        if k == len(lags):
            x, y, yaw = last[0], last[1], last[2]
        else:
            x, y, yaw = trail[lags[k], 0], trail[lags[k], 1], trail[lags[k], 2]
        old[k] = _log_normal(
            reading[0] - x, reading[1] - y, _wrapped(reading[2] - yaw), variance[k, 0], variance[k, 1], variance[k, 2]
        )


@bare
def _push(before, tool, slides, path, contact, along, way, pose):
    """Poses after a path of the tool, by each particle's place of it."""
    for n in range(len(pose)):
        for k in range(len(path)):
            for axis in range(3):
                way[0, k, axis] = path[k, axis] + tool[n, axis]
        x, y, yaw = before[n, 0], before[n, 1], before[n, 2]
        body = sliding_at(n, slides)
        for instant in range(len(path) - 1):  # of a way that may have room for more
            x, y, yaw = advanced(x, y, yaw, way, 0, instant, contact, body, along)
        pose[n, 0], pose[n, 1], pose[n, 2] = x, y, yaw


@bare
def _variance(n, before, pose, numbers):
    """Variance along an axis and of the yaw after a motion; see `MotionNoise`."""
    still, way_variance, radius = numbers[0], numbers[1], numbers[2]
    x, y = pose[n, 0] - before[n, 0], pose[n, 1] - before[n, 1]
    way = math.sqrt(x * x + y * y) + radius * abs(pose[n, 2] - before[n, 2])
    metres = still * still + way_variance * way
    return metres, metres / (radius * radius)


@bare
def _follow(pose, after, trail, new_trail):
    """Effective sample size of the weights; the mean of poses that are near one place goes before the last ones."""
    for k in range(1, len(trail)):
        for axis in range(3):
            new_trail[k, axis] = trail[k - 1, axis]
    squares, x, y, yaw = 0.0, 0.0, 0.0, 0.0
    for n in range(len(pose)):
        weight = math.exp(after[n])
        squares += weight * weight
        x += weight * (pose[n, 0] - pose[0, 0])
        y += weight * (pose[n, 1] - pose[0, 1])
        yaw += weight * _wrapped(pose[n, 2] - pose[0, 2])
    new_trail[0, 0], new_trail[0, 1], new_trail[0, 2] = pose[0, 0] + x, pose[0, 1] + y, pose[0, 2] + yaw
    return 1.0 / squares


@bare
def _gather(ratios, log_sum, log_moment, number, log_shares, new_sum, new_moment):
    """Evidence of faults with one more reading, and in all; NaN where a ratio is. See `ChangeTest`, bound "rate"."""
    total = -math.inf
    for k in range(len(ratios)):
        if math.isnan(ratios[k]):
            return math.nan
        new_sum[k] = _log_add(log_sum[k], 0.0) + ratios[k]
        new_moment[k] = _log_add(log_moment[k], math.log(number)) + ratios[k]
        total = _log_add(total, log_shares[k] + new_sum[k])
    return total


def _take_reading(held, path, reading, last, evidence, drawn, contact, densities, numbers, found, part):
    before, tool, log_weights, slides, trail = held
    log_sum, log_moment = evidence
    normal, chance = drawn
    noise, others, old_variance, lags, log_shares = densities
    pose, after, new_trail, new_sum, new_moment, ratios, sums = found
    for _ in indices(part, 1):
        along, way = np.empty(len(contact[0])), np.empty((1, len(path), 3))
        terms, shares, lost = np.empty((1 + len(others), len(pose))), np.empty((2, len(pose))), np.empty(2)
        by_other, old = np.empty(len(others)), np.empty(len(old_variance))
        measure(contact, along)
        _push(before, tool, slides, path, contact, along, way, pose)
        _log_old(reading, trail, last, lags, old_variance, old)
        repeated = numbers[5] + old[len(lags)]
        # weights and poses given the reading; `pose` is where particles are pushed, see `update_by_reading`
        log_told, log_outlier = numbers[3], numbers[4]
        for n in range(len(pose)):
            metres, turn = _variance(n, before, pose, numbers)
            off_x, off_y, off_yaw = reading[0] - pose[n, 0], reading[1] - pose[n, 1], _wrapped(reading[2] - pose[n, 2])
            told = log_told + _log_normal(off_x, off_y, off_yaw, metres + noise[0], metres + noise[1], turn + noise[2])
            most = max(told, repeated)
            for a in range(len(others)):
                other = _log_normal(
                    off_x,
                    off_y,
                    off_yaw,
                    metres + noise[0] + others[a, 0],
                    metres + noise[1] + others[a, 1],
                    turn + noise[2] + others[a, 2],
                )
                terms[1 + a, n] = log_weights[n] + other
                if a < 2:
                    lost[a] = log_outlier + other
                    most = max(most, lost[a])
            tells, outlies = math.exp(told - most), math.exp(lost[0] - most) + math.exp(lost[1] - most)
            whole = tells + outlies + math.exp(repeated - most)
            terms[0, n] = log_weights[n] + most + math.log(whole)
            shares[0, n], shares[1, n] = tells / whole, outlies / whole
            takes = 1.0 if chance[n] < shares[0, n] else 0.0
            for axis in range(3):
                variance = turn if axis == 2 else metres
                off = off_x if axis == 0 else off_y if axis == 1 else off_yaw
                gain = takes * variance / (variance + noise[axis])
                pose[n, axis] = pose[n, axis] + gain * off + math.sqrt((1.0 - gain) * variance) * normal[n, axis]
        total, told, untold = _log_sum(terms[0]), 0.0, 0.0
        for n in range(len(pose)):
            after[n] = terms[0, n] - total
            weight = math.exp(after[n])
            told += weight * shares[0, n]
            untold += weight * shares[1, n]
        for a in range(len(others)):
            by_other[a] = _log_sum(terms[1 + a])
        sums[0], sums[1], sums[2] = total, told, untold
        sums[3] = _follow(pose, after, trail, new_trail)
        count, lost = len(others) - 2, len(old)
        for k in range(len(ratios)):  # knocks, what the tracker repeats, and what is far off
            density = by_other[2 + k] if k < count else old[k - count] if k < count + lost else by_other[0]
            ratios[k] = min(density - sums[0], numbers[7])
        sums[4] = _gather(ratios, log_sum, log_moment, numbers[6], log_shares, new_sum, new_moment)


take_reading = Kernel(_take_reading)


def _move(held, path, ends, normal, contact, numbers, pose, new_trail, part):
    before, tool, log_weights, slides, trail = held
    for _ in indices(part, 1):
        along, way = np.empty(len(contact[0])), np.empty((1, len(path), 3))
        start, last = before.copy(), trail.copy()
        measure(contact, along)
        for motion in range(len(normal)):
            own = path[ends[motion] : ends[motion + 1]]
            _push(start, tool, slides, own, contact, along, way, pose)
            for n in range(len(pose)):
                metres, turn = _variance(n, start, pose, numbers)
                for axis in range(3):
                    pose[n, axis] += math.sqrt(turn if axis == 2 else metres) * normal[motion, n, axis]
            _follow(pose, log_weights, last, new_trail)
            start[:, :] = pose
            last[:, :] = new_trail


move = Kernel(_move)
