"""The compiled CPU version of pushes as tracked; `tracked_push.py` has the definition."""

import math

import numpy as np

from rumi.dynamics.along_path_numba import advanced, gradient, measure, nearest, sliding_at
from sdf.compiled import Kernel, bare
from sdf.part_numba import indices


@bare
def _separated(x, y, yaw, path, e, contact, along):
    """Place of an object off a tool that stands in it; see `separated`."""
    table, shape, thickness, most = contact[1], contact[2], contact[3][0], contact[4][2]
    cos, sin = math.cos(yaw), math.sin(yaw)
    tool_x, tool_y, tool_yaw = float(path[e, 0, 0]), float(path[e, 0, 1]), float(path[e, 0, 2])
    for _ in range(most):
        apart, _, at_x, at_y = nearest(x, y, yaw, tool_x, tool_y, tool_yaw, contact, thickness, along)
        depth = thickness - apart
        if not depth > 0.0:
            break
        gx, gy = gradient(at_x, at_y, table, shape)
        length = max(math.sqrt(gx * gx + gy * gy), 1e-9)
        x, y = x - depth * (cos * gx - sin * gy) / length, y - depth * (sin * gx + cos * gy) / length
    return x, y


@bare
def _pushed(e, n, start, path, shifts, contact, slides, along):
    """Where one push ends by one particle, as tracked."""
    tool_x, tool_y, own_x, own_y = float(shifts[n, 0]), float(shifts[n, 1]), float(shifts[n, 2]), float(shifts[n, 3])
    turn = float(shifts[n, 4])
    x, y, yaw = float(start[e, 0]), float(start[e, 1]), float(start[e, 2])
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y, yaw = x + cos * own_x - sin * own_y + tool_x, y + sin * own_x + cos * own_y + tool_y, yaw + turn
    body = sliding_at(n, slides)
    x, y = _separated(x, y, yaw, path, e, contact, along)
    for instant in range(path.shape[1] - 1):
        x, y, yaw = advanced(x, y, yaw, path, e, instant, contact, body, along)
    yaw -= turn
    cos, sin = math.cos(yaw), math.sin(yaw)
    return x - tool_x - cos * own_x + sin * own_y, y - tool_y - sin * own_x - cos * own_y, yaw


def _tracked_ends(start, path, shifts, contact, slides, support, ends, way, part):
    count, along = len(shifts), np.empty(len(contact[0]))
    measure(contact, along)
    for k in indices(part, len(start) * count):
        # a signed index: a parallel loop's is unsigned, which with a signed one makes no index
        e, n = np.int64(k) // count, np.int64(k) % count
        x, y, yaw = _pushed(e, n, start, path, shifts, contact, slides, along)
        ends[e, n, 0], ends[e, n, 1], ends[e, n, 2] = x, y, yaw
        first = float(start[e, 2])
        cos, sin = math.cos(yaw) - math.cos(first), math.sin(yaw) - math.sin(first)
        gone_x = x - start[e, 0] + cos * support[0] - sin * support[1]
        gone_y = y - start[e, 1] + sin * support[0] + cos * support[1]
        way[e, n] = math.sqrt(gone_x * gone_x + gone_y * gone_y) + support[2] * abs(yaw - first)


tracked_ends = Kernel(_tracked_ends)
