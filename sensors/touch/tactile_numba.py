"""The compiled CPU versions of where a tool's points went; `tactile.py` has the definitions."""

import numpy as np

from sdf.compiled import Kernel, bare
from sdf.part_numba import indices


@bare
def _placed(transforms, k, points, m):
    """Where a transform carries a point."""
    x, y, z = points[m, 0], points[m, 1], points[m, 2]
    return (
        transforms[k, 0, 0] * x + transforms[k, 0, 1] * y + transforms[k, 0, 2] * z + transforms[k, 0, 3],
        transforms[k, 1, 0] * x + transforms[k, 1, 1] * y + transforms[k, 1, 2] * z + transforms[k, 1, 3],
        transforms[k, 2, 0] * x + transforms[k, 2, 1] * y + transforms[k, 2, 2] * z + transforms[k, 2, 3],
    )


def _first_in_cells(transforms, points, spacing, low, group, taken, found, count, part):
    for _ in indices(part, 1):
        met = 0
        for instant in range(len(transforms)):
            own = taken[group[instant]]
            for m in range(len(points)):
                x, y, z = _placed(transforms, instant, points, m)
                x = np.floor(x / spacing) - low[0]
                y = np.floor(y / spacing) - low[1]
                z = np.floor(z / spacing) - low[2]
                if not (x >= 0 and x < own.shape[0] and y >= 0 and y < own.shape[1] and z >= 0 and z < own.shape[2]):
                    continue
                i, j, k = np.int64(x), np.int64(y), np.int64(z)
                if not own[i, j, k]:
                    own[i, j, k] = True
                    found[0, met], found[1, met] = instant, m
                    met += 1
        count[0] = met


def _points_in_box(transforms, points, box, found, places, count, part):
    for _ in indices(part, 1):
        met = 0
        for instant in range(len(transforms)):
            for m in range(len(points)):
                x, y, z = _placed(transforms, instant, points, m)
                if not (x >= box[0, 0] and x <= box[1, 0] and y >= box[0, 1] and y <= box[1, 1]):
                    continue
                if not (z >= box[0, 2] and z <= box[1, 2]):
                    continue
                found[0, met], found[1, met] = instant, m
                places[met, 0], places[met, 1], places[met, 2] = x, y, z
                met += 1
        count[0] = met


first_in_cells = Kernel(_first_in_cells)
points_in_box = Kernel(_points_in_box)
