"""Building blocks of compiled pushing: one contact of a tool and an object; `sliding.py` has the definition."""

import math

from sdf.compiled import bare

_WEDGED = 0.1
_RIM = 0.95
_STICKS = 10.0
_ROOTS = 8


@bare
def value(x, y, values, low_x, low_y, spacing):
    """Signed distance at a point of the object's frame; beyond the table, a positive lower bound of it."""
    rows, columns = values.shape
    u, v = (x - low_x) / spacing, (y - low_y) / spacing
    a, b = min(max(u, 0.0), rows - 1.0), min(max(v, 0.0), columns - 1.0)
    far_x, far_y = spacing * (u - a), spacing * (v - b)
    i, j = min(int(a), rows - 2), min(int(b), columns - 2)
    a, b = a - i, b - j
    low = values[i, j] + b * (values[i, j + 1] - values[i, j])
    high = values[i + 1, j] + b * (values[i + 1, j + 1] - values[i + 1, j])
    there = low + a * (high - low)
    if far_x != 0.0 or far_y != 0.0:
        return math.sqrt(there * there + far_x * far_x + far_y * far_y)
    return there


@bare
def slope(x, y, values, low_x, low_y, spacing):
    """Gradient there."""
    rows, columns = values.shape
    a = min(max((x - low_x) / spacing, 0.0), rows - 1.0)
    b = min(max((y - low_y) / spacing, 0.0), columns - 1.0)
    i, j = min(int(a), rows - 2), min(int(b), columns - 2)
    a, b = a - i, b - j
    v00, v01, v10, v11 = values[i, j], values[i, j + 1], values[i + 1, j], values[i + 1, j + 1]
    along = (v10 + b * (v11 - v10)) - (v00 + b * (v01 - v00))
    across = (1.0 - a) * (v01 - v00) + a * (v11 - v10)
    return along / spacing, across / spacing


@bare
def twist(rx, ry, nx, ny, wx, wy, lever, friction):
    """Motion of the centre of friction and turn; see `contact_twist`."""
    square = lever * lever
    whole = square + rx * rx + ry * ry
    fx = ((square + rx * rx) * wx + rx * ry * wy) / whole
    fy = (rx * ry * wx + (square + ry * ry) * wy) / whole
    normal, tangential = fx * nx + fy * ny, fy * nx - fx * ny
    if not abs(tangential) <= friction * normal:
        side = friction if tangential > 0.0 else (-friction if tangential < 0.0 else 0.0)
        ex, ey = nx - side * ny, ny + side * nx
        moment, turned = rx * ey - ry * ex, rx * ny - ry * nx
        straight = 1.0 + turned * turned / square
        size = (wx * nx + wy * ny) / max(1.0 + turned * moment / square, _WEDGED * straight)
        fx, fy = size * ex, size * ey
    return fx, fy, (rx * fy - ry * fx) / square


@bare
def _moved(edge, rx, ry, nx, ny, lever, surface):
    """Twist by the force inward + edge across, and the contact point's motion along the normal and across."""
    a_xx, a_xy, a_yy, b_xx, b_xy, b_yy = surface
    fx, fy = nx - edge * ny, ny + edge * nx
    moment = (rx * fy - ry * fx) / lever
    ax, ay = a_xx * fx + a_xy * fy, a_xy * fx + a_yy * fy
    bx, by = b_xx * fx + b_xy * fy, b_xy * fx + b_yy * fy
    whole, half = ax * fx + ay * fy + moment * moment, 0.5 * moment * moment
    vx, vy = whole * ax + half * bx, whole * ay + half * by
    turn = (whole + 0.5 * (bx * fx + by * fy)) * moment / lever
    ux, uy = vx - turn * ry, vy + turn * rx
    return vx, vy, turn, ux * nx + uy * ny, uy * nx - ux * ny


@bare
def quartic_twist(rx, ry, nx, ny, wx, wy, lever, friction, quartic, cos, sin):
    """Motion of the centre of friction and turn; see `quartic_twist` in sliding.py. The object is at (cos, sin)."""
    first, second, mean, level, slant = quartic
    c, s = cos * cos - sin * sin, 2.0 * sin * cos
    first, second, level, slant = (
        c * first - s * second,
        s * first + c * second,
        c * level - s * slant,
        s * level + c * slant,
    )
    size = math.sqrt(first * first + second * second)
    grown, stretch = math.cosh(size), (math.sinh(size) / size if size > 1e-9 else 1.0)
    surface = (grown + stretch * first, stretch * second, grown - stretch * first, mean + level, slant, mean - level)
    forward, aside = wx * nx + wy * ny, wy * nx - wx * ny
    high = min(friction, _STICKS)
    low, edge = -high, -high
    _, _, _, normal, tangential = _moved(low, rx, ry, nx, ny, lever, surface)
    least = aside * normal - tangential * forward
    if least > 0.0:
        edge = high
        _, _, _, normal, tangential = _moved(high, rx, ry, nx, ny, lever, surface)
        most = aside * normal - tangential * forward
        if most < 0.0:
            side = 0
            for _ in range(_ROOTS):
                edge = (low * most - high * least) / (most - least)
                _, _, _, normal, tangential = _moved(edge, rx, ry, nx, ny, lever, surface)
                gap = aside * normal - tangential * forward
                if gap > 0.0:
                    low, least = edge, gap
                    if side > 0:
                        most *= 0.5
                    side = 1
                else:
                    high, most = edge, gap
                    if side < 0:
                        least *= 0.5
                    side = -1
                if gap == 0.0:
                    break
    vx, vy, turn, normal, _ = _moved(edge, rx, ry, nx, ny, lever, surface)
    _, _, _, straight, _ = _moved(0.0, rx, ry, nx, ny, lever, surface)
    size = forward / max(normal, _WEDGED * straight)
    most, gone = math.sqrt(wx * wx + wy * wy) / _WEDGED, math.sqrt(vx * vx + vy * vy) * abs(size)
    if gone > most:
        size *= most / gone
    return size * vx, size * vy, size * turn


@bare
def gathered(share, arm, lever):
    """Shift of the pressure's centre as what rests on its rim is pushed, and the lever about there; see `gathered`."""
    ahead = min(max(0.0, share) * max(0.0, arm), _RIM * lever)
    return ahead, math.sqrt(lever * lever - ahead * ahead)


@bare
def turned(angle):
    """Cosine and sine; most are of 0."""
    return (1.0, 0.0) if angle == 0.0 else (math.cos(angle), math.sin(angle))


@bare
def settled(x, y, yaw, cos, sin, first, tool, way, back, ax, ay, gx, gy, depth, thickness, body):
    """Pose of an object after one contact, with its cosine and sine; see `push`.

    The object is at (x, y, yaw), of (cos, sin), and was at `first` before the motion, `way`, which brought the tool to
    `tool`; `back` is the cosine and sine of that motion's turn undone. The tool's deepest point lies (ax, ay) from
    there, along the world's axes, and by `depth` in the object, where the outline's gradient, in the object's frame, is
    (gx, gy). `body` holds centre of friction (x, y), lever, friction, and the quartic limit surface.
    """
    centre_x, centre_y, lever, friction = body[0], body[1], body[2], body[3]
    quartic = (body[4], body[5], body[6], body[7], body[8])
    length = max(math.sqrt(gx * gx + gy * gy), 1e-9)
    nx, ny = -(cos * gx - sin * gy) / length, -(sin * gx + cos * gy) / length
    ax, ay = ax + thickness * nx, ay + thickness * ny
    # the touched point, from the tool's frame and from the object's
    ox, oy = tool[0] + ax - x, tool[1] + ay - y
    c, s = back
    slip_x, slip_y = c * ax - s * ay - ax - way[0], s * ax + c * ay - ay - way[1]
    c, s = turned(first[2] - yaw)
    slip_x = first[0] - x + c * ox - s * oy - ox - slip_x
    slip_y = first[1] - y + s * ox + c * oy - oy - slip_y
    along = slip_x * nx + slip_y * ny
    slip_x, slip_y = slip_x - along * nx, slip_y - along * ny
    arm_x, arm_y = cos * centre_x - sin * centre_y, sin * centre_x + cos * centre_y
    rx, ry, wx, wy = ox - arm_x, oy - arm_y, depth * nx + slip_x, depth * ny + slip_y
    if quartic == (0.0, 0.0, 0.0, 0.0, 0.0):
        fx, fy, turn = twist(rx, ry, nx, ny, wx, wy, lever, friction)
    else:
        fx, fy, turn = quartic_twist(rx, ry, nx, ny, wx, wy, lever, friction, quartic, cos, sin)
    c, s = math.cos(0.5 * turn), math.sin(0.5 * turn)
    x, y = x + arm_x + c * fx - s * fy, y + arm_y + s * fx + c * fy
    yaw += turn
    cos, sin = math.cos(yaw), math.sin(yaw)
    return x - (cos * centre_x - sin * centre_y), y - (sin * centre_x + cos * centre_y), yaw, cos, sin
