"""Building blocks of compiled replays: how deep a tool's border is in an object's outline, in another size or worn."""

import math

import numba
import numpy as np

from sdf.compiled import bare
from sdf.grid_numba import block, exact
from sdf.intrinsics_numba import at, next_to, node, put, whole

GROUP = 8
"""Points of the tool's border that are left out together: as many as are looked up at a time."""


@block
def _value(x, y, values, numbers):
    """Signed distance at a point of the object's frame, as `sliding_numba.value` has it, without a branch."""
    low_x, low_y, spacing, last_x, last_y, columns, size = numbers
    u, v = (x - low_x) / spacing, (y - low_y) / spacing
    a = u if u > 0.0 else 0.0
    a = a if a < last_x else last_x
    b = v if v > 0.0 else 0.0
    b = b if b < last_y else last_y
    far_x, far_y = spacing * (u - a), spacing * (v - b)
    i, j = whole(a if a < last_x - 1.0 else last_x - 1.0), whole(b if b < last_y - 1.0 else last_y - 1.0)
    a, b = a - i, b - j
    one = numba.int32(1)
    near = node(i, j, numba.int32(0), columns, one)
    beside = next_to(near, columns)
    v00, v10 = at(values, near), at(values, beside)
    low = v00 + b * (at(values, next_to(near, one)) - v00)
    high = v10 + b * (at(values, next_to(beside, one)) - v10)
    there = size * (low + a * (high - low))
    beyond = math.sqrt(there * there + far_x * far_x + far_y * far_y)
    return beyond if (far_x != 0.0) | (far_y != 0.0) else there


@exact
def _bounds(placed, radius, slack, groups, values, numbers, least):
    """Least distance from the object that points of each of the tool's groups can have; infinite for what is apart."""
    off_x, off_y, cos, sin = placed
    count = len(groups) // 3
    for g in range(count):
        px, py, far = at(groups, g), at(groups, count + g), at(groups, 2 * count + g)
        x, y = off_x + cos * px - sin * py, off_y + sin * px + cos * py
        reach = radius + far
        found = _value(x, y, values, numbers) - far - slack
        put(least, g, math.inf if x * x + y * y > reach * reach else found)


@exact
def _distances(first, placed, square, tool, values, numbers, found):
    """Distance from the object of each point of a group; infinite for what cannot be in it, whatever its yaw."""
    off_x, off_y, cos, sin = placed
    count = len(tool) // 2
    for k in range(GROUP):
        px, py = at(tool, first + k), at(tool, count + first + k)
        x, y = off_x + cos * px - sin * py, off_y + sin * px + cos * py
        there = _value(x, y, values, numbers)
        put(found, k, math.inf if x * x + y * y > square else there)


@bare
def deepest(x, y, yaw, at_tool, worn, shape):
    """Least distance of the tool's border from the object, the point there, and its place in the object's frame.

    A group of points is left out where its disc is too far for one of them to be in the object, or deeper than found;
    a negative wear lets the object be that much larger. Of two points as deep it is the first.
    """
    tool, groups, table, numbers, near, found = shape
    tool_x, tool_y, tool_cos, tool_sin = at_tool
    cos, sin = math.cos(yaw), math.sin(yaw)
    off_x, off_y = tool_x - x, tool_y - y
    off_x, off_y = cos * off_x + sin * off_y, cos * off_y - sin * off_x
    cos, sin = tool_cos * cos + tool_sin * sin, tool_sin * cos - tool_cos * sin
    placed = (off_x, off_y, cos, sin)
    edge = max(0.0, -worn)
    # between nodes at a corner the table is below 0 a little beyond its radius
    radius, slack = numbers[4] + numbers[2] + edge, 2.0 * numbers[2]
    last_x, last_y, columns = table.shape[0] - 1.0, table.shape[1] - 1.0, np.int32(table.shape[1])
    lattice = (numbers[0], numbers[1], numbers[2], last_x, last_y, columns, numbers[9])
    values, count = table.reshape(-1), len(tool) // 2
    _bounds(placed, radius, slack, groups, values, lattice, near)
    least, best, first = math.inf, count, 0
    for group in range(1, len(near)):
        first = group if near[group] < near[first] else first
    for turn in range(-1, len(near)):
        group = first if turn < 0 else turn
        if turn == first or near[group] > min(least, edge):
            continue
        _distances(GROUP * group, placed, radius * radius, tool, values, lattice, found)
        for k in range(GROUP):
            point = GROUP * group + k
            if found[k] < least or (found[k] == least and point < best):
                least, best = found[k], point
    if not least < math.inf:
        return least, 0, 0.0, 0.0
    px, py = tool[best], tool[count + best]
    return least, best, off_x + cos * px - sin * py, off_y + sin * px + cos * py


@bare
def resized(numbers, size, own):
    """Numbers of the outline in another size; spread and centre stay."""
    for k in range(len(numbers)):
        own[k] = numbers[k]
    own[3] += (size - 1.0) * numbers[4]
    own[9] = size
    for k in (0, 1, 2, 4):
        own[k] *= size
