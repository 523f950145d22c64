"""The compiled CPU version of resampling; `pushed_pose_resampling.py` has the definition."""

import math

import numpy as np

from rumi.dynamics.push_parameters import QUARTIC
from sdf.compiled import Kernel, bare
from sdf.part_numba import indices

_LOW, _HIGH = QUARTIC


@bare
def _slides(n, parameters, support, centre, lever, friction, quartic):
    """How an object slides by a particle's parameters; see `sliding_of`."""
    centre_x, centre_y, spread, along, across = support[0], support[1], support[2], support[3], support[4]
    size = max(math.sqrt(along * along + across * across), 1e-12)
    mean, apart = parameters[n, 2], parameters[n, 3] * size
    high = min(max(mean + abs(apart), _LOW), _HIGH)
    low = min(max(mean - abs(apart), _LOW), _HIGH)
    half = 0.5 * (high - low) * np.sign(apart)
    centre[n, 0] = centre_x + spread * parameters[n, 6]
    centre[n, 1] = centre_y + spread * parameters[n, 7]
    lever[n], friction[n] = spread * math.exp(parameters[n, 1]), math.exp(parameters[n, 0])
    quartic[n, 0], quartic[n, 1], quartic[n, 2] = parameters[n, 4], parameters[n, 5], 0.5 * (high + low)
    quartic[n, 3], quartic[n, 4] = half * (along / size), half * (across / size)


def _resample(before, drift, offset, found, part):
    log_weights, pose, parameters, tool, normal, moved = before
    mean, deviation, tool_m, numbers = drift
    new_pose, new_parameters, new_tool, centre, quartic, lever, friction = found
    count = len(log_weights)
    keep, fresh = numbers[5], numbers[6]
    for _ in indices(part, 1):
        cumulated, most, total = np.empty(count), -math.inf, 0.0
        for n in range(count):
            most = max(most, log_weights[n])
        for n in range(count):
            total += math.exp(log_weights[n] - most)
            cumulated[n] = total
        row = 0
        for n in range(count):
            while row < count - 1 and not cumulated[row] / total > (n + offset[0]) / count:
                row += 1
            for k in range(8):
                drifted = mean[k] + keep * (parameters[row, k] - mean[k])
                new_parameters[n, k] = drifted + fresh * deviation[k] * normal[n, k]
            for k in range(3):
                new_pose[n, k] = pose[row, k]
                new_tool[n, k] = keep * tool[row, k] + fresh * tool_m[k] * moved[n, k]
            _slides(n, new_parameters, numbers, centre, lever, friction, quartic)


resample = Kernel(_resample)
