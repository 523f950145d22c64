"""The compiled CPU version of pushes along a path; `along_path.py` has the definition.

What a tool and an object are to each other comes as `along_path.contact_arrays` gives it, here `contact`, and how
objects slide as `slides`: their centres, levers, frictions and quartics.
"""

import math

import numpy as np

from rumi.dynamics.sliding_numba import settled, slope, turned, value
from sdf.compiled import Kernel, bare
from sdf.part_numba import indices

_ROUNDING_M = 1e-6  # by which a value may be off, of numbers of single precision


@bare
def _rectangle(x, y, half_x, half_y):
    """Signed distance and gradient of a rectangle."""
    u, v = abs(x) - half_x, abs(y) - half_y
    side_x, side_y = -1.0 if x < 0.0 else 1.0, -1.0 if y < 0.0 else 1.0
    if u > 0.0 and v > 0.0:
        length = math.sqrt(u * u + v * v)
        return length, side_x * u / length, side_y * v / length
    if u >= v:
        return u, side_x, 0.0
    return v, 0.0, side_y


@bare
def _outline(x, y, table, shape):
    """Signed distance of the outline."""
    if shape[0] > 0.0:
        return _rectangle(x, y, shape[1], shape[2])[0]
    return value(x, y, table, shape[1], shape[2], shape[3])


@bare
def gradient(x, y, table, shape):
    """Gradient of it."""
    if shape[0] > 0.0:
        _, gx, gy = _rectangle(x, y, shape[1], shape[2])
        return gx, gy
    return slope(x, y, table, shape[1], shape[2], shape[3])


@bare
def measure(contact, along):
    """By how much the outline's values may differ from the tool's first point to each other one, along its border."""
    points, shape = contact[0], contact[2]
    total = 0.0
    for k in range(len(points)):
        if k > 0:
            dx, dy = points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1]
            total += shape[4] * math.sqrt(dx * dx + dy * dy)
        along[k] = total


@bare
def nearest(x, y, yaw, tool_x, tool_y, tool_yaw, contact, below, along):
    """The tool's first point that is nearest to the object, its distance, and its place in the object's frame.

    Points are passed over that are farther than the nearest one so far: values outside the object change no more
    than `along` does (`measure`). Where none is nearer than `below`, that is the distance.
    """
    points, table, shape = contact[0], contact[1], contact[2]
    cos, sin = math.cos(yaw), math.sin(yaw)
    tool_cos, tool_sin = math.cos(tool_yaw), math.sin(tool_yaw)
    least, best, at_x, at_y = below, 0, 0.0, 0.0
    k, count = 0, len(points)
    while k < count:
        dx = tool_x + tool_cos * points[k, 0] - tool_sin * points[k, 1] - x
        dy = tool_y + tool_sin * points[k, 0] + tool_cos * points[k, 1] - y
        place_x, place_y = cos * dx + sin * dy, cos * dy - sin * dx
        found = _outline(place_x, place_y, table, shape)
        if found < least:
            least, best, at_x, at_y = found, k, place_x, place_y
        passed = along[k] + found - max(least, 0.0) - _ROUNDING_M
        k += 1
        while k < count and along[k] <= passed:
            k += 1
    return least, best, at_x, at_y


@bare
def sliding_at(e, slides):
    """How one object slides, as `settled` takes it."""
    centre, lever, friction, quartic = slides
    return (
        float(centre[e, 0]),
        float(centre[e, 1]),
        float(lever[e]),
        float(friction[e]),
        float(quartic[e, 0]),
        float(quartic[e, 1]),
        float(quartic[e, 2]),
        float(quartic[e, 3]),
        float(quartic[e, 4]),
    )


@bare
def advanced(x, y, yaw, path, row, instant, contact, body, along):
    """Pose of an object after the tool's way from one instant to the next."""
    points, table, shape, sizes, counts = contact
    thickness, reach, substeps, passes = sizes[0], sizes[1], counts[0], counts[1]
    from_x, from_y, from_yaw = (
        float(path[row, instant, 0]),
        float(path[row, instant, 1]),
        float(path[row, instant, 2]),
    )
    way_x = (path[row, instant + 1, 0] - from_x) / substeps
    way_y = (path[row, instant + 1, 1] - from_y) / substeps
    way_yaw = (path[row, instant + 1, 2] - from_yaw) / substeps
    for part in range(substeps):
        tool_x, tool_y = from_x + (part + 1) * way_x, from_y + (part + 1) * way_y
        if (tool_x - x) * (tool_x - x) + (tool_y - y) * (tool_y - y) >= reach * reach:
            continue
        tool_yaw = from_yaw + (part + 1) * way_yaw
        tool_cos, tool_sin = math.cos(tool_yaw), math.sin(tool_yaw)
        first = (x, y, yaw)
        for _ in range(passes):
            apart, k, at_x, at_y = nearest(x, y, yaw, tool_x, tool_y, tool_yaw, contact, thickness, along)
            depth = thickness - apart
            if not depth > 0.0:
                break
            gx, gy = gradient(at_x, at_y, table, shape)
            x, y, yaw, _, _ = settled(
                x,
                y,
                yaw,
                math.cos(yaw),
                math.sin(yaw),
                first,
                (tool_x, tool_y),
                (way_x, way_y, way_yaw),
                turned(-way_yaw),
                tool_cos * points[k, 0] - tool_sin * points[k, 1],
                tool_sin * points[k, 0] + tool_cos * points[k, 1],
                gx,
                gy,
                depth,
                thickness,
                body,
            )
    return x, y, yaw


@bare
def _one(e, poses, path, contact, slides, along, track, distance):
    x, y, yaw = float(poses[e, 0]), float(poses[e, 1]), float(poses[e, 2])
    row = e if len(path) > 1 else 0
    body = sliding_at(e, slides)
    for instant in range(path.shape[1] - 1):
        x, y, yaw = advanced(x, y, yaw, path, row, instant, contact, body, along)
        track[e, instant, 0], track[e, instant, 1], track[e, instant, 2] = x, y, yaw
        if distance.shape[1] == 0:
            continue
        end = instant + 1
        tool_x, tool_y, tool_yaw = float(path[row, end, 0]), float(path[row, end, 1]), float(path[row, end, 2])
        apart, _, _, _ = nearest(x, y, yaw, tool_x, tool_y, tool_yaw, contact, math.inf, along)
        distance[e, instant] = apart - contact[3][0]


def _push_along_path(poses, path, contact, slides, track, distance, part):
    along = np.empty(len(contact[0]))
    measure(contact, along)
    for e in indices(part, len(poses)):
        # a signed index: a parallel loop's is unsigned, which with a signed one makes no index
        _one(np.int64(e), poses, path, contact, slides, along, track, distance)


push_along_path = Kernel(_push_along_path)
