"""The compiled CPU versions of merging and neighbours; `neighbours.py` has the definition."""

import math

import numpy as np

from sdf.compiled import Kernel, bare
from sdf.part_numba import indices

_TURN = 2.0 * math.pi


@bare
def _apart(a, b, angle):
    d = a - b
    return (d + math.pi) % _TURN - math.pi if angle else d


def _leaders(states, log_weights, angles, leader, part):
    size, dims = states.shape[1:]
    for b in indices(part, len(states)):
        for i in range(size):
            leader[b, i] = 0
            for j in range(size):
                if log_weights[b, j] == -math.inf:
                    continue
                same = True
                for d in range(dims):
                    if _apart(states[b, i, d], states[b, j, d], angles[d]) != 0.0:
                        same = False
                        break
                if same:
                    leader[b, i] = j
                    break


leaders = Kernel(_leaders)


@bare
def _around(b, i, states, first, weights, scales, angles, count, own, near, which, sides, distance, mass):
    """Box, distance and mass of the nearest of state i of set b; `near` and `which` are room to sort them in."""
    size, dims = states.shape[1:]
    found = 0
    for j in range(size):
        if j == i or not first[b, j]:
            continue
        square = 0.0
        for d in range(dims):
            part = _apart(states[b, j, d], states[b, i, d], angles[d]) / scales[d]
            square += part * part
        if found == count and not square < near[found - 1]:
            continue
        place = found if found < count else count - 1
        found = min(found + 1, count)
        while place > 0 and near[place - 1] > square:
            near[place], which[place] = near[place - 1], which[place - 1]
            place -= 1
        near[place], which[place] = square, j
    held = 0.0
    for k in range(found):
        held += weights[b, which[k]]
    mass[b, i] = held
    distance[b, i] = math.sqrt(near[found - 1]) if found > 0 else 0.0
    for d in range(dims):
        low, high = (0.0, 0.0) if own else (math.inf, -math.inf)
        for k in range(found):
            part = _apart(states[b, which[k], d], states[b, i, d], angles[d])
            low, high = min(low, part), max(high, part)
        sides[b, i, d] = high - low if high >= low else 0.0


def _nearest(states, first, weights, scales, angles, used, own, sides, distance, mass, part):
    size = states.shape[1]
    for b in indices(part, len(states)):
        others = used[b] - 1 if own else used[b]
        near, which = np.empty(max(others, 1), np.float64), np.empty(max(others, 1), np.int64)
        for i in range(size):
            if first[b, i] and others > 0:
                _around(b, i, states, first, weights, scales, angles, others, own, near, which, sides, distance, mass)


nearest = Kernel(_nearest)
