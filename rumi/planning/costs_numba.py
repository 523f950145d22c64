"""The compiled CPU version of the trajectory information; `costs.py` has the definition.

One template for a tool that moves in a plane, whose points have layers, and for one in space, whose points have
heights: the other of `layer` and `up` is None, and numba compiles what needs it away.
"""

import math

import numpy as np

from sdf.compiled import Kernel
from sdf.grid_numba import block
from sdf.intrinsics_numba import at, put
from sdf.part_numba import indices


@block
def _cells(x, y, z, cos, sin, along, across, up, scale, offset, wide, deep, tall, cell):
    """Cell of every point of the tool, in a plane in its layer, clamped to the box; vector instructions."""
    kind = type(scale[0])
    none, last_x, last_y = kind(0.0), kind(wide - 1), kind(deep - 1)
    place_x, place_y = kind(x * scale[0] + offset[0]), kind(y * scale[1] + offset[1])
    cos_x, sin_x, cos_y, sin_y = kind(cos * scale[0]), kind(sin * scale[0]), kind(cos * scale[1]), kind(sin * scale[1])
    if up is not None:
        last_z, place_z = kind(tall - 1), kind(z * scale[2] + offset[2])
    for m in range(len(along)):
        u = place_x + cos_x * at(along, m) - sin_x * at(across, m)
        v = place_y + sin_y * at(along, m) + cos_y * at(across, m)
        u, v = u if u > none else none, v if v > none else none
        u, v = u if u < last_x else last_x, v if v < last_y else last_y
        if up is None:
            put(cell, m, np.int32(u) * np.int32(deep) + np.int32(v))
        else:
            w = place_z + scale[2] * at(up, m)
            w = w if w > none else none
            w = w if w < last_z else last_z
            put(cell, m, (np.int32(u) * np.int32(deep) + np.int32(v)) * np.int32(tall) + np.int32(w))


def _gathered(
    value, layer, lattice, points, up, radius, configurations, displacements, turns, pivots, discount, result, part
):
    (scale, offset, middle), (along, across) = lattice, points
    rollouts, horizon = configurations.shape[:2]
    wide, deep, tall = value.shape
    worth = value.reshape(-1)
    for r in indices(part, rollouts):
        left = worth.copy()  # what is not met yet
        cell = np.empty(along.size, np.int32)
        total, factor = 0.0, 1.0
        last_x, last_y, last_z, last_yaw = np.inf, np.inf, np.inf, np.inf
        for h in range(horizon):
            x, y = configurations[r, h, 0] - displacements[r, h, 0], configurations[r, h, 1] - displacements[r, h, 1]
            if up is None:
                z, yaw = 0.0, configurations[r, h, 2]
            else:
                z, yaw = configurations[r, h, 2], configurations[r, h, 3]
            if turns.size and turns[r, h] != 0.0:
                # the field turns with the object: look from where it has not moved
                pivot, turn = pivots[r if len(pivots) > 1 else 0], turns[r, h]
                cos, sin, arm_x, arm_y = math.cos(turn), math.sin(turn), x - pivot[0], y - pivot[1]
                x, y = cos * arm_x + sin * arm_y + pivot[0], cos * arm_y - sin * arm_x + pivot[1]
                yaw -= turn
            again = x == last_x and y == last_y and z == last_z and yaw == last_yaw
            last_x, last_y, last_z, last_yaw = x, y, z, yaw
            if not again:
                cos, sin = math.cos(yaw), math.sin(yaw)
                u = (x + cos * middle[0] - sin * middle[1]) * scale[0] + offset[0]
                v = (y + sin * middle[0] + cos * middle[1]) * scale[1] + offset[1]
                if max(max(1.0 - u, u - (wide - 1.0)), max(1.0 - v, v - (deep - 1.0))) <= radius:
                    _cells(x, y, z, cos, sin, along, across, up, scale, offset, wide, deep, tall, cell)
                    gained = 0.0
                    for m in range(along.size):
                        if layer is None:
                            index = np.uint32(cell[m])
                        else:
                            index = np.uint32(cell[m]) * np.uint32(tall) + np.uint32(layer[m])
                        gained += left[index]
                        left[index] = 0.0
                    total += factor * gained
            factor *= discount
        result[r] = total


gathered = Kernel(_gathered, fast=True)
