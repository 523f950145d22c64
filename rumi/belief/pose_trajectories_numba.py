"""The compiled CPU version of replayed trajectories; `pose_trajectories.py` has the definition."""

import math

import numpy as np

from rumi.dynamics.sliding_numba import settled, slope, value
from sdf.compiled import Kernel, bare
from sdf.grid_numba import lattice_of
from sdf.grid_numba import value as distance_at
from sdf.part_numba import indices


@bare
def _deepest(x, y, yaw, tool_x, tool_y, tool_yaw, tool, table, numbers):
    """Least distance of the tool's border from the object, the point there, and its place in the object's frame."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    off_x, off_y = tool_x - x, tool_y - y
    off_x, off_y = cos * off_x + sin * off_y, cos * off_y - sin * off_x
    cos, sin = math.cos(tool_yaw - yaw), math.sin(tool_yaw - yaw)
    square = numbers[4] * numbers[4]
    least, best, at_x, at_y = math.inf, 0, 0.0, 0.0
    for k in range(len(tool)):
        place_x = off_x + cos * tool[k, 0] - sin * tool[k, 1]
        place_y = off_y + sin * tool[k, 0] + cos * tool[k, 1]
        if place_x * place_x + place_y * place_y > square:  # not within the object, whatever its yaw
            continue
        found = value(place_x, place_y, table, numbers[0], numbers[1], numbers[2])
        if found < least:
            least, best, at_x, at_y = found, k, place_x, place_y
    return least, best, at_x, at_y


@bare
def _tailed(z, tails):
    return z * math.exp(0.5 * tails * z * z)


@bare
def _point(v, kind, logs, step):
    """Log-likelihood of a point at a signed distance from the surface, by a table; beyond it as at its ends."""
    last = logs.shape[1] - 1
    place = min(max(v / step + 0.5 * last, 0.0), last - 1e-6)
    low = int(place)
    return logs[kind, low] + (place - low) * (logs[kind, low + 1] - logs[kind, low])


@bare
def _stepped(x, y, yaw, before, after, tool, table, numbers, scales, body, noise):
    """Pose after an instant's push and the noise of it."""
    from_x, from_y, tool_x, tool_y, tool_yaw = before[0], before[1], after[0], after[1], after[2]
    if (tool_x - x) ** 2 + (tool_y - y) ** 2 >= numbers[3] * numbers[3]:
        return x, y, yaw
    first = (x, y, yaw)
    way_x, way_y = tool_x - from_x, tool_y - from_y
    way = (way_x, way_y, tool_yaw - before[2])
    length = max(math.sqrt(way_x * way_x + way_y * way_y), 1e-12)
    unit_x, unit_y = way_x / length, way_y / length
    cos, sin = math.cos(yaw), math.sin(yaw)
    centre_x = body[0] + body[2] * (cos * unit_x + sin * unit_y)
    centre_y = body[1] + body[2] * (cos * unit_y - sin * unit_x)
    tool_cos, tool_sin = math.cos(tool_yaw), math.sin(tool_yaw)
    touched = False
    for _ in range(2):
        apart, k, at_x, at_y = _deepest(x, y, yaw, tool_x, tool_y, tool_yaw, tool, table, numbers)
        if not apart < 0.0:
            break
        touched = True
        gx, gy = slope(at_x, at_y, table, numbers[0], numbers[1], numbers[2])
        x, y, yaw = settled(
            x,
            y,
            yaw,
            first,
            (tool_x, tool_y),
            way,
            tool_cos * tool[k, 0] - tool_sin * tool[k, 1],
            tool_sin * tool[k, 0] + tool_cos * tool[k, 1],
            gx,
            gy,
            -apart,
            0.0,
            (centre_x, centre_y, body[3], body[4], 0.0, 0.0, 0.0, 0.0, 0.0),
        )
    if not touched:
        return x, y, yaw
    dx, dy, turn = x - first[0], y - first[1], yaw - first[2]
    length = math.sqrt(dx * dx + dy * dy)
    size = length + scales[12] * abs(turn)
    if length > 1e-9:
        unit_x, unit_y = dx / length, dy / length
    along, across = noise[0] * size * scales[9], noise[1] * size * scales[10]
    return (
        x + along * unit_x - across * unit_y,
        y + along * unit_y + across * unit_x,
        yaw + noise[2] * size * scales[11],
    )


@bare
def _one(
    n,
    first,
    poses,
    logs,
    physics,
    noises,
    path,
    pushes,
    ends,
    action,
    points,
    kind,
    weight,
    point_ends,
    tool,
    table,
    numbers,
    scales,
    priced,
    flat,
    lattice,
):
    begin = first[n]
    x, y, yaw = poses[n, begin, 0], poses[n, begin, 1], poses[n, begin, 2]
    ahead = scales[4] + scales[5] * physics[n, 4]
    centre_x, centre_y = numbers[6] + scales[6] * physics[n, 2], numbers[7] + scales[6] * physics[n, 3]
    own, together = math.sqrt(1.0 - scales[14]), math.sqrt(scales[14])
    for segment in range(begin, len(ends)):
        shared, log = action[segment], 0.0
        friction = scales[0] * math.exp(scales[1] * physics[n, 0] + scales[7] * noises[n, segment, 0])
        lever = scales[3] * physics[n, 1] + scales[8] * noises[n, segment, 1]
        lever = numbers[5] * scales[2] * math.exp(lever)
        body = (centre_x, centre_y, ahead, lever, friction)
        noise = (
            _tailed(own * noises[n, segment, 2] + together * noises[n, shared, 5], scales[13]),
            _tailed(own * noises[n, segment, 3] + together * noises[n, shared, 6], scales[13]),
            _tailed(own * noises[n, segment, 4] + together * noises[n, shared, 7], scales[13]),
        )
        for instant in range(ends[segment - 1] if segment > 0 else 0, ends[segment]):
            if pushes[instant]:
                before = (path[instant, 0, 0], path[instant, 0, 1], path[instant, 0, 2])
                after = (path[instant, 1, 0], path[instant, 1, 1], path[instant, 1, 2])
                x, y, yaw = _stepped(x, y, yaw, before, after, tool, table, numbers, scales, body, noise)
            cos, sin = math.cos(yaw), math.sin(yaw)
            for m in range(point_ends[instant - 1] if instant > 0 else 0, point_ends[instant]):
                dx, dy = points[m, 0] - x, points[m, 1] - y
                found = distance_at(
                    np.float32(cos * dx + sin * dy),
                    np.float32(cos * dy - sin * dx),
                    np.float32(points[m, 2]),
                    flat,
                    lattice,
                )
                log += weight[m] * _point(float(found), kind[m], priced, scales[15])
        poses[n, segment + 1, 0], poses[n, segment + 1, 1], poses[n, segment + 1, 2] = x, y, yaw
        logs[n, segment] = log


def _replay(
    first,
    poses,
    logs,
    physics,
    noises,
    path,
    pushes,
    ends,
    action,
    points,
    kind,
    weight,
    point_ends,
    tool,
    table,
    numbers,
    scales,
    priced,
    grid,
    part,
):
    lattice = lattice_of(grid[1], grid[2])
    for n in indices(part, len(poses)):
        _one(
            np.int64(n),
            first,
            poses,
            logs,
            physics,
            noises,
            path,
            pushes,
            ends,
            action,
            points,
            kind,
            weight,
            point_ends,
            tool,
            table,
            numbers,
            scales,
            priced,
            grid[0],
            lattice,
        )


replay = Kernel(_replay)
