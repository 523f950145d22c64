"""The fused CPU version of the trajectory information; `costs.py` has the definition."""

import numpy as np
from numba import prange

from sdf.fused import Kernel


def _gathered(value, layer, along_x, along_y, features, near, discount, result):
    rollouts, horizon = near.shape
    wide, deep, layers = value.shape
    worth = value.reshape(-1)
    for r in prange(rollouts):
        met = np.zeros(worth.size, np.bool_)
        total = 0.0
        factor = 1.0
        for h in range(horizon):
            if near[r, h]:
                cos, sin, x, y = features[r, h, 0], features[r, h, 1], features[r, h, 2], features[r, h, 3]
                for m in range(layer.size):
                    u = cos * along_x[0, m] + sin * along_x[1, m] + x * along_x[2, m] + along_x[4, m]
                    v = cos * along_y[0, m] + sin * along_y[1, m] + y * along_y[3, m] + along_y[4, m]
                    i = int(min(max(u, 0.0), wide - 1.0))
                    j = int(min(max(v, 0.0), deep - 1.0))
                    cell = (i * deep + j) * layers + layer[m]
                    if not met[cell]:
                        met[cell] = True
                        total += factor * worth[cell]
            factor *= discount
        result[r] = total


gathered = Kernel(_gathered)
