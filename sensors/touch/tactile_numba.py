"""The compiled CPU version of which points come first into a lattice's cells; `tactile.py` has the definition."""

import numpy as np

from sdf.compiled import Kernel
from sdf.part_numba import indices


def _first_in_cells(places, spacing, low, group, taken, found, count, part):
    for _ in indices(part, 1):
        met = 0
        for instant in range(places.shape[0]):
            own = taken[group[instant]]
            for m in range(places.shape[1]):
                x = np.floor(places[instant, m, 0] / spacing) - low[0]
                y = np.floor(places[instant, m, 1] / spacing) - low[1]
                z = np.floor(places[instant, m, 2] / spacing) - low[2]
                if not (x >= 0 and x < own.shape[0] and y >= 0 and y < own.shape[1] and z >= 0 and z < own.shape[2]):
                    continue
                i, j, k = np.int64(x), np.int64(y), np.int64(z)
                if not own[i, j, k]:
                    own[i, j, k] = True
                    found[0, met], found[1, met] = instant, m
                    met += 1
        count[0] = met


first_in_cells = Kernel(_first_in_cells)
