"""The compiled CPU versions of information turned about a point and of its look-up; `reach_cost.py` defines both."""

import math

import numpy as np

from sdf.compiled import Kernel
from sdf.part_numba import indices


def _turned(nodes, values, start, pivot, spacing, turns, result, part):
    kind = values.dtype.type
    columns, rows = result.shape[1] - 2, result.shape[2] - 2
    low_x, low_y = start[0], start[1]
    pivot_x, pivot_y, one = (pivot[0] - low_x) / spacing, (pivot[1] - low_y) / spacing, kind(1.0)
    for turn in indices(part, len(turns)):
        found = result[turn]
        found[:] = kind(0.0)
        cos, sin = kind(math.cos(turns[turn])), kind(math.sin(turns[turn]))
        for n in range(len(values)):
            x, y = nodes[n, 0] - pivot_x, nodes[n, 1] - pivot_y
            u, v = cos * x - sin * y + pivot_x, sin * x + cos * y + pivot_y
            i, j = math.floor(u), math.floor(v)
            a, b = u - kind(i), v - kind(j)
            near, far = values[n] * (one - a), values[n] * a
            # what leaves the lattice gathers in a frame about it
            i, i1 = min(max(i + 1, 0), columns + 1), min(max(i + 2, 0), columns + 1)
            j, j1 = min(max(j + 1, 0), rows + 1), min(max(j + 2, 0), rows + 1)
            z = np.int64(nodes[n, 2])
            found[i, j, z] += near * (one - b)
            found[i, j1, z] += near * b
            found[i1, j, z] += far * (one - b)
            found[i1, j1, z] += far * b


turned = Kernel(_turned)


def _turned_shares(displacements, turns, stack, origin, spacing, step, share, part):
    kind = stack.dtype.type
    none, one = kind(0.0), kind(1.0)
    layers, columns, rows = stack.shape
    last_x, last_y = kind(columns - 1), kind(rows - 1)
    low_x, low_y = origin[0], origin[1]
    for n in indices(part, len(turns)):
        if turns[n] == none:
            continue
        place = turns[n] / step
        below = kind(math.floor(place))
        u, v = (displacements[n, 0] - low_x) / spacing + one, (displacements[n, 1] - low_y) / spacing + one
        u, v = u if u > none else none, v if v > none else none
        u, v = u if u < last_x else last_x, v if v < last_y else last_y
        i, j = min(np.int64(u), columns - 2), min(np.int64(v), rows - 2)
        a, b = u - kind(i), v - kind(j)
        layer = np.int64(below) % layers
        low, high = none, none
        for up in range(2):
            table = stack[(layer + up) % layers]
            near = table[i, j] + b * (table[i, j + 1] - table[i, j])
            far = table[i + 1, j] + b * (table[i + 1, j + 1] - table[i + 1, j])
            low, high = high, near + a * (far - near)
        share[n] = low + (place - below) * (high - low)


turned_shares = Kernel(_turned_shares)
