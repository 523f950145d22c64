"""The fused CPU versions of an object at many poses; `posed.py` has the definition.

Results are (scenes, poses, points), flat. Poses come as the twelve numbers of object_T_world's upper rows, points by
coordinate, a row of them for each scene: row `which[scene]`.
"""

from sdf.compiled import Kernel
from sdf.grid_numba import (
    at,
    block,
    lattice_of,
    layer_value,
    layer_value_and_gradient,
    put,
    value,
    value_and_gradient,
)
from sdf.part_numba import indices

# points of one task: enough to be worth a thread's while
_STEP = 4096


@block
def row(rows, scene, pose):
    """The twelve numbers of one pose."""
    m = rows[scene, pose]
    return m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], m[9], m[10], m[11]


@block
def placed(m, x, y, z):
    """A point in the object frame."""
    return (
        m[0] * x + m[1] * y + m[2] * z + m[3],
        m[4] * x + m[5] * y + m[6] * z + m[7],
        m[8] * x + m[9] * y + m[10] * z + m[11],
    )


@block
def placed_upright(m, x, y):
    """The same without its height, where the object is upright."""
    return m[0] * x + m[1] * y + m[3], m[4] * x + m[5] * y + m[7]


@block
def placed_from(planes, poses, j, x, y, z):
    """A point in the frame of object j, whose numbers lie one by one, `poses` apart."""
    return (
        at(planes, j) * x + at(planes, poses + j) * y + at(planes, 2 * poses + j) * z + at(planes, 3 * poses + j),
        at(planes, 4 * poses + j) * x
        + at(planes, 5 * poses + j) * y
        + at(planes, 6 * poses + j) * z
        + at(planes, 7 * poses + j),
        at(planes, 8 * poses + j) * x
        + at(planes, 9 * poses + j) * y
        + at(planes, 10 * poses + j) * z
        + at(planes, 11 * poses + j),
    )


@block
def placed_upright_from(planes, poses, j, x, y):
    """The same without its height, where the object is upright."""
    return (
        at(planes, j) * x + at(planes, poses + j) * y + at(planes, 3 * poses + j),
        at(planes, 4 * poses + j) * x + at(planes, 5 * poses + j) * y + at(planes, 7 * poses + j),
    )


def _distance(rows, points, which, flat, rise, level, numbers, sizes, distance, part):
    lattice = lattice_of(numbers, sizes)
    poses, count = rows.shape[1], points.shape[2]
    blocks = (count + _STEP - 1) // _STEP
    given = points.reshape(-1)
    for task in indices(part, rows.shape[0] * poses * blocks):
        owner, first = task // blocks, task % blocks * _STEP
        pose = row(rows, owner // poses, owner % poses)
        from_x = 3 * count * which[owner // poses]
        from_y, from_z, to = from_x + count, from_x + 2 * count, owner * count
        for i in range(first, min(first + _STEP, count)):
            x, y, z = at(given, from_x + i), at(given, from_y + i), at(given, from_z + i)
            x_o, y_o, z_o = placed(pose, x, y, z)
            put(distance, to + i, value(x_o, y_o, z_o, flat, lattice))


def _query(rows, points, which, flat, rise, level, numbers, sizes, distance, gradient, part):
    lattice = lattice_of(numbers, sizes)
    poses, count = rows.shape[1], points.shape[2]
    blocks = (count + _STEP - 1) // _STEP
    given = points.reshape(-1)
    for task in indices(part, rows.shape[0] * poses * blocks):
        owner, first = task // blocks, task % blocks * _STEP
        pose = row(rows, owner // poses, owner % poses)
        from_x = 3 * count * which[owner // poses]
        from_y, from_z, to = from_x + count, from_x + 2 * count, owner * count
        for i in range(first, min(first + _STEP, count)):
            x, y, z = at(given, from_x + i), at(given, from_y + i), at(given, from_z + i)
            x_o, y_o, z_o = placed(pose, x, y, z)
            found, along_x, along_y, along_z = value_and_gradient(x_o, y_o, z_o, flat, lattice)
            put(distance, to + i, found)
            put(gradient, 3 * (to + i), along_x)
            put(gradient, 3 * (to + i) + 1, along_y)
            put(gradient, 3 * (to + i) + 2, along_z)


def _layer_distance(rows, points, which, layer, rise, level, numbers, sizes, distance, part):
    lattice, height = lattice_of(numbers, sizes), (level[0], level[1])
    poses, count = rows.shape[1], points.shape[2]
    blocks = (count + _STEP - 1) // _STEP
    given = points.reshape(-1)
    for task in indices(part, rows.shape[0] * poses * blocks):
        owner, first = task // blocks, task % blocks * _STEP
        pose = row(rows, owner // poses, owner % poses)
        from_x, to = 3 * count * which[owner // poses], owner * count
        from_y = from_x + count
        for i in range(first, min(first + _STEP, count)):
            x, y = at(given, from_x + i), at(given, from_y + i)
            x_o, y_o = placed_upright(pose, x, y)
            put(distance, to + i, layer_value(x_o, y_o, layer, lattice, height))


def _layer_query(rows, points, which, layer, rise, level, numbers, sizes, distance, gradient, part):
    lattice, height = lattice_of(numbers, sizes), (level[0], level[1])
    poses, count = rows.shape[1], points.shape[2]
    blocks = (count + _STEP - 1) // _STEP
    given = points.reshape(-1)
    for task in indices(part, rows.shape[0] * poses * blocks):
        owner, first = task // blocks, task % blocks * _STEP
        pose = row(rows, owner // poses, owner % poses)
        from_x, to = 3 * count * which[owner // poses], owner * count
        from_y = from_x + count
        for i in range(first, min(first + _STEP, count)):
            x, y = at(given, from_x + i), at(given, from_y + i)
            x_o, y_o = placed_upright(pose, x, y)
            found, along_x, along_y, along_z = layer_value_and_gradient(x_o, y_o, layer, rise, lattice, height)
            put(distance, to + i, found)
            put(gradient, 3 * (to + i), along_x)
            put(gradient, 3 * (to + i) + 1, along_y)
            put(gradient, 3 * (to + i) + 2, along_z)


distance, query = Kernel(_distance, fast=True), Kernel(_query, fast=True)
layer_distance, layer_query = Kernel(_layer_distance, fast=True), Kernel(_layer_query, fast=True)
