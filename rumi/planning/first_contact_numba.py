"""The compiled CPU version of first contacts; `first_contact.py` has the definition.

A way is gone through as a ray is by sphere tracing: what no point of the tool can reach before a later step is not
looked at before it. Groups of points whose ball is clear of the object are looked up once.
"""

import math

import numpy as np

from sdf.compiled import Kernel
from sdf.grid_numba import exact, fast, lattice_of, value
from sdf.intrinsics_numba import at, put
from sdf.part_numba import indices

_UNEVEN_M = 1e-3  # by which a table's distances may change more than a point moves


@fast
def _tool_in(m, n, x, y, z, c, s):
    """Rotation, row by row, and place of the tool in the frame of object n; c, s are of the tool's yaw."""
    a, b = m[n, 0], m[n, 1]
    d, e = m[n, 4], m[n, 5]
    g, h = m[n, 8], m[n, 9]
    return (
        a * c + b * s,
        b * c - a * s,
        m[n, 2],
        d * c + e * s,
        e * c - d * s,
        m[n, 6],
        g * c + h * s,
        h * c - g * s,
        m[n, 10],
        a * x + b * y + m[n, 2] * z + m[n, 3],
        d * x + e * y + m[n, 6] * z + m[n, 7],
        g * x + h * y + m[n, 10] * z + m[n, 11],
    )


@fast
def _apart(tool, points, first, count, size, flat, lattice, found):
    """Signed distances of some of the tool's points, of which there are `size`, coordinate by coordinate."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22, x, y, z = tool
    for index in range(count):
        px, py, pz = at(points, first + index), at(points, size + first + index), at(points, 2 * size + first + index)
        distance = value(
            m00 * px + m01 * py + m02 * pz + x,
            m10 * px + m11 * py + m12 * pz + y,
            m20 * px + m21 * py + m22 * pz + z,
            flat,
            lattice,
        )
        put(found, index, distance)


@exact
def _measure(way, count, radius, told):
    """What all objects share of a way's steps: cosine and sine of the yaw, and how far each takes the tool at most."""
    for step in range(count):
        told[0, step], told[1, step], told[2, step] = math.cos(way[step, 3]), math.sin(way[step, 3]), 0.0
        if step > 0:
            dx, dy = way[step, 0] - way[step - 1, 0], way[step, 1] - way[step - 1, 1]
            dz, turn = way[step, 2] - way[step - 1, 2], way[step, 3] - way[step - 1, 3]
            told[2, step] = math.sqrt(dx * dx + dy * dy + dz * dz) + radius * abs(turn)


def _first_contacts(ways, steps, rows, points, spheres, numbers, grid, step, point, looked, part):
    lattice, flat = lattice_of(grid[1], grid[2]), grid[0]
    near, radius, let_go, groups, poses = numbers[0], numbers[1], numbers[2], len(spheres) // 4, len(rows)
    size = len(points) // (3 * groups)
    bounds, distances = np.empty(groups, np.float32), np.empty(size, np.float32)
    told, measured = np.empty((3, ways.shape[1]), np.float32), np.int64(-1)
    for pair in indices(part, len(steps) * poses):
        k, n = np.int64(pair // poses), pair % poses
        if k != measured:
            _measure(ways[k], steps[k], radius, told)
            measured = k
        last, now, asked, found = steps[k], np.int64(0), 0, np.int64(0)
        floor = near  # what is nearer than this is a contact; less while the tool lets go
        while now < last:
            tool = _tool_in(rows, n, ways[k, now, 0], ways[k, now, 1], ways[k, now, 2], told[0, now], told[1, now])
            asked += 1
            clear, deepest = np.float32(1e9), near
            met = np.int64(-1)
            _apart(tool, spheres, 0, groups, groups, flat, lattice, bounds)
            for group in range(groups):
                apart = bounds[group] - at(spheres, 3 * groups + group)
                if apart >= deepest + np.float32(_UNEVEN_M):
                    clear = min(clear, apart)
                    continue
                _apart(tool, points, size * group, size, size * groups, flat, lattice, distances)
                for index in range(size):
                    clear = min(clear, distances[index])
                    if distances[index] < deepest:
                        deepest, met = distances[index], np.int64(size * group + index)
            if now == 0:
                floor = deepest
            if met >= 0 and deepest < (floor if floor == near else floor - let_go):
                found = met
                now = now if floor == near else np.int64(0)
                break
            floor = max(floor, deepest)
            room, went = clear - near - np.float32(_UNEVEN_M), np.float32(0.0)
            now += 1
            while now < last:
                went += told[2, now]
                if went > room:
                    break
                now += 1
        step[k, n], point[k, n], looked[k, n] = min(now, last), found, asked


first_contacts = Kernel(_first_contacts)
