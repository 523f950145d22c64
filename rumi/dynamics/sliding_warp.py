"""Building blocks of pushing in Warp: one contact of a tool and an object; `sliding.py` has the definition.

Poses are (x, y, yaw), other pairs and triples vectors too; a turn is (cos, sin) of its angle. Warp gives what a tuple
of names is assigned to the names' own memory: what changes later is assigned one by one, which copies.
"""

from typing import Any

from rumi.dynamics.sliding import _ROOTS, _STICKS, _WEDGED
from sdf import gpu

wp = gpu.warp()


@wp.func
def turn_by(angle: Any):
    """Cosine and sine of an angle."""
    return wp.vector(wp.cos(angle), wp.sin(angle))


@wp.func
def rotated(vector: Any, turn: Any):
    """A vector, turned."""
    return type(vector)(turn[0] * vector[0] - turn[1] * vector[1], turn[1] * vector[0] + turn[0] * vector[1])


@wp.func
def rotated_back(vector: Any, turn: Any):
    """A vector, turned the other way."""
    return type(vector)(turn[0] * vector[0] + turn[1] * vector[1], turn[0] * vector[1] - turn[1] * vector[0])


@wp.func
def place_of(pose: Any):
    """X and y of a pose."""
    return wp.vector(pose[0], pose[1])


@wp.func
def _cell(place: Any, count: int):
    """Lower node of a cell along an axis of a table, and the way from there; the nearest cell's beyond the table."""
    inside = wp.clamp(place, type(place)(0.0), type(place)(count - 1))
    low = wp.min(int(inside), count - 2)
    return low, inside - type(place)(low)


@wp.func
def distance_at(point: Any, values: wp.array2d(dtype=Any), origin: Any, spacing: Any):
    """Distance to an outline where that is all the same beyond its table; see `GridOutline`."""
    place = (point - origin) / spacing
    i, a = _cell(place[0], values.shape[0])
    j, b = _cell(place[1], values.shape[1])
    return wp.lerp(wp.lerp(values[i, j], values[i, j + 1], b), wp.lerp(values[i + 1, j], values[i + 1, j + 1], b), a)


@wp.func
def gradient_at(point: Any, values: wp.array2d(dtype=Any), origin: Any, spacing: Any):
    """Gradient of an outline's distance; see `GridOutline`."""
    place = (point - origin) / spacing
    i, a = _cell(place[0], values.shape[0])
    j, b = _cell(place[1], values.shape[1])
    low, high = values[i, j + 1] - values[i, j], values[i + 1, j + 1] - values[i + 1, j]
    along = wp.lerp(values[i + 1, j] - values[i, j], values[i + 1, j + 1] - values[i, j + 1], b)
    return wp.vector(along, wp.lerp(low, high, a)) / spacing


@wp.func
def contact_twist(lever_arm: Any, inward: Any, wanted: Any, lever: Any, friction: Any):
    """Motion of the centre of friction and turn; see `sliding.contact_twist`."""
    x, y, square = lever_arm[0], lever_arm[1], lever * lever
    whole = square + x * x + y * y
    force = type(wanted)(
        ((square + x * x) * wanted[0] + x * y * wanted[1]) / whole,
        (x * y * wanted[0] + (square + y * y) * wanted[1]) / whole,
    )
    across = type(inward)(-inward[1], inward[0])
    normal, tangential = wp.dot(force, inward), wp.dot(force, across)
    if not wp.abs(tangential) <= friction * normal:
        side = type(lever)(0.0)
        if tangential != side:
            side = friction * wp.sign(tangential)
        edge = inward + side * across
        moment, turned = x * edge[1] - y * edge[0], x * inward[1] - y * inward[0]
        straight = type(lever)(1.0) + turned * turned / square
        stiffness = wp.max(type(lever)(1.0) + turned * moment / square, type(lever)(_WEDGED) * straight)
        force = (wp.dot(wanted, inward) / stiffness) * edge
    return wp.vector(force[0], force[1], (x * force[1] - y * force[0]) / square)


@wp.func
def _twist_by(edge: Any, lever_arm: Any, inward: Any, lever: Any, surface: Any):
    """Twist by the force inward + edge across."""
    x, y, half = lever_arm[0], lever_arm[1], type(lever)(0.5)
    across = type(inward)(-inward[1], inward[0])
    force = inward + edge * across
    moment = (x * force[1] - y * force[0]) / lever
    a = type(force)(surface[0] * force[0] + surface[1] * force[1], surface[1] * force[0] + surface[2] * force[1])
    b = type(force)(surface[3] * force[0] + surface[4] * force[1], surface[4] * force[0] + surface[5] * force[1])
    whole = wp.dot(a, force) + moment * moment
    velocity = whole * a + (half * moment * moment) * b
    turn = (whole + half * wp.dot(b, force)) * moment / lever
    return wp.vector(velocity[0], velocity[1], turn)


@wp.func
def _moved(twist: Any, lever_arm: Any, inward: Any):
    """The contact point's motion along the normal and across."""
    x, y = twist[0] - twist[2] * lever_arm[1], twist[1] + twist[2] * lever_arm[0]
    return x * inward[0] + y * inward[1], y * inward[0] - x * inward[1]


@wp.func
def quartic_twist(lever_arm: Any, inward: Any, wanted: Any, lever: Any, friction: Any, quartic: Any):
    """Motion of the centre of friction and turn; see `sliding.quartic_twist`."""
    none, half = type(lever)(0.0), type(lever)(0.5)
    across = type(inward)(-inward[1], inward[0])
    forward, aside = wp.dot(wanted, inward), wp.dot(wanted, across)
    first, second, mean, level, slant = quartic[0], quartic[1], quartic[2], quartic[3], quartic[4]
    size, stretch = wp.sqrt(first * first + second * second), type(lever)(1.0)
    if size > type(lever)(1e-9):
        stretch = wp.sinh(size) / size
    grown = wp.cosh(size)
    surface = wp.vector(
        grown + stretch * first, stretch * second, grown - stretch * first, mean + level, slant, mean - level
    )
    high = wp.min(friction, type(lever)(_STICKS))
    low, edge = -high, -high
    normal, tangential = _moved(_twist_by(low, lever_arm, inward, lever, surface), lever_arm, inward)
    least = aside * normal - tangential * forward
    if least > none:
        edge = high
        normal, tangential = _moved(_twist_by(high, lever_arm, inward, lever, surface), lever_arm, inward)
        most = aside * normal - tangential * forward
        if most < none:
            side = int(0)
            for _step in range(_ROOTS):
                edge = (low * most - high * least) / (most - least)
                normal, tangential = _moved(_twist_by(edge, lever_arm, inward, lever, surface), lever_arm, inward)
                gap = aside * normal - tangential * forward
                if gap > none:
                    low = edge
                    least = gap
                    if side > 0:  # the end that stays twice is drawn in
                        most *= half
                    side = 1
                else:
                    high = edge
                    most = gap
                    if side < 0:
                        least *= half
                    side = -1
                if gap == none:
                    break
    twist = _twist_by(edge, lever_arm, inward, lever, surface)
    normal, tangential = _moved(twist, lever_arm, inward)
    straight, tangential = _moved(_twist_by(none, lever_arm, inward, lever, surface), lever_arm, inward)
    twist = (forward / wp.max(normal, type(lever)(_WEDGED) * straight)) * twist
    most, size = wp.length(wanted) / type(lever)(_WEDGED), wp.length(place_of(twist))
    if size > most:
        twist = (most / size) * twist
    return twist


@wp.func
def turned_quartic(quartic: Any, turn: Any):
    """A quartic limit surface of an object that is turned: deviators turn by twice the angle."""
    double = wp.vector(turn[0] * turn[0] - turn[1] * turn[1], (turn[0] + turn[0]) * turn[1])
    first, last = rotated(wp.vector(quartic[0], quartic[1]), double), rotated(wp.vector(quartic[3], quartic[4]), double)
    return type(quartic)(first[0], first[1], quartic[2], last[0], last[1])


@wp.func
def moved_by(pose: Any, twist: Any, centre: Any):
    """Pose after a small motion of the centre of friction (world axes at half the turn) and a turn."""
    arm = rotated(centre, turn_by(pose[2]))
    middle = place_of(pose) + arm + rotated(place_of(twist), turn_by(type(twist[2])(0.5) * twist[2]))
    place = middle - rotated(arm, turn_by(twist[2]))
    return type(pose)(place[0], place[1], pose[2] + twist[2])


@wp.func
def pushed_out(
    here: Any,
    first: Any,
    before: Any,
    after: Any,
    point: Any,
    inward: Any,
    depth: Any,
    centre: Any,
    lever: Any,
    friction: Any,
    quartic: Any,
):
    """Pose after the deepest point of a tool is settled; a `quartic` of zeros is the ellipsoid.

    Args:
        here: pose now.
        first: the same before the tool's motion.
        before: (x, y, yaw) of the tool then.
        after: the same now.
        point: of the tool in the world, metres.
        inward: unit normal into the object there.
        depth: in it, metres.
        centre: of friction, object frame.
        lever: of the limit surface.
        friction: of the contact.
        quartic: of the limit surface, object frame.
    """
    turn = turn_by(here[2])
    # how far the tool's and the object's touched points have gone in this motion
    carried = place_of(before) + rotated(point - place_of(after), turn_by(before[2] - after[2]))
    own_old = place_of(first) + rotated(point - place_of(here), turn_by(first[2] - here[2]))
    slip = own_old - carried
    slip = slip - wp.dot(slip, inward) * inward
    arm = point - place_of(here) - rotated(centre, turn)
    wanted = depth * inward + slip
    if quartic == type(quartic)():
        twist = contact_twist(arm, inward, wanted, lever, friction)
    else:
        twist = quartic_twist(arm, inward, wanted, lever, friction, turned_quartic(quartic, turn))
    return moved_by(here, twist, centre)
