"""Building blocks of compiled toppling: what of a level tool an object meets; `tool_contact.py` has the definition.

The tool comes as arrays (`tool_of`): its points by coordinate, GROUP of them to a group that lie near each other; the
groups' middles, half sides and radii, by coordinate; and room for what is found of the groups and of a group's points.
The object comes with a box (`GridSDF.box_of`) that tells how deep a point can be in it at most: groups that cannot be
deeper than what is found are left out.

Where the tool is comes as (x, y, yaw, z, cosine and sine of yaw), since many objects share it.
"""

import math

import numpy as np

from rumi.dynamics.tool_contact import GRAZE_M, GROUP, LEVEL
from sdf.compiled import bare
from sdf.grid_numba import exact, fast, value, value_and_gradient
from sdf.intrinsics_numba import at, put

_ROUNDED_M = 1e-6  # that single precision may take from a distance


@exact
def tool_of(points, groups):
    """The tool's points and groups, and room: for how deep groups can be, their numbers, how far off, and depths."""
    count = len(groups) // 7
    room = (count // GROUP + 1) * GROUP
    near, apart = np.empty(room, np.int32), np.empty(room, np.float32)
    return points, groups, np.empty(count, np.float32), near, apart, np.empty(GROUP, np.float32)


@bare
def placed(x, y, yaw, rest, edge, tilt, rests):
    """Rotation, row by row, and place of an object."""
    return placed_at(x, y, math.cos(yaw), math.sin(yaw), rest, edge, tilt, rests)


@bare
def placed_at(x, y, cos, sin, rest, edge, tilt, rests):
    """The same of an object whose yaw has this cosine and sine."""
    turn, height, point, normal = rests[0], rests[1], rests[4], rests[5]
    a00, a01, a02 = turn[rest, 0, 0], turn[rest, 0, 1], turn[rest, 0, 2]
    a10, a11, a12 = turn[rest, 1, 0], turn[rest, 1, 1], turn[rest, 1, 2]
    a20, a21, a22 = turn[rest, 2, 0], turn[rest, 2, 1], turn[rest, 2, 2]
    tx, ty, tz = 0.0, 0.0, height[rest]
    if edge >= 0:
        mx, my, px, py = normal[rest, edge, 0], normal[rest, edge, 1], point[rest, edge, 0], point[rest, edge, 1]
        c, s = math.cos(tilt), math.sin(tilt)
        r00, r01, r11 = c + (1.0 - c) * my * my, -(1.0 - c) * mx * my, c + (1.0 - c) * mx * mx
        r02, r12 = s * mx, s * my
        b00, b01, b02 = (
            r00 * a00 + r01 * a10 + r02 * a20,
            r00 * a01 + r01 * a11 + r02 * a21,
            r00 * a02 + r01 * a12 + r02 * a22,
        )
        b10, b11, b12 = (
            r01 * a00 + r11 * a10 + r12 * a20,
            r01 * a01 + r11 * a11 + r12 * a21,
            r01 * a02 + r11 * a12 + r12 * a22,
        )
        a20, a21, a22 = (
            c * a20 - r02 * a00 - r12 * a10,
            c * a21 - r02 * a01 - r12 * a11,
            c * a22 - r02 * a02 - r12 * a12,
        )
        a00, a01, a02, a10, a11, a12 = b00, b01, b02, b10, b11, b12
        dx, dy, dz = -px, -py, tz
        tx, ty, tz = (
            px + r00 * dx + r01 * dy + r02 * dz,
            py + r01 * dx + r11 * dy + r12 * dz,
            c * dz - r02 * dx - r12 * dy,
        )
    c, s = cos, sin
    return (
        c * a00 - s * a10,
        c * a01 - s * a11,
        c * a02 - s * a12,
        s * a00 + c * a10,
        s * a01 + c * a11,
        s * a02 + c * a12,
        a20,
        a21,
        a22,
        x + c * tx - s * ty,
        y + s * tx + c * ty,
        tz,
    )


@bare
def float32(frame):
    """Twelve numbers in single precision."""
    return (
        np.float32(frame[0]),
        np.float32(frame[1]),
        np.float32(frame[2]),
        np.float32(frame[3]),
        np.float32(frame[4]),
        np.float32(frame[5]),
        np.float32(frame[6]),
        np.float32(frame[7]),
        np.float32(frame[8]),
        np.float32(frame[9]),
        np.float32(frame[10]),
        np.float32(frame[11]),
    )


@bare
def _tool_in(frame, after):
    """Rotation, row by row, and place of the tool in an object's frame, single precision."""
    cos, sin = after[4], after[5]
    dx, dy, dz = after[0] - frame[9], after[1] - frame[10], after[3] - frame[11]
    return float32(
        (
            frame[0] * cos + frame[3] * sin,
            frame[3] * cos - frame[0] * sin,
            frame[6],
            frame[1] * cos + frame[4] * sin,
            frame[4] * cos - frame[1] * sin,
            frame[7],
            frame[2] * cos + frame[5] * sin,
            frame[5] * cos - frame[2] * sin,
            frame[8],
            frame[0] * dx + frame[3] * dy + frame[6] * dz,
            frame[1] * dx + frame[4] * dy + frame[7] * dz,
            frame[2] * dx + frame[5] * dy + frame[8] * dz,
        )
    )


@fast
def _bound(there, groups, box, most):
    """How deep points of each of the tool's groups can be in the object at most; single precision."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22, x, y, z = there
    a00, a01, a02, a10, a11, a12 = abs(m00), abs(m01), abs(m02), abs(m10), abs(m11), abs(m12)
    a20, a21, a22 = abs(m20), abs(m21), abs(m22)
    low_x, low_y, low_z, high_x, high_y, high_z = box
    count = len(most)
    for g in range(count):
        px, py, pz = at(groups, g), at(groups, count + g), at(groups, 2 * count + g)
        hx, hy, hz = at(groups, 3 * count + g), at(groups, 4 * count + g), at(groups, 5 * count + g)
        at_x, far_x = m00 * px + m01 * py + m02 * pz + x, a00 * hx + a01 * hy + a02 * hz
        at_y, far_y = m10 * px + m11 * py + m12 * pz + y, a10 * hx + a11 * hy + a12 * hz
        at_z, far_z = m20 * px + m21 * py + m22 * pz + z, a20 * hx + a21 * hy + a22 * hz
        deep_x = min(at_x - low_x, high_x - at_x) + far_x
        deep_y = min(at_y - low_y, high_y - at_y) + far_y
        deep_z = min(at_z - low_z, high_z - at_z) + far_z
        put(most, g, min(min(deep_x, deep_y), deep_z))


@fast
def _depths(first, there, points, found, flat, lattice):
    """How deep each of the points of a group of the tool is in an object; single precision."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22, x, y, z = there
    count = len(points) // 3
    for k in range(GROUP):
        px, py, pz = at(points, first + k), at(points, count + first + k), at(points, 2 * count + first + k)
        distance = value(
            m00 * px + m01 * py + m02 * pz + x,
            m10 * px + m11 * py + m12 * pz + y,
            m20 * px + m21 * py + m22 * pz + z,
            flat,
            lattice,
        )
        put(found, k, -distance)


@bare
def bounded(frame, after, tool, box):
    """Find how deep each of the tool's groups can be in an object at most, for `clear` and `met_within`."""
    _bound(_tool_in(frame, after), tool[1], box, tool[2])


@bare
def clear(tool):
    """How far at least the tool is from where it meets the object that it was bounded for; 0 or less where it may."""
    most = tool[2]
    deep = most[0]
    for group in range(len(most)):
        deep = max(deep, most[group])
    return -deep - GRAZE_M - _ROUNDED_M


@bare
def _near(tool):
    """How many groups can be so deep that they count, whose numbers are kept, filled up to a whole GROUP of them."""
    most, near, count = tool[2], tool[3], 0
    for group in range(len(most)):
        near[count] = group
        count += 0 if most[group] + _ROUNDED_M < -GRAZE_M else 1
    for place in range(count, (count + GROUP - 1) // GROUP * GROUP):
        near[place] = near[0]
    return count


@bare
def _apart(first, there, tool, flat, lattice):
    """Distances of the spheres about GROUP groups from the surface, negative where they may be within the object."""
    groups, near, apart = tool[1], tool[3], tool[4]
    count = len(tool[2])
    for place in range(first, first + GROUP):
        group = at(near, place)
        px, py, pz = at(groups, group), at(groups, count + group), at(groups, 2 * count + group)
        found = value(
            there[0] * px + there[1] * py + there[2] * pz + there[9],
            there[3] * px + there[4] * py + there[5] * pz + there[10],
            there[6] * px + there[7] * py + there[8] * pz + there[11],
            flat,
            lattice,
        )
        put(apart, place, found - at(groups, 6 * count + group))


@bare
def met(frame, after, tool, box, flat, lattice):
    """What of the tool an object meets: sideways, and from above or below.

    Depth sideways, the level normal into the object, and the point of the tool in the world; the same of the steep one,
    whose normal has three parts. A steep one that is less deep than a level one does nothing, and may be left out.
    """
    bounded(frame, after, tool, box)
    return met_within(frame, after, tool, False, flat, lattice)


@bare
def met_within(frame, after, tool, any_does, flat, lattice):
    """What `met` gives of a tool that was bounded for the object; where any does, the first that is inside ends it.

    The group that can be deepest in it comes first, so that few of the others are left that could be deeper.
    """
    most, near, apart = tool[2], tool[3], tool[4]
    level, steep = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (-GRAZE_M, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    best, first, count = (-1, -1), 0, _near(tool)
    if count == 0:
        return level, steep
    there = _tool_in(frame, after)
    for place in range(0, count, GROUP):
        _apart(place, there, tool, flat, lattice)
    for place in range(1, count):
        first = place if most[near[place]] > most[near[first]] else first
    for turn in range(-1, count):
        place, counts = first if turn < 0 else turn, _counts(level, steep)
        group = near[place]
        if turn == first or most[group] + _ROUNDED_M < counts or apart[place] > -counts:
            continue
        level, steep, best = _deepest(group, level, steep, best, frame, there, after, tool, flat, lattice)
        if any_does and (level[0] > 0.0 or steep[0] > 0.0):
            break
    return level, steep


@bare
def _counts(level, steep):
    """Depth below which a point does nothing."""
    return level[0] if level[0] > 0.0 else min(0.0, steep[0])


@bare
def _deepest(group, level, steep, best, frame, there, after, tool, flat, lattice):
    """Contacts, and their points, with those of one more group; of two points as deep it is the first."""
    points, found = tool[0], tool[5]
    begin, count, counts, some = GROUP * group, len(points) // 3, _counts(level, steep), 0
    _depths(begin, there, points, found, flat, lattice)
    for k in range(GROUP):
        some += 1 if found[k] >= counts else 0
    if some == 0:
        return level, steep, best
    cos, sin = after[4], after[5]
    for _ in range(GROUP):
        most = 0
        for k in range(1, GROUP):
            most = k if found[k] > found[most] else most
        depth, k = found[most], begin + most
        if not depth >= _counts(level, steep):
            break
        found[most] = -math.inf
        px, py, pz = points[k], points[count + k], points[2 * count + k]
        x = there[0] * px + there[1] * py + there[2] * pz + there[9]
        y = there[3] * px + there[4] * py + there[5] * pz + there[10]
        z = there[6] * px + there[7] * py + there[8] * pz + there[11]
        depth, gx, gy, gz = value_and_gradient(x, y, z, flat, lattice)
        depth = -depth
        size = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1e-9)
        out_x = (frame[0] * gx + frame[1] * gy + frame[2] * gz) / size
        out_y = (frame[3] * gx + frame[4] * gy + frame[5] * gz) / size
        sideways = math.sqrt(out_x * out_x + out_y * out_y)
        if sideways > LEVEL:
            if depth > level[0] or (depth == level[0] and k < best[0]):
                at_x, at_y = after[0] + cos * px - sin * py, after[1] + sin * px + cos * py
                level = (float(depth), -out_x / sideways, -out_y / sideways, at_x, at_y, float(after[3] + pz))
                best = (k, best[1])
        elif depth > steep[0] or (depth == steep[0] and k < best[1]):
            down = -(frame[6] * gx + frame[7] * gy + frame[8] * gz) / size
            at_x, at_y = after[0] + cos * px - sin * py, after[1] + sin * px + cos * py
            steep = (float(depth), float(-out_x), float(-out_y), float(down), at_x, at_y, float(after[3] + pz))
            best = (best[0], k)
    return level, steep, best
