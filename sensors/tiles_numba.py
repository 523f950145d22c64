"""Traversal of the bounding volumes of `tiles.py`, so that most points need no look-up; there is why that is exact."""

import math

import numpy as np

from sdf.compiled import Kernel
from sdf.grid_numba import block, exact, fast, value
from sdf.intrinsics_numba import at, put
from sdf.part_numba import indices

# 0 as a number of no known value: for a known one numba compiles what is called with it once more
WHOLE = np.int64(0)
# small boxes along an axis of a large one
_SPLIT = 2
_SMALL = _SPLIT**3
# points that a small box should hold, on the average
_FEWEST = 6


@exact
def _ball(balls, n, points, signs, first, last):
    """Centre, radius and side of a ball about points first..last: the one about their box."""
    low_x = low_y = low_z = math.inf
    high_x = high_y = high_z = -math.inf
    for m in range(first, last):
        low_x, high_x = min(low_x, points[0, m]), max(high_x, points[0, m])
        low_y, high_y = min(low_y, points[1, m]), max(high_y, points[1, m])
        low_z, high_z = min(low_z, points[2, m]), max(high_z, points[2, m])
    balls[0, n], balls[1, n], balls[2, n] = (low_x + high_x) / 2, (low_y + high_y) / 2, (low_z + high_z) / 2
    most = 0.0
    for m in range(first, last):
        x, y, z = points[0, m] - balls[0, n], points[1, m] - balls[1, n], points[2, m] - balls[2, n]
        most = max(most, x * x + y * y + z * z)
    balls[3, n], balls[4, n] = math.sqrt(most), signs[first]


@exact
def _assign(points, kinds, where, number, low_x, low_y, low_z, width, rows, columns, key):
    """The small box of each point, numbered so that those of a large one follow each other; how many hold points."""
    met = np.zeros(16384 + 4 * number, np.bool_)
    boxes = 0
    for n in range(number):
        m = where[n]
        i, j = int((points[m, 0] - low_x) / width), int((points[m, 1] - low_y) / width)
        k = int((points[m, 2] - low_z) / width)
        large = ((i // _SPLIT) * rows + j // _SPLIT) * columns + k // _SPLIT
        small = ((i % _SPLIT) * _SPLIT + j % _SPLIT) * _SPLIT + k % _SPLIT
        key[n] = (large * 2 + (kinds[m] < 0)) * _SMALL + small
        boxes += not met[key[n]]
        met[key[n]] = True
    return boxes


def _sort_points(
    points, kinds, edge, surface, hinged, signs, small_first, small_balls, large_first, large_balls, counts, part
):
    for b in indices(part, len(points)):
        own, kind = points[b], kinds[b]
        number = seen = WHOLE
        where = np.empty(len(kind), np.int32)
        low_x = low_y = low_z = math.inf
        high_x = high_y = high_z = -math.inf
        for m in range(len(kind)):
            if kind[m] == 2:
                surface[b, 0, seen], surface[b, 1, seen], surface[b, 2, seen] = own[m, 0], own[m, 1], own[m, 2]
                seen += 1
            elif kind[m] != 0:
                where[number] = m
                number += 1
                low_x, high_x = min(low_x, own[m, 0]), max(high_x, own[m, 0])
                low_y, high_y = min(low_y, own[m, 1]), max(high_y, own[m, 1])
                low_z, high_z = min(low_z, own[m, 2]), max(high_z, own[m, 2])
        counts[b, 0], counts[b, 1], counts[b, 2], counts[b, 3] = seen, number, 0, 0
        if number == 0:
            continue
        width, boxes = np.float64(edge), number
        key = np.empty(number, np.int32)
        # wider where they would hold but a few points each
        while boxes * _FEWEST > number:
            wide = math.floor((high_x - low_x) / (_SPLIT * width)) + 1.0
            deep = math.floor((high_y - low_y) / (_SPLIT * width)) + 1.0
            tall = math.floor((high_z - low_z) / (_SPLIT * width)) + 1.0
            if wide * deep * tall * 2 * _SMALL <= 16384 + 4 * number:
                boxes = _assign(own, kind, where, number, low_x, low_y, low_z, width, int(deep), int(tall), key)
                if wide * deep * tall == 1.0:
                    break
            width *= 1.6
        last = 0
        for n in range(number):
            last = max(last, key[n])
        start = np.zeros(last // _SMALL * _SMALL + _SMALL + 1, np.int32)
        for n in range(number):
            start[key[n] + 1] += 1
        for c in range(1, len(start)):
            start[c] += start[c - 1]
        place = start[:-1].copy()
        for n in range(number):
            m, to = where[n], place[key[n]]
            place[key[n]] = to + 1
            hinged[b, 0, to], hinged[b, 1, to], hinged[b, 2, to] = own[m, 0], own[m, 1], own[m, 2]
            signs[b, to] = kind[m]
        smalls = larges = WHOLE
        for large in range((len(start) - 1) // _SMALL):
            first, last = start[large * _SMALL], start[(large + 1) * _SMALL]
            if first == last:
                continue
            large_first[b, larges] = smalls
            _ball(large_balls[b], larges, hinged[b], signs[b], first, last)
            larges += 1
            for c in range(large * _SMALL, (large + 1) * _SMALL):
                if start[c] < start[c + 1]:
                    small_first[b, smalls] = start[c]
                    _ball(small_balls[b], smalls, hinged[b], signs[b], start[c], start[c + 1])
                    smalls += 1
        small_first[b, smalls], large_first[b, larges] = number, smalls
        counts[b, 2], counts[b, 3] = smalls, larges


@block
def local(x, y, z, pose):
    """A point of the frame in the object's; the pose as `placed` gives it."""
    x, y, z = x - pose[9], y - pose[10], z - pose[11]
    return (
        pose[0] * x + pose[3] * y + pose[6] * z,
        pose[1] * x + pose[4] * y + pose[7] * z,
        pose[2] * x + pose[5] * y + pose[8] * z,
    )


@fast
def _clearances(balls, count, pose, flat, lattice, steepness, limit, far):
    """By how much the points of each ball are surely further than `limit` on their own side, metres."""
    kind = flat.dtype.type
    room = balls.shape[1]
    given = balls.reshape(-1)
    for n in range(count):
        x, y, z = at(given, n), at(given, room + n), at(given, 2 * room + n)
        u, v, w = local(x, y, z, pose)
        # a margin against rounding
        slack = kind(1e-5) * (kind(1.0) + abs(u) + abs(v) + abs(w))
        distance = at(given, 4 * room + n) * value(u, v, w, flat, lattice)
        put(far, n, distance - steepness * at(given, 3 * room + n) - limit - slack)


@exact
def near_points(scene, pose, flat, lattice, steepness, limit, more):
    """Points (x, y, z, sign by M) that may be less than `limit` on their own side, with room for `more`; how many.

    Scene: one row each of the arrays of `Tiles`, the surface left out.
    """
    hinged, signs, small_first, small_balls, large_first, large_balls, counts = scene
    smalls, larges = counts[2], counts[3]
    far = np.empty(smalls, flat.dtype)
    chosen = np.empty(smalls, np.int32)
    balls = np.empty((5, smalls), flat.dtype)
    _clearances(large_balls, larges, pose, flat, lattice, steepness, limit, far)
    count = WHOLE
    for n in range(larges):
        if not far[n] >= 0:
            for c in range(large_first[n], large_first[n + 1]):
                chosen[count] = c
                for row in range(5):
                    balls[row, count] = small_balls[row, c]
                count += 1
    _clearances(balls, count, pose, flat, lattice, steepness, limit, far)
    left, number = 0, 0
    for n in range(count):
        if not far[n] >= 0:
            chosen[left] = chosen[n]
            number += small_first[chosen[n] + 1] - small_first[chosen[n]]
            left += 1
    near = np.empty((4, number + more), flat.dtype)
    number = 0
    for n in range(left):
        for m in range(small_first[chosen[n]], small_first[chosen[n] + 1]):
            near[0, number], near[1, number], near[2, number] = hinged[0, m], hinged[1, m], hinged[2, m]
            near[3, number] = signs[m]
            number += 1
    return near, number


sort_points = Kernel(_sort_points)
