"""The fused CPU version of the trajectory information; `costs.py` has the definition."""

import math

import numpy as np
from numba import prange

from sdf.fused import Kernel


def _gathered(value, layer, scale, offset, points, middle, radius, configurations, displacements, discount, result):
    rollouts, horizon = configurations.shape[:2]
    wide, deep, layers = value.shape
    worth = value.reshape(-1)
    kind = value.dtype.type
    none, last_x, last_y = kind(0.0), kind(wide - 1.0), kind(deep - 1.0)
    for r in prange(rollouts):
        met = np.zeros(worth.size, np.bool_)
        total, factor = 0.0, 1.0
        for h in range(horizon):
            yaw = configurations[r, h, 2]
            x, y = configurations[r, h, 0] - displacements[r, h, 0], configurations[r, h, 1] - displacements[r, h, 1]
            again = (
                h > 0
                and yaw == configurations[r, h - 1, 2]
                and x == configurations[r, h - 1, 0] - displacements[r, h - 1, 0]
                and y == configurations[r, h - 1, 1] - displacements[r, h - 1, 1]
            )
            if not again:
                cos, sin = math.cos(yaw), math.sin(yaw)
                u = (x + cos * middle[0] - sin * middle[1]) * scale[0] + offset[0]
                v = (y + sin * middle[0] + cos * middle[1]) * scale[1] + offset[1]
                if max(max(1.0 - u, u - (wide - 1.0)), max(1.0 - v, v - (deep - 1.0))) <= radius:
                    place_x, place_y = kind(x * scale[0] + offset[0]), kind(y * scale[1] + offset[1])
                    cos_x, sin_x, cos_y, sin_y = (
                        kind(cos * scale[0]),
                        kind(sin * scale[0]),
                        kind(cos * scale[1]),
                        kind(sin * scale[1]),
                    )
                    for m in range(layer.size):
                        i = int(min(max(place_x + cos_x * points[m, 0] - sin_x * points[m, 1], none), last_x))
                        j = int(min(max(place_y + sin_y * points[m, 0] + cos_y * points[m, 1], none), last_y))
                        cell = (i * deep + j) * layers + layer[m]
                        if not met[cell]:
                            met[cell] = True
                            total += factor * worth[cell]
            factor *= discount
        result[r] = total


gathered = Kernel(_gathered)
