"""The compiled CPU version of replayed trajectories; `trajectory_likelihood.py` has the definition."""

import math

import numpy as np

from rumi.belief.facing_numba import told_by_view, toward_camera
from rumi.belief.outline_depth_numba import GROUP, deepest, resized
from rumi.belief.silence_numba import SILENT, told_by_silence
from rumi.dynamics.sliding_numba import gathered, settled, slope, turned
from sdf.compiled import Kernel, bare
from sdf.grid_numba import between, block, fast, lattice_of
from sdf.grid_numba import value as distance_at
from sdf.intrinsics_numba import at
from sdf.part_numba import indices

_SLACK = 1e-6  # nats by which sums in another order may differ
_BLOCK = 64  # points of an instant after which it is asked whether a particle is given up


@fast
def _readings(first, last, pose, worn, points, weight, row, logs, inverse, flat, lattice):
    """Log-likelihood of the points from one to before another, of their distances from the surface by a table."""
    x, y, cos, sin = pose
    count, nodes = len(weight), logs.shape[1]
    priced = logs.reshape(-1)
    half, top = np.float32(0.5 * (nodes - 1)) + worn * inverse, np.float32(nodes - 1.01)
    total = np.float32(0.0)
    for m in range(first, last):
        dx, dy = at(points, m) - x, at(points, count + m) - y
        found = distance_at(cos * dx + sin * dy, cos * dy - sin * dx, at(points, 2 * count + m), flat, lattice)
        total += at(weight, m) * between(found * inverse + half, top, priced, at(row, m))
    return total


@block
def _of_the_model(lattice, size, lift):
    """A lattice that takes points of an object of another size, once they are lifted to where its model's are."""
    kind = type(lattice[0])
    per_m = lattice[0] / kind(size)
    placed = per_m, lattice[1], lattice[2], lattice[3] + per_m * kind(lift)
    return placed + lattice[4:]


@bare
def _apart(x, y, yaw, before, after, worn, shape):
    """Whether the tool, where it ends, is farther from the object than it went: it touched nothing on the way."""
    numbers = shape[3]
    way_x, way_y = after[0] - before[0], after[1] - before[1]
    travel = math.sqrt(way_x * way_x + way_y * way_y) + (numbers[3] - numbers[4]) * abs(after[2] - before[2])
    far_x, far_y, reach = after[0] - x, after[1] - y, numbers[3] + travel
    if far_x * far_x + far_y * far_y >= reach * reach:
        return True
    placed = (after[0], after[1], math.cos(after[2]), math.sin(after[2]))
    edge = travel + max(0.0, -worn)
    return deepest(x, y, yaw, placed, -edge, shape)[0] > edge


@bare
def _slid(x, y, yaw, before, after, worn, shape, rim, body):
    """Pose after a small push, and whether there was one."""
    tool, table, numbers = shape[0], shape[2], shape[3]
    from_x, from_y, tool_x, tool_y, tool_yaw = before[0], before[1], after[0], after[1], after[2]
    if (tool_x - x) ** 2 + (tool_y - y) ** 2 >= numbers[3] * numbers[3]:
        return x, y, yaw, False
    tool_cos, tool_sin = math.cos(tool_yaw), math.sin(tool_yaw)
    placed = (tool_x, tool_y, tool_cos, tool_sin)
    apart, k, at_x, at_y = deepest(x, y, yaw, placed, worn, shape)
    if not apart + worn < 0.0:
        return x, y, yaw, False
    first, count = (x, y, yaw), len(tool) // 2
    way_x, way_y = tool_x - from_x, tool_y - from_y
    way = (way_x, way_y, tool_yaw - before[2])
    length = max(math.sqrt(way_x * way_x + way_y * way_y), 1e-12)
    unit_x, unit_y = way_x / length, way_y / length
    cos, sin = math.cos(yaw), math.sin(yaw)
    in_x, in_y = cos * unit_x + sin * unit_y, cos * unit_y - sin * unit_x
    ahead, lever = numbers[8] * body[2], body[3]
    if rim > 0.0 and length > 1e-9:  # what a turn of the tool alone pushes goes nowhere ahead
        behind = (body[0] - at_x) * in_x + (body[1] - at_y) * in_y
        ahead, lever = gathered(body[2], numbers[8] - body[4] * max(0.0, behind), lever)
    centre_x, centre_y = body[0] + ahead * in_x, body[1] + ahead * in_y
    for again in range(2):
        if again:
            apart, k, at_x, at_y = deepest(x, y, yaw, placed, worn, shape)
            if not apart + worn < 0.0:
                break
        gx, gy = slope(at_x, at_y, table, numbers[0], numbers[1], numbers[2])
        x, y, yaw, _, _ = settled(
            x,
            y,
            yaw,
            math.cos(yaw),
            math.sin(yaw),
            first,
            (tool_x, tool_y),
            way,
            turned(-way[2]),
            tool_cos * tool[k] - tool_sin * tool[count + k],
            tool_sin * tool[k] + tool_cos * tool[count + k],
            gx,
            gy,
            -worn - apart,
            -worn,
            (centre_x, centre_y, lever, body[4], 0.0, 0.0, 0.0, 0.0, 0.0),
        )
    return x, y, yaw, True


@bare
def _stepped(x, y, yaw, before, after, parts, worn, shape, scales, body, noise):
    """Pose after an instant's push, in so many parts, and the noise of it."""
    if parts > 1 and _apart(x, y, yaw, before, after, worn, shape):
        return x, y, yaw
    first, begin, touched = (x, y, yaw), before, False
    for part in range(1, parts + 1):
        end = after
        if part < parts:
            share = part / parts
            end = (
                before[0] + share * (after[0] - before[0]),
                before[1] + share * (after[1] - before[1]),
                before[2] + share * (after[2] - before[2]),
            )
        x, y, yaw, met = _slid(x, y, yaw, begin, end, worn, shape, scales[20], body)
        begin, touched = end, touched or met
    if not touched:
        return x, y, yaw
    dx, dy, turn = x - first[0], y - first[1], yaw - first[2]
    length = math.sqrt(dx * dx + dy * dy)
    size = length + scales[12] * abs(turn) + scales[17]
    if length > 1e-9:
        unit_x, unit_y = dx / length, dy / length
    else:
        unit_x, unit_y = after[0] - before[0], after[1] - before[1]
        length = max(math.sqrt(unit_x * unit_x + unit_y * unit_y), 1e-12)
        unit_x, unit_y = unit_x / length, unit_y / length
    along, across = noise[0] * size * scales[9], noise[1] * size * scales[10]
    return (
        x + along * unit_x - across * unit_y,
        y + along * unit_y + across * unit_x,
        yaw + noise[2] * size * scales[11],
    )


@bare
def parts_of(before, after, radius, most):
    """In how many parts a tool's motion is taken, in each of which none of it goes farther; 1 where that is 0."""
    if most <= 0.0:
        return 1
    way_x, way_y = after[0] - before[0], after[1] - before[1]
    travel = math.sqrt(way_x * way_x + way_y * way_y) + radius * abs(after[2] - before[2])
    return max(1, math.ceil(travel / most - 1e-6))


@bare
def _tool(taken, errors):
    """Where a tool is, (x, y, yaw), by where it is taken to be."""
    yaw = taken[2] - errors[2]
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y = taken[0] - cos * errors[0] + sin * errors[1], taken[1] - sin * errors[0] - cos * errors[1]
    return x, y, yaw


@bare
def _sensed(x, y, yaw, taken, seen, errors):
    """Where the object would be if camera and tool were where they are taken to be, and sensed the same."""
    if seen:
        cos, sin = math.cos(errors[6]), math.sin(errors[6])
        return cos * x - sin * y + errors[4], sin * x + cos * y + errors[5], yaw + errors[6]
    true = _tool(taken, errors)
    cos, sin = math.cos(errors[2]), math.sin(errors[2])
    x, y = x - true[0], y - true[1]
    return taken[0] + cos * x - sin * y, taken[1] + sin * x + cos * y, yaw + errors[2]


@bare
def _one(n, particles, done, sensed, shape, scales, logs, errors, eye, flat, lattice, room, numbers):
    """One particle, from its own segment on; what cannot reach its least log-likelihood any more is given up."""
    first, least, poses, found, physics, noises = particles
    path, pushes, ends, action, point_ends = done
    points, weight, row = sensed
    begin, total, exact, enough = first[n], 0.0, len(errors) == 0, least[n] - _SLACK
    worn, factor = (0.0, 1.0) if exact else (errors[n, 3], errors[n, 7])
    # distances are looked up in metres of the model, which stands higher by what is worn off, and by its size
    lift = (scales[23] + worn) - factor * scales[23]
    thin, lattice = np.float32(worn / factor), _of_the_model(lattice, factor, lift)
    resized(shape[3], factor, numbers)
    shape = shape[0], shape[1], shape[2], numbers, shape[4], shape[5]
    x, y, yaw = poses[n, begin, 0], poses[n, begin, 1], poses[n, begin, 2]
    ahead = scales[4] + scales[5] * physics[n, 4]
    centre_x, centre_y = numbers[6] + scales[6] * physics[n, 2], numbers[7] + scales[6] * physics[n, 3]
    own, together = math.sqrt(1.0 - scales[14]), math.sqrt(scales[14])
    inverse, step = np.float32(factor / scales[15]), np.float32(scales[22])
    for segment in range(begin, len(ends)):
        shared, log = action[segment], 0.0
        friction = scales[0] * math.exp(scales[1] * physics[n, 0] + scales[7] * noises[n, segment, 0])
        lever = scales[3] * physics[n, 1] + scales[8] * noises[n, segment, 1]
        lever = numbers[5] * scales[2] * math.exp(lever)
        size = math.exp(0.5 * scales[13] * noises[n, shared, 8] * noises[n, shared, 8])
        far = scales[16] * (size - 1.0)
        shift_x, shift_y = far * noises[n, shared, 9], far * noises[n, shared, 10]
        body = (centre_x + shift_x, centre_y + shift_y, ahead, lever, friction)
        noise = (
            size * (own * noises[n, segment, 2] + together * noises[n, shared, 5]),
            size * (own * noises[n, segment, 3] + together * noises[n, shared, 6]),
            size * (own * noises[n, segment, 4] + together * noises[n, shared, 7]),
        )
        for instant in range(ends[segment - 1] if segment > 0 else 0, ends[segment]):
            if pushes[instant]:
                before = (path[instant, 0, 0], path[instant, 0, 1], path[instant, 0, 2])
                after = (path[instant, 1, 0], path[instant, 1, 1], path[instant, 1, 2])
                parts = parts_of(before, after, numbers[3] - numbers[4], scales[21])
                if not exact:
                    before, after = _tool(before, errors[n]), _tool(after, errors[n])
                x, y, yaw = _stepped(x, y, yaw, before, after, parts, worn, shape, scales, body, noise)
            point, last = point_ends[instant - 1] if instant > 0 else 0, point_ends[instant]
            if point < last:
                at_x, at_y, turned = x, y, yaw
                if not exact:
                    taken = (path[instant, 1, 0], path[instant, 1, 1], path[instant, 1, 2])
                    at_x, at_y, turned = _sensed(x, y, yaw, taken, row[point] == 0, errors[n])
                pose = np.float32(at_x), np.float32(at_y), np.float32(math.cos(turned)), np.float32(math.sin(turned))
                behind = last
                while behind > point and row[behind - 1] == SILENT:
                    behind -= 1
                if len(eye) > 0 and row[point] == 0:  # what was seen comes first
                    shown = point
                    while shown < behind and row[shown] == 0:
                        shown += 1
                    seen_from = eye[0], eye[1], eye[2] + lift
                    toward = toward_camera(
                        at_x, at_y, math.cos(turned), math.sin(turned), seen_from, factor * scales[22]
                    )
                    while point < shown and total + log >= enough:
                        to = min(point + _BLOCK, shown)
                        log += told_by_view(
                            point, to, pose, thin, toward, step, points, weight, row, logs, inverse, flat, lattice, room
                        )
                        point = to
                while point < behind and total + log >= enough:
                    to = min(point + _BLOCK, behind)
                    log += _readings(point, to, pose, thin, points, weight, row, logs, inverse, flat, lattice)
                    point = to
                if behind < last:
                    told = _readings(behind, last, pose, thin, points, weight, row, logs, inverse, flat, lattice)
                    log += told_by_silence(told, scales[18], scales[19] if segment == len(ends) - 1 else 1.0)
            # no reading's log-likelihood is above 0: what is too little now stays so
            if total + log < enough:
                found[n, segment] = -math.inf
                return
        poses[n, segment + 1, 0], poses[n, segment + 1, 1], poses[n, segment + 1, 2] = x, y, yaw
        found[n, segment] = log
        total += log


def _replay(particles, done, sensed, shape, scales, logs, errors, eye, grid, part):
    lattice, count = lattice_of(grid[1], grid[2]), len(sensed[1])
    room = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.int32)
    tool, groups, table, numbers = shape
    shape = tool, groups, table, numbers, np.empty(len(groups) // 3), np.empty(GROUP)
    own = np.empty(len(numbers))
    for n in indices(part, len(particles[0])):
        _one(np.int64(n), particles, done, sensed, shape, scales, logs, errors, eye, grid[0], lattice, room, own)


replay = Kernel(_replay)
