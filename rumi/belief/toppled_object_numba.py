"""The compiled CPU version of trajectories in space; `toppled_object.py` and `toppling.py` have the definition."""

import math

import numpy as np

from rumi.dynamics.sliding_numba import settled
from sdf.compiled import Kernel, bare
from sdf.grid_numba import at, between, fast, lattice_of, value, value_and_gradient
from sdf.part_numba import indices

_LEVEL, _ACROSS, _MOST_M, _LEAST_M, _OFF_M = 0.5, 0.3, 0.012, 0.01, 0.001
_GRAZE_M, _SHARE = 0.001, 0.5
_INSTANT_S, _RATE, _LANDS_RAD, _SWINGS = 0.05, 0.5, 0.35, 0.75 * 9.81
_TILTS, _HALVES = 2, 5
_SLACK = 1e-6  # nats by which sums in another order may differ


@fast
def _readings(first, last, frame, points, weight, row, priced, inverse, half, top, flat, lattice):
    """Log-likelihood of the points from one to before another, of their distances from the surface by a table."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, x, y, z = frame
    count, total = len(weight), np.float32(0.0)
    for m in range(first, last):
        dx, dy, dz = at(points, m) - x, at(points, count + m) - y, at(points, 2 * count + m) - z
        found = value(
            r00 * dx + r10 * dy + r20 * dz,
            r01 * dx + r11 * dy + r21 * dz,
            r02 * dx + r12 * dy + r22 * dz,
            flat,
            lattice,
        )
        total += at(weight, m) * between(found * inverse + half, top, priced, at(row, m))
    return total


@fast
def _deeper(first, last, there, deep, points, flat, lattice):
    """Number of the tool's points from one to before another that are within an object by more than `deep`."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22, x, y, z = there
    count, total = len(points) // 3, np.float32(0.0)
    for k in range(first, last):
        px, py, pz = at(points, k), at(points, count + k), at(points, 2 * count + k)
        found = value(
            m00 * px + m01 * py + m02 * pz + x,
            m10 * px + m11 * py + m12 * pz + y,
            m20 * px + m21 * py + m22 * pz + z,
            flat,
            lattice,
        )
        total += np.float32(1.0) if found < -deep else np.float32(0.0)
    return total


@bare
def _placed(x, y, yaw, rest, edge, tilt, rests):
    """Rotation, row by row, and place of an object."""
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
    c, s = math.cos(yaw), math.sin(yaw)
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
def _float32(frame):
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
def _tool_in(frame, after, cos, sin):
    """Rotation, row by row, and place of the tool in an object's frame, single precision."""
    dx, dy, dz = after[0] - frame[9], after[1] - frame[10], after[3] - frame[11]
    return _float32(
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


@bare
def _apart(there, sphere, flat, lattice):
    """Distance of a sphere of the tool from the surface, negative where it may be within the object."""
    px, py, pz = sphere[0], sphere[1], sphere[2]
    found = value(
        there[0] * px + there[1] * py + there[2] * pz + there[9],
        there[3] * px + there[4] * py + there[5] * pz + there[10],
        there[6] * px + there[7] * py + there[8] * pz + there[11],
        flat,
        lattice,
    )
    return found - sphere[3]


@bare
def _met(frame, after, tool, flat, lattice):
    """What of the tool an object meets: sideways, and from above or below.

    Spheres about parts of the tool, and about groups of points in them, leave out what is too far to be deeper.
    Depth sideways, the level normal into the object, and the point of the tool in the world; the same of the steep one,
    whose normal has three parts.
    """
    points, starts, centres, part_starts, parts = tool
    cos, sin = math.cos(after[2]), math.sin(after[2])
    there = _tool_in(frame, after, cos, sin)
    count = len(points) // 3
    most, in_x, in_y, at_x, at_y, at_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    steep, to_x, to_y, to_z, on_x, on_y, on_z = -_GRAZE_M, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for part in range(len(parts)):
        if _apart(there, parts[part], flat, lattice) > -min(most, steep):
            continue
        for group in range(part_starts[part], part_starts[part + 1]):
            if _apart(there, centres[group], flat, lattice) > -min(most, steep):
                continue
            first, last, deep = starts[group], starts[group + 1], np.float32(min(most, steep))
            if not _deeper(first, last, there, deep, points, flat, lattice) > 0:
                continue
            for k in range(first, last):
                px, py, pz = points[k], points[count + k], points[2 * count + k]
                x = there[0] * px + there[1] * py + there[2] * pz + there[9]
                y = there[3] * px + there[4] * py + there[5] * pz + there[10]
                z = there[6] * px + there[7] * py + there[8] * pz + there[11]
                depth = -value(x, y, z, flat, lattice)
                if not depth > min(most, steep):
                    continue
                _, gx, gy, gz = value_and_gradient(x, y, z, flat, lattice)
                size = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1e-9)
                out_x = (frame[0] * gx + frame[1] * gy + frame[2] * gz) / size
                out_y = (frame[3] * gx + frame[4] * gy + frame[5] * gz) / size
                sideways = math.sqrt(out_x * out_x + out_y * out_y)
                if sideways > _LEVEL and depth > most:
                    most, in_x, in_y = float(depth), -out_x / sideways, -out_y / sideways
                    at_x, at_y = after[0] + cos * px - sin * py, after[1] + sin * px + cos * py
                    at_z = after[3] + pz
                elif not sideways > _LEVEL and depth > steep:
                    steep, to_x, to_y = float(depth), -out_x, -out_y
                    to_z = -(frame[6] * gx + frame[7] * gy + frame[8] * gz) / size
                    on_x, on_y = after[0] + cos * px - sin * py, after[1] + sin * px + cos * py
                    on_z = after[3] + pz
    return (most, in_x, in_y, at_x, at_y, at_z), (steep, to_x, to_y, to_z, on_x, on_y, on_z)


@bare
def _lever(x, y, yaw, rest, edge, steep, friction, way_x, way_y, rests):
    """What a steep contact does about an edge.

    Metres that it goes inward for each radian of tilt, lever of its force with friction over the weight's, metres that
    the tool goes outward, and the way over the edge.
    """
    centre, point, normal = rests[2], rests[4], rests[5]
    c, s = math.cos(yaw), math.sin(yaw)
    out_x = c * normal[rest, edge, 0] - s * normal[rest, edge, 1]
    out_y = s * normal[rest, edge, 0] + c * normal[rest, edge, 1]
    off = (point[rest, edge, 0] - centre[rest, 0]) * normal[rest, edge, 0]
    off = max(off + (point[rest, edge, 1] - centre[rest, 1]) * normal[rest, edge, 1], _OFF_M)
    corner_x = x + c * point[rest, edge, 0] - s * point[rest, edge, 1]
    corner_y = y + s * point[rest, edge, 0] + c * point[rest, edge, 1]
    beyond = (steep[4] - corner_x) * out_x + (steep[5] - corner_y) * out_y
    drag = out_x * way_x + out_y * way_y
    lifts = steep[6] * (out_x * steep[1] + out_y * steep[2]) - beyond * steep[3]
    rubs = friction * drag / max(math.sqrt(way_x * way_x + way_y * way_y), 1e-12)
    return lifts, (lifts + steep[6] * rubs) / off, drag, out_x, out_y


@bare
def _levered(x, y, yaw, rest, most, steep, friction, way_x, way_y, rests):
    """Edge about which a steep contact turns an object at rest (-1: none), the tilt, and the way over it."""
    chosen, tilt, way_out_x, way_out_y, best = -1, 0.0, 0.0, 0.0, _SHARE
    if not (steep[0] > most or (steep[0] > -_GRAZE_M and not most > 0.0)):
        return chosen, tilt, way_out_x, way_out_y
    tip = rests[6]
    high = max(steep[6], _LEAST_M)
    for edge in range(tip.shape[1]):
        if not tip[rest, edge] < math.inf:
            continue
        lifts, arm, drag, out_x, out_y = _lever(x, y, yaw, rest, edge, steep, friction, way_x, way_y, rests)
        lifted = lifts > _LEAST_M and steep[0] > most
        dragged = not lifts > _LEAST_M and steep[0] > -_GRAZE_M and not most > 0.0 and steep[3] < 0 and drag > 0
        if (lifted or dragged) and arm > best:
            chosen, best, way_out_x, way_out_y = edge, arm, out_x, out_y
            tilt = max(steep[0], 0.0) / lifts if lifted else drag / high
    return chosen, tilt, way_out_x, way_out_y


@bare
def _ahead(yaw, rest, in_x, in_y, rests):
    """Edge ahead of a push from below the centre of mass, how far it is off, and the cosine to its normal."""
    centre, point, normal, tip = rests[2], rests[4], rests[5], rests[6]
    c, s = math.cos(yaw), math.sin(yaw)
    way_x, way_y = c * in_x + s * in_y, c * in_y - s * in_x
    chosen, least, cosine = -1, math.inf, 0.0
    for edge in range(tip.shape[1]):
        rate = normal[rest, edge, 0] * way_x + normal[rest, edge, 1] * way_y
        if not (tip[rest, edge] < math.inf and rate > 1e-3):
            continue
        off = (point[rest, edge, 0] - centre[rest, 0]) * normal[rest, edge, 0]
        off += (point[rest, edge, 1] - centre[rest, 1]) * normal[rest, edge, 1]
        if off / rate < least:
            chosen, least, cosine = edge, off / rate, rate
    return chosen, least, cosine


@bare
def _leant(x, y, yaw, rest, edge, tilt, before, after, friction, tool, rests, flat, lattice):
    """Edge and tilt of an object that leans on the tool where it is now."""
    way_x, way_y = after[0] - before[0], after[1] - before[1]
    touched = False
    for turn in range(_TILTS):
        frame = _placed(x, y, yaw, rest, edge, tilt, rests)
        level, steep = _met(frame, after, tool, flat, lattice)
        depth = level[0]
        inside = depth > 0.0 or steep[0] > 0.0
        lifts, arm, drag, out_x, out_y = _lever(x, y, yaw, rest, edge, steep, friction, way_x, way_y, rests)
        dragged = not lifts > _LEAST_M and steep[0] > -_GRAZE_M and not depth > 0.0 and steep[3] < 0
        dragged = turn == 0 and dragged and drag > 0 and arm > _SHARE
        if not (inside or dragged):
            break
        touched = True
        along = level[1] * out_x + level[2] * out_y
        if dragged:
            tilt += drag / max(steep[6], _LEAST_M)
        elif lifts > _LEAST_M and steep[0] > depth:
            tilt += steep[0] / lifts
        elif along > _ACROSS:
            tilt += depth / max(level[5] * along, _LEAST_M)
    if touched:
        return edge, tilt
    low, high = 0.0, tilt
    for turn in range(_HALVES):
        middle = low if turn == 0 else 0.5 * (low + high)
        frame = _placed(x, y, yaw, rest, edge, middle, rests)
        level, steep = _met(frame, after, tool, flat, lattice)
        if level[0] > 0.0 or steep[0] > 0.0:
            low = middle
        else:
            high = middle
    if high <= 0.0:
        return -1, 0.0
    return edge, high


@bare
def _fallen(rest, edge, tilt, limit, rests):
    """Tilt of what falls from a limit on, a motion later."""
    centre, point, normal, tip = rests[2], rests[4], rests[5], rests[6]
    off = (point[rest, edge, 0] - centre[rest, 0]) * normal[rest, edge, 0]
    off = max(off + (point[rest, edge, 1] - centre[rest, 1]) * normal[rest, edge, 1], _OFF_M)
    rate = math.sqrt(_SWINGS * max(math.sin(tip[rest, edge]), _LEAST_M) / off)
    into, turn = tilt - limit, rate * _INSTANT_S
    begun = _RATE / rate
    return limit + into * math.cosh(turn) + math.sqrt(into * into + begun * begun) * math.sinh(turn)


@bare
def _stepped(state, before, after, tool, rests, numbers, scales, body, noise, flat, lattice):
    x, y, yaw, rest, edge, tilt = state
    if edge < 0 and (after[0] - x) ** 2 + (after[1] - y) ** 2 >= numbers[0] * numbers[0]:
        return state
    normal, tip = rests[5], rests[6]
    unit_x, unit_y, size, firm = 0.0, 0.0, 0.0, math.exp(scales[17] * noise[2])
    if edge >= 0:
        c, s = math.cos(yaw), math.sin(yaw)
        unit_x = c * normal[rest, edge, 0] - s * normal[rest, edge, 1]
        unit_y = s * normal[rest, edge, 0] + c * normal[rest, edge, 1]
        if tilt >= tip[rest, edge] * firm:
            tilt = _fallen(rest, edge, tilt, tip[rest, edge] * firm, rests)
        else:
            edge, tilt = _leant(x, y, yaw, rest, edge, tilt, before, after, body[4], tool, rests, flat, lattice)
    if edge < 0:
        frame = _placed(x, y, yaw, rest, -1, 0.0, rests)
        (depth, in_x, in_y, at_x, at_y, at_z), steep = _met(frame, after, tool, flat, lattice)
        if not (depth > 0.0 or steep[0] > -_GRAZE_M):
            return x, y, yaw, rest, -1, 0.0
        way_x, way_y = after[0] - before[0], after[1] - before[1]
        edge, tilt, unit_x, unit_y = _levered(x, y, yaw, rest, depth, steep, body[4], way_x, way_y, rests)
        if edge < 0 and not depth > 0.0:
            return x, y, yaw, rest, -1, 0.0
        about, off, rate = _ahead(yaw, rest, in_x, in_y, rests)
        if edge >= 0:
            pass
        elif about >= 0 and rate > _ACROSS and at_z > off * (1.0 / body[4] + body[4]):
            unit_x, unit_y = in_x, in_y
            tilt = depth / max(at_z * rate, _LEAST_M)
            edge, tilt = _leant(x, y, yaw, rest, about, tilt, before, after, body[4], tool, rests, flat, lattice)
            if edge < 0:
                return x, y, yaw, rest, -1, 0.0
        else:
            first = (x, y, yaw)
            way = (after[0] - before[0], after[1] - before[1], after[2] - before[2])
            length = max(math.sqrt(way[0] * way[0] + way[1] * way[1]), 1e-12)
            c, s = math.cos(yaw), math.sin(yaw)
            centre, spread = rests[2], rests[3]
            ahead = after[3] * body[2]
            centre_x = centre[rest, 0] + body[0] + ahead * (c * way[0] + s * way[1]) / length
            centre_y = centre[rest, 1] + body[1] + ahead * (c * way[1] - s * way[0]) / length
            sliding = (centre_x, centre_y, body[3] * spread[rest], body[4], 0.0, 0.0, 0.0, 0.0, 0.0)
            unit_x, unit_y = in_x, in_y
            for turn in range(2):
                if turn > 0:
                    frame = _placed(x, y, yaw, rest, -1, 0.0, rests)
                    (depth, in_x, in_y, at_x, at_y, _), _ = _met(frame, after, tool, flat, lattice)
                    if not depth > 0.0:
                        break
                c, s = math.cos(yaw), math.sin(yaw)
                x, y, yaw = settled(
                    x,
                    y,
                    yaw,
                    first,
                    (after[0], after[1]),
                    way,
                    at_x - after[0],
                    at_y - after[1],
                    -(c * in_x + s * in_y),
                    -(c * in_y - s * in_x),
                    min(depth, _MOST_M),
                    0.0,
                    sliding,
                )
            dx, dy, turned = x - first[0], y - first[1], yaw - first[2]
            length = math.sqrt(dx * dx + dy * dy)
            size = length + scales[12] * abs(turned)
            if length > 1e-9:
                unit_x, unit_y = dx / length, dy / length
    if edge >= 0:
        if tilt < tip[rest, edge] * firm + _LANDS_RAD:
            size = math.sqrt((after[0] - before[0]) ** 2 + (after[1] - before[1]) ** 2)
        else:
            following, change = rests[7], rests[8]
            c, s = math.cos(yaw), math.sin(yaw)
            x += c * change[rest, edge, 0] - s * change[rest, edge, 1]
            y += s * change[rest, edge, 0] + c * change[rest, edge, 1]
            yaw += change[rest, edge, 2]
            rest, edge, tilt = following[rest, edge], -1, 0.0
            size = scales[16]
    along, across = noise[0] * size * scales[9], noise[1] * size * scales[10]
    x, y = x + along * unit_x - across * unit_y, y + along * unit_y + across * unit_x
    return x, y, yaw + noise[2] * size * scales[11], rest, edge, tilt


@bare
def _one(n, particles, done, sensed, tool, rests, numbers, scales, logs_of, flat, lattice):
    """One particle, from its own segment on; what cannot reach its least log-likelihood any more is given up."""
    first, least, poses, logs, physics, noises = particles
    path, pushes, ends, action, point_ends = done
    points, weight, row = sensed
    nodes = logs_of.shape[1]
    priced, inverse = logs_of.reshape(-1), np.float32(1.0 / scales[15])
    half, top = np.float32(0.5 * (nodes - 1)), np.float32(nodes - 1.01)
    begin, total = first[n], 0.0
    state = (
        poses[n, begin, 0],
        poses[n, begin, 1],
        poses[n, begin, 2],
        np.int64(poses[n, begin, 3]),
        np.int64(poses[n, begin, 4]),
        poses[n, begin, 5],
    )
    ahead = scales[4] + scales[5] * physics[n, 4]
    centre_x, centre_y = scales[6] * physics[n, 2], scales[6] * physics[n, 3]
    own, together = math.sqrt(1.0 - scales[14]), math.sqrt(scales[14])
    for segment in range(begin, len(ends)):
        shared, log = action[segment], 0.0
        friction = scales[0] * math.exp(scales[1] * physics[n, 0] + scales[7] * noises[n, segment, 0])
        lever = scales[2] * math.exp(scales[3] * physics[n, 1] + scales[8] * noises[n, segment, 1])
        body = (centre_x, centre_y, ahead, lever, friction)
        size = numbers[1] * math.exp(0.5 * scales[13] * noises[n, shared, 8] * noises[n, shared, 8])
        noise = (
            size * (own * noises[n, segment, 2] + together * noises[n, shared, 5]),
            size * (own * noises[n, segment, 3] + together * noises[n, shared, 6]),
            size * (own * noises[n, segment, 4] + together * noises[n, shared, 7]),
        )
        for instant in range(ends[segment - 1] if segment > 0 else 0, ends[segment]):
            if pushes[instant]:
                before = (path[instant, 0, 0], path[instant, 0, 1], path[instant, 0, 2], path[instant, 0, 3])
                after = (path[instant, 1, 0], path[instant, 1, 1], path[instant, 1, 2], path[instant, 1, 3])
                state = _stepped(state, before, after, tool, rests, numbers, scales, body, noise, flat, lattice)
            low, high = point_ends[instant - 1] if instant > 0 else 0, point_ends[instant]
            if low < high:
                frame = _float32(_placed(state[0], state[1], state[2], state[3], state[4], state[5], rests))
                log += _readings(low, high, frame, points, weight, row, priced, inverse, half, top, flat, lattice)
            # no reading's log-likelihood is above 0: what is too little now stays so
            if total + log < least[n] - _SLACK:
                logs[n, segment] = -math.inf
                return
        poses[n, segment + 1, 0], poses[n, segment + 1, 1], poses[n, segment + 1, 2] = state[0], state[1], state[2]
        poses[n, segment + 1, 3], poses[n, segment + 1, 4] = state[3], state[4]
        poses[n, segment + 1, 5] = state[5]
        logs[n, segment] = log
        total += log


def _replay_in_space(particles, done, sensed, tool, rests, numbers, scales, priced, grid, part):
    lattice = lattice_of(grid[1], grid[2])
    for n in indices(part, len(particles[0])):
        _one(np.int64(n), particles, done, sensed, tool, rests, numbers, scales, priced, grid[0], lattice)


replay = Kernel(_replay_in_space)
