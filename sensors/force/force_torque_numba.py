"""Contact point of a wrench, compiled for the CPU; `force_torque.py` and `tool_surface.py` have the definition."""

import math

from sdf.compiled import Kernel, bare
from sdf.part_numba import indices

_NONE, _CONTACT, _TWIST, _MISS, _FRICTION = 0, 1, 2, 3, 4
_STEPS = 64


@bare
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@bare
def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@bare
def _plus(a, share, b):
    return (a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2])


@bare
def _strike_sphere(sphere, origin, d):
    """Point, normal and gap."""
    center, radius = (sphere[0], sphere[1], sphere[2]), sphere[3]
    apart = _plus(origin, -1.0, center)
    foot = _plus(apart, -_dot(apart, d), d)
    square = _dot(foot, foot)
    if square <= radius * radius:
        normal = _plus((0.0, 0.0, 0.0), 1.0 / radius, _plus(foot, -math.sqrt(radius * radius - square), d))
    else:
        normal = _plus((0.0, 0.0, 0.0), 1.0 / math.sqrt(square), foot)
    return _plus(center, radius, normal), normal, math.sqrt(square) - radius


@bare
def _strike_planes(planes, origin, d):
    """Point, normal and gap."""
    enter, leave, into, out = -math.inf, math.inf, 0, 0
    beside = False
    for f in range(len(planes)):
        n = (planes[f, 0], planes[f, 1], planes[f, 2])
        rate, room = _dot(n, d), planes[f, 3] - _dot(n, origin)
        # times are room / rate; a division a plane would take most of the time
        if rate < 0.0:
            if room < enter * rate:
                enter, into = room / rate, f
        elif rate > 0.0:
            if room < leave * rate:
                leave, out = room / rate, f
        elif room < 0.0:
            beside = True
    if enter <= leave and not beside:
        return _plus(origin, enter, d), (planes[into, 0], planes[into, 1], planes[into, 2]), 0.0
    return _pass_planes(planes, origin, d, into, out)


@bare
def _pass_planes(planes, origin, d, into, out):
    """The same of a line that goes by, by the planes that bound it most."""
    scale = 0.0
    for f in range(len(planes)):
        scale = max(scale, abs(planes[f, 3] - _dot((planes[f, 0], planes[f, 1], planes[f, 2]), origin)))
    at = gap = 0.0
    for _ in range(_STEPS + 1):
        n, m = (planes[into, 0], planes[into, 1], planes[into, 2]), (planes[out, 0], planes[out, 1], planes[out, 2])
        rate, other = _dot(n, d), _dot(m, d)
        room, space = planes[into, 3] - _dot(n, origin), planes[out, 3] - _dot(m, origin)
        at = (room - space) / (rate - other)
        gap = rate * at - room
        highest, face, slope = -math.inf, 0, 0.0
        for f in range(len(planes)):
            k = (planes[f, 0], planes[f, 1], planes[f, 2])
            own = _dot(k, d)
            value = own * at - (planes[f, 3] - _dot(k, origin))
            if value > highest:
                highest, face, slope = value, f, own
        if highest <= gap + scale * 8.0 * 2.3e-16:
            break
        if slope <= 0.0:
            into = face
        else:
            out = face
    n = (planes[into, 0], planes[into, 1], planes[into, 2])
    return _plus(_plus(origin, at, d), -gap, n), n, gap


@bare
def _struck_beside(planes, point, d, root):
    """Faces, or -1 for a miss, that two lines along d strike, which go by a point on either side at root."""
    enter, leave, into = -math.inf, math.inf, 0
    enter_2, leave_2, into_2 = -math.inf, math.inf, 0
    beside = beside_2 = False
    for f in range(len(planes)):
        n = (planes[f, 0], planes[f, 1], planes[f, 2])
        rate, room, step = _dot(n, d), planes[f, 3] - _dot(n, point), _dot(n, root)
        near, far = room - step, room + step
        if rate < 0.0:
            if near < enter * rate:
                enter, into = near / rate, f
            if far < enter_2 * rate:
                enter_2, into_2 = far / rate, f
        elif rate > 0.0:
            if near < leave * rate:
                leave = near / rate
            if far < leave_2 * rate:
                leave_2 = far / rate
        else:
            beside |= near < 0.0
            beside_2 |= far < 0.0
    return (
        -1 if enter > leave or beside else into,
        -1 if enter_2 > leave_2 or beside_2 else into_2,
    )


@bare
def _normal_sd(sphere, planes, point, normal, d, first, second, least):
    if sphere[3] > 0.0:
        slant = min(_dot(normal, d), -least)
        a = _plus(first, -_dot(first, normal) / slant, d)
        b = _plus(second, -_dot(second, normal) / slant, d)
        return math.sqrt(0.5 * (_dot(a, a) + _dot(b, b))) / sphere[3]
    total = 0.0
    for axis in range(2):
        root = first if axis == 0 else second
        faces = _struck_beside(planes, point, d, root)
        for side in range(2):
            face = faces[side]
            if face < 0:
                other = _strike_planes(planes, _plus(point, 1.0 - 2.0 * side, root), d)[1]
            else:
                other = (planes[face, 0], planes[face, 1], planes[face, 2])
            off = _plus(other, -1.0, normal)
            angle = 2.0 * math.asin(min(0.5 * math.sqrt(_dot(off, off)), 1.0))
            total += 0.5 * angle * angle
    return math.sqrt(0.5 * total)


@bare
def _through(row, noise, other):
    """The product row . noise . other."""
    total = 0.0
    for i in range(6):
        part = 0.0
        for j in range(6):
            part += noise[i, j] * other[j]
        total += row[i] * part
    return total


@bare
def _row(beside, force, square, twist, d, point):
    """How the line moves along a direction beside it with the wrench, six numbers."""
    # beside . (-F P - twist D) = ((P F) beside - twist D^T beside), all cross product matrices being skew
    v = _cross(point, _cross(force, beside))
    turn = _cross(d, beside)
    by_moment = _cross(force, beside)
    return (
        (-v[0] + twist * turn[0]) / square,
        (-v[1] + twist * turn[1]) / square,
        (-v[2] + twist * turn[2]) / square,
        -by_moment[0] / square,
        -by_moment[1] / square,
        -by_moment[2] / square,
    )


def _contacts(wrenches, sphere, planes, noise, least, friction, twist_m, sigmas, numbers, status, part):
    cone = math.atan(friction)
    for b in indices(part, len(wrenches)):
        w = wrenches[b]
        force, moment = (w[0], w[1], w[2]), (w[3], w[4], w[5])
        square = _dot(force, force)
        if square < least * least:
            numbers[b] = 0.0
            status[b] = _NONE
            continue
        size = math.sqrt(square)
        d = (w[0] / size, w[1] / size, w[2] / size)
        twist = _dot(moment, d)
        cross = _cross(force, moment)
        foot = (cross[0] / square, cross[1] / square, cross[2] / square)
        if sphere[3] > 0.0:
            point, normal, gap = _strike_sphere(sphere, foot, d)
        else:
            point, normal, gap = _strike_planes(planes, foot, d)

        if abs(d[0]) <= abs(d[1]) and abs(d[0]) <= abs(d[2]):
            axis = (1.0, 0.0, 0.0)
        elif abs(d[1]) <= abs(d[2]):
            axis = (0.0, 1.0, 0.0)
        else:
            axis = (0.0, 0.0, 1.0)
        u = _cross(d, axis)
        u = _plus((0.0, 0.0, 0.0), 1.0 / math.sqrt(_dot(u, u)), u)
        v = _cross(d, u)
        row_u, row_v = _row(u, force, square, twist, d, point), _row(v, force, square, twist, d, point)
        uu, uv, vv = _through(row_u, noise, row_u), _through(row_u, noise, row_v), _through(row_v, noise, row_v)
        aslant = math.cos(cone)
        slant = min(_dot(normal, d), -aslant)
        moved_u, moved_v = _plus(u, -_dot(u, normal) / slant, d), _plus(v, -_dot(v, normal) / slant, d)
        a = math.sqrt(max(uu, 0.0))
        c = uv / a if a > 0.0 else 0.0
        e = math.sqrt(max(vv - c * c, 0.0))
        first = _plus(_plus((0.0, 0.0, 0.0), a, u), c, v)
        second = _plus((0.0, 0.0, 0.0), e, v)
        normal_sd = _normal_sd(sphere, planes, point, normal, d, first, second, aslant)
        for i in range(3):
            numbers[b, i], numbers[b, 3 + i] = point[i], normal[i]
            for j in range(3):
                numbers[b, 6 + 3 * i + j] = (
                    uu * moved_u[i] * moved_u[j]
                    + uv * (moved_u[i] * moved_v[j] + moved_v[i] * moved_u[j])
                    + vv * moved_v[i] * moved_v[j]
                )
        numbers[b, 15] = normal_sd

        arm = _plus(moment, -twist, d)
        turn = (arm[0] / size, arm[1] / size, arm[2] / size, d[0], d[1], d[2])
        twist_sd = math.sqrt(max(_through(turn, noise, turn), 0.0))
        aim = (d[0], d[1], d[2], 0.0, 0.0, 0.0)
        aim_var = 0.5 * (noise[0, 0] + noise[1, 1] + noise[2, 2] - _through(aim, noise, aim))
        lean = math.acos(min(max(-_dot(normal, d), -1.0), 1.0))
        lean_sd = math.sqrt(max(aim_var, 0.0) / square + normal_sd * normal_sd)
        if abs(twist) > twist_m * size + sigmas * twist_sd:
            status[b] = _TWIST
        elif gap > sigmas * math.sqrt(max(uu + vv, 0.0)):
            status[b] = _MISS
        elif lean > cone + sigmas * lean_sd:
            status[b] = _FRICTION
        else:
            status[b] = _CONTACT


contacts = Kernel(_contacts)
