"""The compiled CPU version of information turned about a point; `reach_cost.py` has the definition."""

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
