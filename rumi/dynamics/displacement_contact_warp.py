"""What the tool meets in the fields of the displacement rollouts, in Warp; `displacement_rollouts.py` defines it.

The tool's place is (x, y, z) and its turn (cos, sin). Points and discs have three coordinates; a field has three axes,
along which it is constant where there is one node.
"""

from typing import Any

from sdf import gpu
from sdf.lanes_warp import greatest, least

wp = gpu.warp()


@wp.func
def placed(place: Any, turn: Any, point: Any):
    """A point of the tool in the world."""
    x, y = turn[0] * point[0] - turn[1] * point[1], turn[1] * point[0] + turn[0] * point[1]
    return type(place)(place[0] + x, place[1] + y, place[2] + point[2])


@wp.func
def _node(place: Any, count: int):
    """Node below a lattice coordinate, and the way from there to the next one."""
    if count == 1:
        return 0, type(place)(0.0)
    inside = wp.clamp(place, type(place)(-2.0), type(place)(count + 1))
    low = wp.floor(inside)
    return int(low), inside - low


@wp.func
def _at_node(field: wp.array4d(dtype=Any), i: int, j: int, k: int, channel: int):
    """A channel at a node; 0 outside."""
    if i < 0 or j < 0 or k < 0 or i >= field.shape[0] or j >= field.shape[1] or k >= field.shape[2]:
        return field.dtype(0.0)
    return field[i, j, k, channel]


@wp.func
def value_at(point: Any, field: wp.array4d(dtype=Any), channel: int, origin: Any, scale: Any):
    """Multilinear value of a channel of a field; zero fades in outside."""
    i, a = _node((point[0] - origin[0]) * scale, field.shape[0])
    j, b = _node((point[1] - origin[1]) * scale, field.shape[1])
    k, c = _node((point[2] - origin[2]) * scale, field.shape[2])
    layers = wp.where(c > type(c)(0.0), 2, 1)
    value = type(scale)(0.0)
    for layer in range(layers):
        w = k + layer
        near = wp.lerp(_at_node(field, i, j, w, channel), _at_node(field, i, j + 1, w, channel), b)
        far = wp.lerp(_at_node(field, i + 1, j, w, channel), _at_node(field, i + 1, j + 1, w, channel), b)
        value += wp.lerp(near, far, a) * wp.where(layer == 1, c, type(c)(1.0) - c)
    return value


@wp.func
def _nearest(place: Any, count: int):
    """Node next to a lattice coordinate; -1 outside."""
    if count == 1:
        return 0
    node = wp.floor(wp.clamp(place, type(place)(-1.0), type(place)(count)) + type(place)(0.5))
    return wp.where(node < type(place)(count), int(node), -1)


@wp.func
def _highest(point: Any, bound: wp.array3d(dtype=Any), origin: wp.array(dtype=Any), scale: Any):
    """Greatest contact probability that a point of the disc about a place can have; see `ContactBound`."""
    i = _nearest((point[0] - origin[0]) * scale, bound.shape[0])
    j = _nearest((point[1] - origin[1]) * scale, bound.shape[1])
    k = _nearest((point[2] - origin[2]) * scale, bound.shape[2])
    if i < 0 or j < 0 or k < 0:
        return type(scale)(0.0)
    return bound[i, j, k]


@wp.func
def touch(
    place: Any,
    turn: Any,
    level: Any,
    points: wp.array2d(dtype=Any),
    order: wp.array(dtype=wp.int64),
    starts: wp.array(dtype=wp.int64),
    discs: wp.array2d(dtype=Any),
    bound: wp.array3d(dtype=Any),
    bound_origin: wp.array(dtype=Any),
    probability: wp.array4d(dtype=Any),
    origin: Any,
    scale: Any,
    tie: Any,
    lane: int,
):
    """The first of the tool's points with the greatest contact probability, -1 if that is not above `level`.

    And whether any point had to be looked at. Points come by the discs that bound them, with their order in the tool;
    lanes share the discs.
    """
    most, looked, best = type(scale)(0.0), int(0), int(-1)
    for d in range(lane, discs.shape[0], wp.block_dim()):
        centre = type(place)(discs[d, 0], discs[d, 1], discs[d, 2])
        highest = _highest(placed(place, turn, centre), bound, bound_origin, scale)
        if highest > level:
            looked = 1
        if highest > level and highest >= most - tie:
            for n in range(int(starts[d]), int(starts[d + 1])):
                point = placed(place, turn, type(place)(points[n, 0], points[n, 1], points[n, 2]))
                most = wp.max(most, value_at(point, probability, 0, origin, scale))
    if greatest(looked) == 0:
        return best, False
    most = greatest(most)
    if level < most:
        first = points.shape[0] + 0
        for d in range(lane, discs.shape[0], wp.block_dim()):
            centre = type(place)(discs[d, 0], discs[d, 1], discs[d, 2])
            if _highest(placed(place, turn, centre), bound, bound_origin, scale) >= most - tie:
                for n in range(int(starts[d]), int(starts[d + 1])):
                    if int(order[n]) < first:
                        point = placed(place, turn, type(place)(points[n, 0], points[n, 1], points[n, 2]))
                        if value_at(point, probability, 0, origin, scale) >= most - tie:
                            first = int(order[n])
                            best = n
        if least(first) != first:
            best = -1
        best = greatest(best)
    return best, True


@wp.func
def pushes(normal: Any, motion: Any, push_cosine: Any, spatial: bool):
    """Whether a motion goes into the surface within the push angle, in space also sideways."""
    length, way, tiny = wp.length(normal), wp.length(motion), type(push_cosine)(1e-6)
    inward = -wp.dot(normal, motion)
    level = wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    sideways = level >= wp.abs(normal[2]) or not spatial
    return inward > push_cosine * length * way and length > tiny and way > tiny and sideways
