"""What the tool's points meet in the fields of the push rollouts: contact probability and pushing, compiled.

In a plane `pz`, the heights of the tool's points, is None and fields have an axis less.
"""

import math

import numpy as np

from sdf.compiled import bare
from sdf.grid_numba import at, put


@bare
def _value(grid, channel, x, y, z):
    """Multilinear value of a channel at lattice coordinates; zero fades in outside."""
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    value = 0.0
    if grid.ndim == 4:
        k = math.floor(z)
        c = z - k
        for di in range(2):
            for dj in range(2):
                for dk in range(2):
                    u, v, w = i + di, j + dj, k + dk
                    if 0 <= u < grid.shape[0] and 0 <= v < grid.shape[1] and 0 <= w < grid.shape[2]:
                        share = (a if di else 1.0 - a) * (b if dj else 1.0 - b) * (c if dk else 1.0 - c)
                        value += share * grid[u, v, w, channel]
    else:
        for di in range(2):
            for dj in range(2):
                if 0 <= i + di < grid.shape[0] and 0 <= j + dj < grid.shape[1]:
                    value += (a if di else 1.0 - a) * (b if dj else 1.0 - b) * grid[i + di, j + dj, channel]
    return value


@bare
def _bound(bound, x, y, z):
    """What the bound holds at the node next to lattice coordinates; 0 outside. A single node holds everywhere."""
    if bound.ndim == 3:
        if bound.size == 1:
            return bound[0, 0, 0]
        i, j, k = math.floor(x + 0.5), math.floor(y + 0.5), math.floor(z + 0.5)
        inside = 0 <= i < bound.shape[0] and 0 <= j < bound.shape[1] and 0 <= k < bound.shape[2]
        return bound[i, j, k] if inside else 0.0
    i = 0 if bound.shape[0] == 1 else math.floor(x + 0.5)
    j = 0 if bound.shape[1] == 1 else math.floor(y + 0.5)
    return bound[i, j] if 0 <= i < bound.shape[0] and 0 <= j < bound.shape[1] else 0.0


@bare
def touch(
    x,
    y,
    z,
    cos,
    sin,
    level,
    px,
    py,
    pz,
    starts,
    order,
    flat,
    origin,
    bound,
    bound_origin,
    centres,
    sizes,
    ahead,
    likely,
):
    """Greatest contact probability of the tool's points if it is above `level`, and the first point that has it.

    Discs, in space balls, are looked into in the order of what they may hold, until none left can hold as much as was
    found.
    """
    width, depth, height, scale, tie = int(sizes[0]), int(sizes[1]), int(sizes[2]), sizes[3], sizes[4]
    kind, across, one = flat.dtype.type, np.int32(height), np.int32(1)
    slab = np.int32(depth * height)
    none, last_x, last_y, last_z = kind(0.0), kind(width - 1.001), kind(depth - 1.001), kind(height - 1.001)
    possible = False
    for d in range(len(centres)):
        cx = (x + cos * centres[d, 0] - sin * centres[d, 1] - bound_origin[0]) * scale
        cy = (y + sin * centres[d, 0] + cos * centres[d, 1] - bound_origin[1]) * scale
        cz = 0.0 if pz is None else (z + centres[d, 2] - bound_origin[2]) * scale
        ahead[d] = _bound(bound, cx, cy, cz)
        possible |= ahead[d] > level
    if not possible:
        return 0.0, -1, False
    # the field is padded by two nodes of zeros on each side, on which all that lies outside lands
    place_x, place_y = kind((x - origin[0]) * scale + 2.0), kind((y - origin[1]) * scale + 2.0)
    turn_x, turn_y = kind(cos * scale), kind(sin * scale)
    if pz is not None:
        place_z, rise = kind((z - origin[2]) * scale + 2.0), kind(scale)
    most = none
    while True:
        disc, highest = -1, max(most, level) - tie
        for d in range(len(centres)):
            if ahead[d] >= highest:
                disc, highest = d, ahead[d]
        if disc < 0:
            break
        ahead[disc] = -2.0
        first, last = starts[disc], starts[disc + 1]
        for n in range(first, last):
            u = place_x + turn_x * at(px, n) - turn_y * at(py, n)
            v = place_y + turn_y * at(px, n) + turn_x * at(py, n)
            u, v = u if u > none else none, v if v > none else none
            u, v = u if u < last_x else last_x, v if v < last_y else last_y
            i, j = np.int32(u), np.int32(v)
            a, b = u - kind(i), v - kind(j)
            if pz is None:
                near = i * slab + j
                far = near + slab
                low, high = at(flat, near), at(flat, far)
                low += b * (at(flat, near + one) - low)
                high += b * (at(flat, far + one) - high)
            else:
                w = place_z + rise * at(pz, n)
                w = w if w > none else none
                w = w if w < last_z else last_z
                k = np.int32(w)
                c = w - kind(k)
                near = i * slab + j * across + k
                low = at(flat, near) + c * (at(flat, near + one) - at(flat, near))
                side = near + across
                high = at(flat, side) + c * (at(flat, side + one) - at(flat, side))
                low += b * (high - low)
                near += slab
                first_far = at(flat, near) + c * (at(flat, near + one) - at(flat, near))
                side = near + across
                high = at(flat, side) + c * (at(flat, side + one) - at(flat, side))
                high = first_far + b * (high - first_far)
            put(likely, n, low + a * (high - low))
        for n in range(first, last):
            most = max(most, likely[n])
    best, first = -1, len(px)
    if level < most:
        for d in range(len(centres)):
            if ahead[d] == -2.0:
                for n in range(starts[d], starts[d + 1]):
                    if likely[n] >= most - tie and order[n] < first:
                        best, first = n, order[n]
    return most, best, True


@bare
def pushes(x, y, z, cos, sin, tx, ty, tz, dx, dy, dz, normal, origin, scale, push_cosine):
    """Whether the motion of the tool's point goes into the surface within the push angle, in space also sideways."""
    tiny = 1e-6
    gx, gy = (x + cos * tx - sin * ty - origin[0]) * scale, (y + sin * tx + cos * ty - origin[1]) * scale
    gz = 0.0
    if normal.ndim == 4:
        gz = (z + tz - origin[2]) * scale
    nx, ny, nz = _value(normal, 0, gx, gy, gz), _value(normal, 1, gx, gy, gz), _value(normal, 2, gx, gy, gz)
    if normal.ndim == 4:
        level = math.sqrt(nx * nx + ny * ny)
        length, moved = math.sqrt(level * level + nz * nz), math.sqrt(dx * dx + dy * dy + dz * dz)
        inward = -(nx * dx + ny * dy + nz * dz)
        return inward > push_cosine * length * moved and length > tiny and moved > tiny and level >= abs(nz)
    length, moved = math.sqrt(nx * nx + ny * ny + nz * nz), math.sqrt(dx * dx + dy * dy)
    return -(nx * dx + ny * dy) > push_cosine * length * moved and length > tiny and moved > tiny
