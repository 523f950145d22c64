"""What the tool's points meet in the fields of the push rollouts: contact probability and pushing, compiled.

In a plane `pz`, the heights of the tool's points, is None and fields have an axis less.
"""

import math

import numpy as np

from sdf.compiled import bare
from sdf.intrinsics_numba import at, bits, from_bits, next_to, node, put, whole


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
def touch(x, y, z, cos, sin, level, body, pz, fields, discs, sizes, ahead, likely):
    """Greatest contact probability of the tool's points if it is above `level`, and the first point that has it.

    Discs, in space balls, are looked into in the order of what they may hold, until none left can hold as much as was
    found. Probabilities are not below 0, and so as great as their bits, whose maximum can be taken many at a time.
    """
    px, py, starts, order = body
    flat, origin, _ = fields
    bound, bound_numbers, centres = discs
    width, depth, height, scale, tie = int(sizes[0]), int(sizes[1]), int(sizes[2]), sizes[3], sizes[4]
    kind, across, one = flat.dtype.type, np.int32(height), np.int32(1)
    slab = np.int32(depth * height)
    none, last_x, last_y, last_z = kind(0.0), kind(width - 1.001), kind(depth - 1.001), kind(height - 1.001)
    turn_x, turn_y, rise, count = kind(cos * scale), kind(sin * scale), kind(scale), len(ahead)
    # what may be met about a centre is at the node next to it; its table is padded as the field is
    shift_x, shift_y = kind((x - bound_numbers[0]) * scale + 0.5), kind((y - bound_numbers[1]) * scale + 0.5)
    shift_z = kind(0.0) if pz is None else kind((z - bound_numbers[2]) * scale + 0.5)
    end_x, end_y, end_z = kind(bound_numbers[3]), kind(bound_numbers[4]), kind(bound_numbers[5])
    bound_slab, bound_across = np.int32(bound_numbers[6]), np.int32(bound_numbers[7])
    greatest = bits(none)
    for d in range(count):
        u = shift_x + turn_x * at(centres, d) - turn_y * at(centres, count + d)
        v = shift_y + turn_y * at(centres, d) + turn_x * at(centres, count + d)
        w = shift_z + rise * at(centres, 2 * count + d)
        u, v, w = u if u > none else none, v if v > none else none, w if w > none else none
        u, v, w = u if u < end_x else end_x, v if v < end_y else end_y, w if w < end_z else end_z
        found = at(bound, node(whole(u), whole(v), whole(w), bound_slab, bound_across))
        put(ahead, d, found)
        greatest = greatest if greatest > bits(found) else bits(found)
    if not from_bits(greatest, none) > level:
        return 0.0, -1, False
    # the field is padded by two nodes of zeros on each side, on which all that lies outside lands
    place_x, place_y = kind((x - origin[0]) * scale + 2.0), kind((y - origin[1]) * scale + 2.0)
    if pz is not None:
        place_z = kind((z - origin[2]) * scale + 2.0)
    most = none
    while True:
        disc, highest = -1, max(most, level) - tie
        for d in range(count):
            if ahead[d] >= highest:
                disc, highest = d, ahead[d]
        if disc < 0:
            break
        first, last, greatest = starts[disc], starts[disc + 1], bits(none)
        for n in range(first, last):
            u = place_x + turn_x * at(px, n) - turn_y * at(py, n)
            v = place_y + turn_y * at(px, n) + turn_x * at(py, n)
            u, v = u if u > none else none, v if v > none else none
            u, v = u if u < last_x else last_x, v if v < last_y else last_y
            i, j = whole(u), whole(v)
            a, b = u - kind(i), v - kind(j)
            if pz is None:
                near = node(i, j, np.int32(0), slab, one)
                far = next_to(near, slab)
                low, high = at(flat, near), at(flat, far)
                low += b * (at(flat, next_to(near, one)) - low)
                high += b * (at(flat, next_to(far, one)) - high)
            else:
                w = place_z + rise * at(pz, n)
                w = w if w > none else none
                w = w if w < last_z else last_z
                k = whole(w)
                c = w - kind(k)
                near = node(i, j, k, slab, across)
                low = at(flat, near) + c * (at(flat, next_to(near, one)) - at(flat, near))
                side = next_to(near, across)
                high = at(flat, side) + c * (at(flat, next_to(side, one)) - at(flat, side))
                low += b * (high - low)
                near = next_to(near, slab)
                first_far = at(flat, near) + c * (at(flat, next_to(near, one)) - at(flat, near))
                side = next_to(near, across)
                high = at(flat, side) + c * (at(flat, next_to(side, one)) - at(flat, side))
                high = first_far + b * (high - first_far)
            found = low + a * (high - low)
            put(likely, n, found)
            greatest = greatest if greatest > bits(found) else bits(found)
        own = from_bits(greatest, none)
        most, ahead[disc] = max(most, own), -one - own  # below what is left
    best, first = -1, len(px)
    if level < most:
        for d in range(count):
            if -one - ahead[d] + 2.0 * tie >= most:  # the disc holds one of the greatest
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
