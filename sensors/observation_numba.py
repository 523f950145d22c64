"""The compiled CPU version of what a merge of observations adds; `observation.py` has the definition."""

import math

import numpy as np

from sdf.compiled import Kernel, bare
from sdf.part_numba import indices

_FREE = np.int64(-1)


@bare
def _key(points, labels, pitch, m, half, bits):
    """Key of a point's lattice cell, class and frame; -2 where it is too far off, or not finite."""
    label = labels[m]
    own = pitch[label % 3]
    x, y, z = np.floor(points[m, 0] / own), np.floor(points[m, 1] / own), np.floor(points[m, 2] / own)
    if not (x >= -half and x < half and y >= -half and y < half and z >= -half and z < half):
        return np.int64(-2)
    cell = ((np.int64(x) + half) << (2 * bits)) | ((np.int64(y) + half) << bits) | (np.int64(z) + half)
    return cell + (np.int64(label) << (3 * bits))


@bare
def _place(key, table):
    """Where a key is in an open table, or where it would be."""
    mask = np.int64(len(table) - 1)
    at = (key ^ (key >> 17) ^ (key >> 34)) * np.int64(0x9E3779B1)
    at = (at ^ (at >> 15)) & mask
    while table[at] != _FREE and table[at] != key:
        at = (at + 1) & mask
    return at


def _added(new, new_labels, old, old_labels, pitch, half, bits, table, first, keep, wrong, part):
    for _ in indices(part, 1):
        margin = max(pitch[0], pitch[1], pitch[2])
        low_x, low_y, low_z = math.inf, math.inf, math.inf
        high_x, high_y, high_z = -math.inf, -math.inf, -math.inf
        for m in range(len(new)):
            if new_labels[m] < 0:
                continue
            key = _key(new, new_labels, pitch, m, half, bits)
            if key < 0:
                wrong[0] = True
                return
            low_x, high_x = min(low_x, new[m, 0]), max(high_x, new[m, 0])
            low_y, high_y = min(low_y, new[m, 1]), max(high_y, new[m, 1])
            low_z, high_z = min(low_z, new[m, 2]), max(high_z, new[m, 2])
            at = _place(key, table)
            if table[at] == _FREE:
                table[at], first[at] = key, m
                keep[m] = True
        # what is farther than a cell from all new points is in none of their cells; what is not finite is looked at
        low_x, low_y, low_z = low_x - 1.01 * margin, low_y - 1.01 * margin, low_z - 1.01 * margin
        high_x, high_y, high_z = high_x + 1.01 * margin, high_y + 1.01 * margin, high_z + 1.01 * margin
        for m in range(len(old)):
            if old_labels[m] < 0:
                continue
            x, y, z = old[m, 0], old[m, 1], old[m, 2]
            if (x < low_x) | (x > high_x) | (y < low_y) | (y > high_y) | (z < low_z) | (z > high_z):
                continue
            key = _key(old, old_labels, pitch, m, half, bits)
            if key < 0:
                wrong[0] = True
                return
            at = _place(key, table)
            if table[at] != _FREE:
                keep[first[at]] = False


added = Kernel(_added)
