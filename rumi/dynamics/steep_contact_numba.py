"""Building blocks of compiled toppling: steep contacts of a tool; `steep_contact.py` has the definition."""

import math

from rumi.dynamics.sliding_numba import twist
from rumi.dynamics.steep_contact import EDGE, LEAST_M, OFF_M, SHARE, STICKS
from rumi.dynamics.tool_contact import GRAZE_M, HOOKS
from sdf.compiled import bare


@bare
def lever(x, y, yaw, rest, edge, steep, friction, way_x, way_y, rests):
    """What a steep contact does about an edge.

    Metres that it goes inward for each radian of tilt, lever of its force with friction over the weight's, metres that
    the tool goes outward, and the way over the edge.
    """
    centre, point, normal = rests[2], rests[4], rests[5]
    c, s = math.cos(yaw), math.sin(yaw)
    out_x = c * normal[rest, edge, 0] - s * normal[rest, edge, 1]
    out_y = s * normal[rest, edge, 0] + c * normal[rest, edge, 1]
    off = (point[rest, edge, 0] - centre[rest, 0]) * normal[rest, edge, 0]
    off = max(off + (point[rest, edge, 1] - centre[rest, 1]) * normal[rest, edge, 1], OFF_M)
    corner_x = x + c * point[rest, edge, 0] - s * point[rest, edge, 1]
    corner_y = y + s * point[rest, edge, 0] + c * point[rest, edge, 1]
    beyond = (steep[4] - corner_x) * out_x + (steep[5] - corner_y) * out_y
    drag = out_x * way_x + out_y * way_y
    lifts = steep[6] * (out_x * steep[1] + out_y * steep[2]) - beyond * steep[3]
    if steep[3] > 0.0:
        # friction holds a force that lifts upright, as far as it goes
        level = math.sqrt(steep[1] * steep[1] + steep[2] * steep[2])
        slope = max(level / steep[3] - friction, 0.0) / max(level, 1e-9)
        arm = steep[6] * slope * (out_x * steep[1] + out_y * steep[2]) - beyond
    else:
        arm = lifts + steep[6] * friction * drag / max(math.sqrt(way_x * way_x + way_y * way_y), 1e-12)
    return lifts, arm / off, drag, out_x, out_y


@bare
def steeper(steep, depth):
    """Whether a steep contact counts, and not the level one: what lifts takes along what is beside it."""
    return steep[0] > (HOOKS * depth if steep[3] > 0.0 else depth)


@bare
def levered(x, y, yaw, rest, most, steep, friction, way_x, way_y, rests):
    """Edge about which a steep contact turns an object at rest (-1: none), and how.

    The tilt by which the tool drags it over, metres that the contact goes inward for each radian of tilt, 0 where it
    drags, and the way over the edge.
    """
    chosen, tilt, inward, way_out_x, way_out_y, best = -1, 0.0, 0.0, 0.0, 0.0, SHARE
    counts = steeper(steep, most)
    if not (counts or (steep[0] > -GRAZE_M and not most > 0.0)):
        return chosen, tilt, inward, way_out_x, way_out_y
    tip = rests[6]
    high = max(steep[6], LEAST_M)
    for edge in range(tip.shape[1]):
        if not tip[rest, edge] < math.inf:
            continue
        lifts, arm, drag, out_x, out_y = lever(x, y, yaw, rest, edge, steep, friction, way_x, way_y, rests)
        lifting = lifts > LEAST_M and counts
        dragged = not lifts > LEAST_M and steep[0] > -GRAZE_M and not most > 0.0 and steep[3] < 0 and drag > 0
        if (lifting or dragged) and arm > best:
            chosen, best, way_out_x, way_out_y = edge, arm, out_x, out_y
            tilt, inward = (0.0, lifts) if lifting else (drag / high, 0.0)
    return chosen, tilt, inward, way_out_x, way_out_y


@bare
def lifted(x, y, yaw, rest, edge, tilt, steep, lifts, before, after, body, rests):
    """Place and tilt of an object that a steep contact turns about its edge."""
    depth, in_x, in_y, in_z, at_x, at_y, high = steep
    centre, point, normal, tip = rests[2], rests[4], rests[5], rests[6]
    c, s = math.cos(yaw), math.sin(yaw)
    out_x = c * normal[rest, edge, 0] - s * normal[rest, edge, 1]
    out_y = s * normal[rest, edge, 0] + c * normal[rest, edge, 1]
    # of the contact about the edge
    arm_x = at_x - x - c * point[rest, edge, 0] + s * point[rest, edge, 1]
    arm_y = at_y - y - s * point[rest, edge, 0] - c * point[rest, edge, 1]
    within = -(arm_x * out_x + arm_y * out_y)
    if not abs(within) > LEAST_M:
        return x, y, yaw, tilt + depth / lifts
    # where the contact goes if it sticks, and what of that the tilt leaves to the edge
    c, s = math.cos(before[2] - after[2]), math.sin(before[2] - after[2])
    off_x, off_y = at_x - after[0], at_y - after[1]
    way_x, way_y = at_x - before[0] - c * off_x + s * off_y, at_y - before[1] - s * off_x - c * off_y
    way_z = after[3] - before[3]
    inward = depth - (way_x * in_x + way_y * in_y + way_z * in_z)
    way_x, way_y, way_z = way_x + inward * in_x, way_y + inward * in_y, way_z + inward * in_z
    turn = way_z / within
    way_x, way_y = way_x - high * turn * out_x, way_y - high * turn * out_y
    # the tool carries a share of the weight, the edge the rest, which rubs against its way
    off = (point[rest, edge, 0] - centre[rest, 0]) * normal[rest, edge, 0]
    off = max(off + (point[rest, edge, 1] - centre[rest, 1]) * normal[rest, edge, 1], OFF_M)
    off *= math.sin(max(tip[rest, edge] - tilt, 0.0)) / max(math.sin(tip[rest, edge]), LEAST_M)
    friction = body[4]
    rub = friction if way_x * out_x + way_y * out_y > 0.0 else -friction
    balance = within - rub * high
    carried = (off - rub * high) / balance if abs(balance) > 1e-9 else math.inf
    pull, into = rub * (1.0 - carried), out_x * in_x + out_y * in_y
    pressed, rubbed = pull * into + carried * in_z, abs(pull * in_z - carried * into)
    if not (carried < 1.0 and rubbed <= friction * pressed):
        return x, y, yaw, tilt + depth / lifts
    far = max(math.sqrt(way_x * way_x + way_y * way_y), 1e-12)
    own = EDGE * body[3] * rests[3][rest]
    fx, fy, spin = twist(arm_x, arm_y, way_x / far, way_y / far, way_x, way_y, own, STICKS)
    corner_x, corner_y = at_x - arm_x, at_y - arm_y
    c, s = math.cos(0.5 * spin), math.sin(0.5 * spin)
    mid_x, mid_y = corner_x + c * fx - s * fy, corner_y + s * fx + c * fy
    c, s = math.cos(spin), math.sin(spin)
    back_x, back_y = x - corner_x, y - corner_y
    return mid_x + c * back_x - s * back_y, mid_y + s * back_x + c * back_y, yaw + spin, tilt + turn
