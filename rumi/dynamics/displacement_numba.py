"""The fused CPU version of one action of touched rollouts; `displacement.py` has the definition."""

import math

import numba
import numpy as np
from numba import prange

from sdf.fused import Kernel


@numba.njit(cache=True, error_model="numpy")
def _corner(x, count):
    """Lower node and share of the upper one, along one axis; a lone node holds every coordinate."""
    if count == 1:
        return 0, 0.0
    low = math.floor(x)
    return int(low), x - low


@numba.njit(cache=True, error_model="numpy")
def _value(grid, x, y):
    """Bilinear value at lattice coordinates; zero fades in outside."""
    i, a = _corner(x, grid.shape[0])
    j, b = _corner(y, grid.shape[1])
    value = 0.0
    for di in range(2):
        for dj in range(2):
            weight = (a if di else 1.0 - a) * (b if dj else 1.0 - b)
            if weight > 0.0 and 0 <= i + di < grid.shape[0] and 0 <= j + dj < grid.shape[1]:
                value += weight * grid[i + di, j + dj]
    return value


@numba.njit(cache=True, error_model="numpy")
def _reaches(bound, x, y, level):
    """Whether what the bound holds at the node next to lattice coordinates is above `level`."""
    i = 0 if bound.shape[0] == 1 else math.floor(x + 0.5)
    j = 0 if bound.shape[1] == 1 else math.floor(y + 0.5)
    return 0 <= i < bound.shape[0] and 0 <= j < bound.shape[1] and level < bound[i, j]


def _push_action(
    now,
    way,
    offset,
    strayed,
    stuck,
    first,
    draws,
    met,
    checks,
    points,
    starts,
    order,
    padded,
    normal,
    origin,
    bound,
    bound_origin,
    centres,
    scale,
    push_cosine,
    tie,
    holds,
):
    tiny = 1e-6
    kind = padded.dtype.type
    none, last_x, last_y = kind(0.0), kind(padded.shape[0] - 1.001), kind(padded.shape[1] - 1.001)
    for r in prange(len(now)):
        likely = np.empty(len(points), padded.dtype)
        active = np.empty(len(centres), np.bool_)
        before_cos, before_sin = math.cos(now[r, 2]), math.sin(now[r, 2])
        for mini in range(first[r], draws.shape[1]):
            if stuck[r]:
                break
            x, y, yaw = now[r, 0] + way[r, 0], now[r, 1] + way[r, 1], now[r, 2] + way[r, 2]
            cos, sin, level = math.cos(yaw), math.sin(yaw), draws[r, mini]
            u, v = x - offset[r, 0], y - offset[r, 1]
            place_x, place_y = kind((u - origin[0]) * scale + 2.0), kind((v - origin[1]) * scale + 2.0)
            turn_x, turn_y = kind(cos * scale), kind(sin * scale)
            # only points of discs that reach above the level can be the one that touches
            most, possible = none, False
            for d in range(len(centres)):
                cx = (u + cos * centres[d, 0] - sin * centres[d, 1] - bound_origin[0]) * scale
                cy = (v + sin * centres[d, 0] + cos * centres[d, 1] - bound_origin[1]) * scale
                active[d] = _reaches(bound, cx, cy, level - tie)
                if not active[d]:
                    continue
                possible = True
                for k in range(starts[d], starts[d + 1]):
                    # the field is padded by two nodes of zeros on each side, on which all that lies outside lands
                    px = min(max(place_x + turn_x * points[k, 0] - turn_y * points[k, 1], none), last_x)
                    py = min(max(place_y + turn_y * points[k, 0] + turn_x * points[k, 1], none), last_y)
                    i, j = int(px), int(py)
                    a, b = px - kind(i), py - kind(j)
                    low = padded[i, j] + b * (padded[i, j + 1] - padded[i, j])
                    high = padded[i + 1, j] + b * (padded[i + 1, j + 1] - padded[i + 1, j])
                    likely[k] = low + a * (high - low)
                for k in range(starts[d], starts[d + 1]):
                    most = max(most, likely[k])
            checks[r] += possible
            pushed = True
            if level < most:
                met[r] = True
                best, point = -1, len(points)
                for d in range(len(centres)):
                    if active[d]:
                        for k in range(starts[d], starts[d + 1]):
                            if likely[k] >= most - tie and order[k] < point:
                                best, point = k, order[k]
                tx, ty = points[best, 0], points[best, 1]
                dx = (cos - before_cos) * tx - (sin - before_sin) * ty + way[r, 0]
                dy = (sin - before_sin) * tx + (cos - before_cos) * ty + way[r, 1]
                gx = (u + cos * tx - sin * ty - origin[0]) * scale
                gy = (v + sin * tx + cos * ty - origin[1]) * scale
                nx = _value(normal[:, :, 0], gx, gy)
                ny = _value(normal[:, :, 1], gx, gy)
                nz = _value(normal[:, :, 2], gx, gy)
                length, moved = math.sqrt(nx * nx + ny * ny + nz * nz), math.sqrt(dx * dx + dy * dy)
                inward = -(nx * dx + ny * dy)
                pushed = inward > push_cosine * length * moved and length > tiny and moved > tiny
                if pushed:
                    offset[r, 0] += dx
                    offset[r, 1] += dy
                else:
                    strayed[r] = True
                    stuck[r] = holds
            if pushed:
                now[r, 0], now[r, 1], now[r, 2] = x, y, yaw
                before_cos, before_sin = cos, sin


push_action = Kernel(_push_action)
