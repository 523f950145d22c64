"""Building blocks of compiled toppling: one small motion of a tool; `toppling.py` has the definition."""

import math

from rumi.dynamics.sliding_numba import settled, turned, twist
from rumi.dynamics.steep_contact import LEAST_M, OFF_M, RISES, SHARE
from rumi.dynamics.tool_contact import GRAZE_M
from rumi.dynamics.tool_contact_numba import bounded, met, met_within, placed, placed_at
from rumi.dynamics.toppling import ACROSS, HALVES, INSTANT_S, LANDS_RAD, MOST_M, PASSES, RATE, STICKS, SWINGS, TILTS
from sdf.compiled import bare, inlined


@bare
def _way(before, after):
    """Way of the tool's frame."""
    return after[0] - before[0], after[1] - before[1], after[3] - before[3]


@bare
def _far(way):
    """How far that is."""
    return math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])


@bare
def _lever(x, y, turn, rest, edge, steep, depth, friction, way, rests):
    """What a steep contact does about an edge.

    Metres that it goes inward for each radian of tilt, lever of its force with friction over the weight's, metres that
    the tool goes outward, the way over the edge; whether the tool that rises takes the contact along, and radians that
    it tilts and metres that the edge slides outward then. `turn` is the cosine and sine of the object's yaw.
    """
    centre, point, normal = rests[2], rests[4], rests[5]
    c, s = turn
    out_x = c * normal[rest, edge, 0] - s * normal[rest, edge, 1]
    out_y = s * normal[rest, edge, 0] + c * normal[rest, edge, 1]
    off = (point[rest, edge, 0] - centre[rest, 0]) * normal[rest, edge, 0]
    off = max(off + (point[rest, edge, 1] - centre[rest, 1]) * normal[rest, edge, 1], OFF_M)
    corner_x = x + c * point[rest, edge, 0] - s * point[rest, edge, 1]
    corner_y = y + s * point[rest, edge, 0] + c * point[rest, edge, 1]
    beyond = (steep[4] - corner_x) * out_x + (steep[5] - corner_y) * out_y
    drag = out_x * way[0] + out_y * way[1]
    along, rise, high = out_x * steep[1] + out_y * steep[2], steep[3], steep[6]
    lifts = high * along - beyond * rise
    into = steep[1] * way[0] + steep[2] * way[1] + rise * way[2]
    if rise > 0 and lifts > LEAST_M:
        across = high * rise + beyond * along
        slips = drag * rise - way[2] * along - across * into / lifts
        rubs = across if slips > 0 else -across if slips < 0 else 0.0
    else:
        rubs = high * drag / max(math.sqrt(way[0] * way[0] + way[1] * way[1]), 1e-12)
    arm, carries, carried, slides = (lifts + friction * rubs) / off, False, 0.0, 0.0
    up = (off + friction * high) / max(friction * high - beyond, LEAST_M)
    if steep[0] > depth and rise > 0 and beyond < 0 and into > 0 and up < 1.0 and way[2] > RISES * _far(way):
        back = friction * (1.0 - up)
        presses = up * rise - back * along
        carries = presses * math.sqrt(1.0 + friction * friction) > math.sqrt(up * up + back * back)
        carries = carries and -beyond * drag < high * way[2]
        if carries:
            share = min(max(steep[0], 0.0) / max(into, 1e-12), 1.0)
            arm, carried = 1.0 / max(presses, 1e-6), share * way[2] / max(-beyond, LEAST_M)
            slides = share * drag - high * carried
    return lifts, arm, drag, out_x, out_y, carries, carried, slides


@bare
def _levered(x, y, yaw, rest, most, steep, friction, way, rests):
    """Edge about which a steep contact turns an object at rest (-1: none), tilt, way over it, how far it slides."""
    chosen, tilt, way_out_x, way_out_y, slides, best = -1, 0.0, 0.0, 0.0, 0.0, SHARE
    if not (steep[0] > most or (steep[0] > -GRAZE_M and not most > 0.0)):
        return chosen, tilt, way_out_x, way_out_y, slides
    tip, turn = rests[6], (math.cos(yaw), math.sin(yaw))
    high = max(steep[6], LEAST_M)
    for edge in range(tip.shape[1]):
        if not tip[rest, edge] < math.inf:
            continue
        done = _lever(x, y, turn, rest, edge, steep, most, friction, way, rests)
        lifts, arm, drag, out_x, out_y, carries, carried, slid = done
        lifted = (lifts > LEAST_M or carries) and steep[0] > most
        dragged = not lifts > LEAST_M and steep[0] > -GRAZE_M and not most > 0.0 and steep[3] < 0 and drag > 0
        if (lifted or dragged) and arm > best:
            chosen, best, way_out_x, way_out_y = edge, arm, out_x, out_y
            tilt, slides = max(steep[0], 0.0) / lifts if lifted else drag / high, 0.0
            if carries:
                tilt, slides = carried, slid
    return chosen, tilt, way_out_x, way_out_y, slides


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
def _presses(lifts, steep, depth, soft):
    """Whether the tool stands in the way of a tilt from above."""
    return lifts < -LEAST_M and steep[0] > soft and steep[0] > depth


@bare
def _held_down(x, y, yaw, rest, edge, tilt, before, after, friction, soft, scene):
    """Edge and tilt as far as the tool above lets an object rise."""
    tool, box, rests, flat, lattice = scene
    turn = (math.cos(yaw), math.sin(yaw))
    frame = placed_at(x, y, turn[0], turn[1], rest, edge, tilt, rests)
    level, steep = met(frame, after, tool, box, flat, lattice)
    lifts = _lever(x, y, turn, rest, edge, steep, level[0], friction, _way(before, after), rests)[0]
    if _presses(lifts, steep, level[0], soft):
        tilt += (steep[0] - soft) / lifts
    return (edge, tilt) if tilt > 0.0 else (-1, 0.0)


@bare
def _leant(x, y, yaw, rest, edge, tilt, before, after, friction, soft, scene):
    """Pose, edge and tilt of an object that leans on the tool where it is now."""
    tool, box, rests, flat, lattice = scene
    way, touched, c, s = _way(before, after), False, math.cos(yaw), math.sin(yaw)
    for turn in range(TILTS):
        frame = placed_at(x, y, c, s, rest, edge, tilt, rests)
        level, steep = met(frame, after, tool, box, flat, lattice)
        depth = level[0]
        inside = depth > 0.0 or steep[0] > 0.0
        done = _lever(x, y, (c, s), rest, edge, steep, depth, friction, way, rests)
        lifts, arm, drag, out_x, out_y, carries, carried, slides = done
        dragged = not lifts > LEAST_M and steep[0] > -GRAZE_M and not depth > 0.0 and steep[3] < 0
        dragged = turn == 0 and dragged and drag > 0 and arm > SHARE
        if not (inside or dragged):
            break
        touched = True
        along = level[1] * out_x + level[2] * out_y
        if dragged:
            tilt += drag / max(steep[6], LEAST_M)
        elif carries and turn == 0:
            x, y, tilt = x + slides * out_x, y + slides * out_y, tilt + carried
        elif _presses(lifts, steep, depth, soft):
            tilt += (steep[0] - soft) / lifts
        elif lifts > LEAST_M and steep[0] > depth:
            tilt += steep[0] / lifts
        elif along > ACROSS:
            tilt += depth / max(level[5] * along, LEAST_M)
    if touched:
        return (x, y, edge, tilt) if tilt > 0.0 else (x, y, -1, 0.0)
    low, high = 0.0, tilt
    for turn in range(HALVES):
        middle = low if turn == 0 else 0.5 * (low + high)
        frame = placed_at(x, y, c, s, rest, edge, middle, rests)
        bounded(frame, after, tool, box)
        level, steep = met_within(frame, after, tool, True, flat, lattice)
        if level[0] > 0.0 or steep[0] > 0.0:
            low = middle
        else:
            high = middle
    if high <= 0.0:
        return x, y, -1, 0.0
    return x, y, edge, high


@bare
def _fallen(rest, edge, tilt, limit, rests):
    """Tilt of what falls from a limit on, a motion later."""
    centre, point, normal, tip = rests[2], rests[4], rests[5], rests[6]
    off = (point[rest, edge, 0] - centre[rest, 0]) * normal[rest, edge, 0]
    off = max(off + (point[rest, edge, 1] - centre[rest, 1]) * normal[rest, edge, 1], OFF_M)
    rate = math.sqrt(SWINGS * max(math.sin(tip[rest, edge]), LEAST_M) / off)
    into, turn = tilt - limit, rate * INSTANT_S
    begun = RATE / rate
    return limit + into * math.cosh(turn) + math.sqrt(into * into + begun * begun) * math.sinh(turn)


@bare
def _slid(x, y, yaw, rest, level, before, after, body, scene):
    """Pose of what a level contact pushes along the floor."""
    tool, box, rests, flat, lattice = scene
    depth, in_x, in_y, at_x, at_y, _ = level
    first = (x, y, yaw)
    way = (after[0] - before[0], after[1] - before[1], after[2] - before[2])
    length = max(math.sqrt(way[0] * way[0] + way[1] * way[1]), 1e-12)
    c, s = math.cos(yaw), math.sin(yaw)
    centre, spread = rests[2], rests[3]
    ahead = after[3] * body[2]
    centre_x = centre[rest, 0] + body[0] + ahead * (c * way[0] + s * way[1]) / length
    centre_y = centre[rest, 1] + body[1] + ahead * (c * way[1] - s * way[0]) / length
    sliding = (centre_x, centre_y, body[3] * spread[rest], body[4], 0.0, 0.0, 0.0, 0.0, 0.0)
    for turn in range(PASSES):
        if turn > 0:
            frame = placed_at(x, y, c, s, rest, -1, 0.0, rests)
            (depth, in_x, in_y, at_x, at_y, _), _ = met(frame, after, tool, box, flat, lattice)
            if not depth > 0.0:
                break
        x, y, yaw, c, s = settled(
            x,
            y,
            yaw,
            c,
            s,
            first,
            (after[0], after[1]),
            way,
            turned(-way[2]),
            at_x - after[0],
            at_y - after[1],
            -(c * in_x + s * in_y),
            -(c * in_y - s * in_x),
            min(depth, MOST_M),
            0.0,
            sliding,
        )
    return x, y, yaw


@bare
def _dragged(x, y, yaw, rest, steep, before, after, body, rests):
    """Pose of what the tool drags along by its top, a share of the way."""
    at_x, at_y, centre = steep[4], steep[5], rests[2]
    c, s = math.cos(before[2] - after[2]), math.sin(before[2] - after[2])
    off_x, off_y = at_x - after[0], at_y - after[1]
    wx, wy = body[6] * (at_x - before[0] - c * off_x + s * off_y), body[6] * (at_y - before[1] - s * off_x - c * off_y)
    centre_x, centre_y = centre[rest, 0] + body[0], centre[rest, 1] + body[1]
    ahead, way_x, way_y = after[3] * body[2], after[0] - before[0], after[1] - before[1]
    length = max(math.sqrt(way_x * way_x + way_y * way_y), 1e-12)
    c, s = math.cos(yaw), math.sin(yaw)
    centre_x += ahead * (c * way_x + s * way_y) / length
    centre_y += ahead * (c * way_y - s * way_x) / length
    arm_x, arm_y = c * centre_x - s * centre_y, s * centre_x + c * centre_y
    far = max(math.sqrt(wx * wx + wy * wy), 1e-12)
    lever = body[3] * rests[3][rest]
    fx, fy, turn = twist(at_x - x - arm_x, at_y - y - arm_y, wx / far, wy / far, wx, wy, lever, STICKS)
    c, s = math.cos(0.5 * turn), math.sin(0.5 * turn)
    x, y, yaw = x + arm_x + c * fx - s * fy, y + arm_y + s * fx + c * fy, yaw + turn
    c, s = math.cos(yaw), math.sin(yaw)
    return x - (c * centre_x - s * centre_y), y - (s * centre_x + c * centre_y), yaw


@bare
def _gone(dx, dy, turned, m_per_rad):
    """Size of a motion along the floor, and its direction; 0 where it went nowhere."""
    length = math.sqrt(dx * dx + dy * dy)
    size = length + m_per_rad * abs(turned)
    if length > 1e-9:
        return size, dx / length, dy / length
    return size, 0.0, 0.0


@inlined
def pushed(state, frame, before, after, body, firm, sizes, scene):
    """Object after one small motion of the tool, the size of it that its noise goes by, and its direction.

    `state` is (x, y, yaw, resting pose, edge, tilt), and `frame` where that has it, for which the tool was `bounded` if
    it leans on nothing; `body` centre of friction, pressure ahead, lever, friction, how
    far the tool goes into it from above, and the share of its way that it drags the top along; `firm` the tilt at which
    it falls over, as a share; `sizes` what a radian, a fall and a tilted instant's way count as; `scene` tool, box of
    its contacts, resting poses and table of distances.
    """
    x, y, yaw, rest, edge, tilt = state
    tool, box, rests, flat, lattice = scene
    normal, tip = rests[5], rests[6]
    unit_x, unit_y, size = 0.0, 0.0, 0.0
    if edge >= 0:
        c, s = math.cos(yaw), math.sin(yaw)
        unit_x = c * normal[rest, edge, 0] - s * normal[rest, edge, 1]
        unit_y = s * normal[rest, edge, 0] + c * normal[rest, edge, 1]
        if tilt >= tip[rest, edge] * firm:
            tilt = _fallen(rest, edge, tilt, tip[rest, edge] * firm, rests)
        else:
            x, y, edge, tilt = _leant(x, y, yaw, rest, edge, tilt, before, after, body[4], body[5], scene)
    if edge < 0:
        if state[4] >= 0:
            frame = placed(x, y, yaw, rest, -1, 0.0, rests)
            bounded(frame, after, tool, box)
        level, steep = met_within(frame, after, tool, False, flat, lattice)
        if not (level[0] > 0.0 or steep[0] > -GRAZE_M):
            return (x, y, yaw, rest, -1, 0.0), 0.0, 0.0, 0.0
        edge, tilt, unit_x, unit_y, slides = _levered(
            x, y, yaw, rest, level[0], steep, body[4], _way(before, after), rests
        )
        if edge < 0 and not level[0] > 0.0:
            from_x, from_y, from_yaw = state[0], state[1], state[2]
            if body[6] > 0.0 and steep[3] < 0.0:
                x, y, yaw = _dragged(x, y, yaw, rest, steep, before, after, body, rests)
            size, unit_x, unit_y = _gone(x - from_x, y - from_y, yaw - from_yaw, sizes[0])
            return (x, y, yaw, rest, -1, 0.0), size, unit_x, unit_y
        about, off, rate = _ahead(yaw, rest, level[1], level[2], rests)
        if edge >= 0:
            x, y = x + slides * unit_x, y + slides * unit_y
            edge, tilt = _held_down(x, y, yaw, rest, edge, tilt, before, after, body[4], body[5], scene)
            if edge < 0:
                return (x, y, yaw, rest, -1, 0.0), 0.0, 0.0, 0.0
        elif about >= 0 and rate > ACROSS and level[5] > off * (1.0 / body[4] + body[4]):
            unit_x, unit_y = level[1], level[2]
            tilt = level[0] / max(level[5] * rate, LEAST_M)
            x, y, edge, tilt = _leant(x, y, yaw, rest, about, tilt, before, after, body[4], body[5], scene)
            if edge < 0:
                return (x, y, yaw, rest, -1, 0.0), 0.0, 0.0, 0.0
        else:
            from_x, from_y, from_yaw = state[0], state[1], state[2]
            x, y, yaw = _slid(x, y, yaw, rest, level, before, after, body, scene)
            size, unit_x, unit_y = _gone(x - from_x, y - from_y, yaw - from_yaw, sizes[0])
            size += sizes[3] * _far(_way(before, after))
            if unit_x == 0.0 and unit_y == 0.0:
                unit_x, unit_y = level[1], level[2]
    if edge >= 0:
        if tilt < tip[rest, edge] * firm + LANDS_RAD:
            dx, dy = x - state[0], y - state[1]
            size, slid_x, slid_y = _gone(dx, dy, 0.0, 0.0)
            size += sizes[2] * _far(_way(before, after))
            if slid_x != 0.0 or slid_y != 0.0:
                unit_x, unit_y = slid_x, slid_y
        else:
            following, change = rests[7], rests[8]
            c, s = math.cos(yaw), math.sin(yaw)
            x += c * change[rest, edge, 0] - s * change[rest, edge, 1]
            y += s * change[rest, edge, 0] + c * change[rest, edge, 1]
            yaw += change[rest, edge, 2]
            rest, edge, tilt = following[rest, edge], -1, 0.0
            size = sizes[1]
    return (x, y, yaw, rest, edge, tilt), size, unit_x, unit_y
