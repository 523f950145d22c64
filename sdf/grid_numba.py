"""Building blocks for compiled CPU kernels: a `GridSDF` looked up at one object-frame point.

`grid_sdf.py` has the definition; what these functions take of a `GridSDF` is made at the end of this file:

    flat, numbers, sizes = grid_arguments(sdf, dtype)            outside of the kernel, NumPy arrays

    lattice = lattice_of(numbers, sizes)                         once in the kernel, in front of its loops
    v = value(x, y, z, flat, lattice)                            metres
    v, gx, gy, gz = value_and_gradient(x, y, z, flat, lattice)   metres, and the gradient in the object frame

and for points of one height, where four corners do instead of eight,

    layer, rise, level = layer_arguments(sdf, z, dtype)          outside of the kernel; with numbers, sizes as above

    level = (level[0], level[1])                                 once, as above
    v = layer_value(x, y, layer, lattice, level)
    v, gx, gy, gz = layer_value_and_gradient(x, y, layer, rise, lattice, level)

x, y, z and all float arrays are of one kind, float32 or float64, and so are the results. Nothing branches, so that an
innermost loop over points or poses can become vector instructions, three to five times as quick; a coordinate that is
not finite counts as very far, as there. For that, call them in kernels made by `Kernel(function, fast=True)`, which may
reorder sums but keeps NaN what it is, and in such a loop either only add up or read and write by `intrinsics_numba`.
"""

import math

import numba
import numpy as np
import torch
from torch import Tensor

from sdf.check import FAR
from sdf.compiled import inner
from sdf.grid_sdf import GridSDF, lattice_numbers
from sdf.intrinsics_numba import at, next_to, node, whole

Arrays = tuple[np.ndarray, ...]

_TINY = 1e-30
# not kept on their own: kernels are, and what is kept of a block would outlive a change of another that it uses
block = inner(forceinline=True, fastmath={"contract", "nsz"})
# functions that stay functions: to the bit, or with sums reordered so that their loops become vector instructions
exact = inner()
fast = inner(fastmath={"reassoc", "contract", "arcp", "nsz"})
# the same within each caller: called with constants it is optimised otherwise there than by itself, and which of both a
# process runs hangs on whether it compiled them or read them from the cache
summed = inner(forceinline=True, fastmath={"reassoc", "contract", "arcp", "nsz"})


@block
def lattice_of(numbers, sizes):
    """The numbers of a lattice as one tuple of scalars, for the functions below."""
    return (
        numbers[0],  # cells of the fine part a metre
        numbers[1],  # shift of x, y, z, cells
        numbers[2],
        numbers[3],
        numbers[4],  # first fine node
        numbers[5],  # last fine node of each axis
        numbers[6],
        numbers[7],
        numbers[8],  # how far the wide cells reach, fine spacings
        numbers[9],  # wide cells a fine one
        numbers[10],  # spacing of the fine part, metres
        numbers[11],  # from the lattice's faces to the object's bounds, fine spacings
        numbers[12],  # last lower node of each axis
        numbers[13],
        numbers[14],
        numba.int32(sizes[1] * sizes[2]),  # strides in the table
        numba.int32(sizes[2]),
        numba.int32(sizes[1]),  # stride in a layer
    )


# without the flag said, that of the caller would hold
@inner(forceinline=True, fastmath=False)
def _place(x, scale, shift):
    """Rounded as the plain version rounds, so that a point on a node or a face falls to the same side of it."""
    return x * scale + shift


@block
def _along(x, shift, first, last, lattice):
    """Lattice coordinate, and fine spacings beyond the lattice, of a coordinate in metres."""
    kind = type(x)
    far = kind(FAR)
    x = x if x < far else far
    x = x if x > -far else -far
    place = _place(x, lattice[0], shift)
    fine = place if place > first else first
    fine = fine if fine < last else last
    low, high = first - lattice[8], last + lattice[8]
    kept = place if place > low else low
    kept = kept if kept < high else high
    return fine + lattice[9] * (kept - fine), place - kept


@block
def _rate(cell, offset, last, lattice):
    """Lattice cells a fine spacing: of the cell that a lattice coordinate is in; 0 beyond the lattice."""
    kind = type(cell)
    fine = (cell >= lattice[4]) & (cell < last)
    rate = kind(1.0) if fine else lattice[9]
    return rate if offset == kind(0.0) else kind(0.0)


@block
def _beyond(offset, lattice):
    """What an offset beyond the lattice adds to the squared distance, square fine spacings."""
    size = abs(offset)
    return size * (size + lattice[11] + lattice[11])


@block
def _join(inner, total, lattice):
    """Distance from the clamped point's value and what the offsets add, and its size."""
    kind = type(inner)
    square = total * (lattice[10] * lattice[10]) + inner * inner
    far = math.sqrt(square if square > kind(_TINY) else kind(_TINY))
    return inner + (far - abs(inner)), far


@block
def _sign(x):
    kind = type(x)
    return (kind(1.0) if x > kind(0.0) else kind(0.0)) - (kind(1.0) if x < kind(0.0) else kind(0.0))


@block
def _low(cell, top):
    """Lower node of a lattice coordinate."""
    return whole(cell if cell < top else top)


@block
def value(x, y, z, flat, lattice):
    """Signed distance at an object-frame point, metres."""
    u, over_x = _along(x, lattice[1], lattice[4], lattice[5], lattice)
    v, over_y = _along(y, lattice[2], lattice[4], lattice[6], lattice)
    w, over_z = _along(z, lattice[3], lattice[4], lattice[7], lattice)
    i, j, k = _low(u, lattice[12]), _low(v, lattice[13]), _low(w, lattice[14])
    kind = type(x)
    a, b, c = u - kind(i), v - kind(j), w - kind(k)
    near = node(i, j, k, lattice[15], lattice[16])
    far = next_to(near, lattice[15])
    near_up, far_up = next_to(near, lattice[16]), next_to(far, lattice[16])
    one = numba.int32(1)
    v00 = at(flat, near)
    v01 = at(flat, near_up)
    v10 = at(flat, far)
    v11 = at(flat, far_up)
    v00 += c * (at(flat, next_to(near, one)) - v00)
    v01 += c * (at(flat, next_to(near_up, one)) - v01)
    v10 += c * (at(flat, next_to(far, one)) - v10)
    v11 += c * (at(flat, next_to(far_up, one)) - v11)
    v0 = v00 + b * (v01 - v00)
    v1 = v10 + b * (v11 - v10)
    total = _beyond(over_x, lattice) + _beyond(over_y, lattice) + _beyond(over_z, lattice)
    return _join(v0 + a * (v1 - v0), total, lattice)[0]


@block
def value_and_gradient(x, y, z, flat, lattice):
    """Signed distance at an object-frame point, metres, and its gradient there."""
    u, over_x = _along(x, lattice[1], lattice[4], lattice[5], lattice)
    v, over_y = _along(y, lattice[2], lattice[4], lattice[6], lattice)
    w, over_z = _along(z, lattice[3], lattice[4], lattice[7], lattice)
    i, j, k = _low(u, lattice[12]), _low(v, lattice[13]), _low(w, lattice[14])
    kind = type(x)
    a, b, c = u - kind(i), v - kind(j), w - kind(k)
    near = node(i, j, k, lattice[15], lattice[16])
    far = next_to(near, lattice[15])
    near_up, far_up = next_to(near, lattice[16]), next_to(far, lattice[16])
    one = numba.int32(1)
    v00 = at(flat, near)
    v01 = at(flat, near_up)
    v10 = at(flat, far)
    v11 = at(flat, far_up)
    s00 = at(flat, next_to(near, one)) - v00
    s01 = at(flat, next_to(near_up, one)) - v01
    s10 = at(flat, next_to(far, one)) - v10
    s11 = at(flat, next_to(far_up, one)) - v11
    v00 += c * s00
    v01 += c * s01
    v10 += c * s10
    v11 += c * s11
    s0, s1 = s00 + b * (s01 - s00), s10 + b * (s11 - s10)
    t0, t1 = v01 - v00, v11 - v10
    v0, v1 = v00 + b * t0, v10 + b * t1
    slope_x, slope_y, slope_z = v1 - v0, t0 + a * (t1 - t0), s0 + a * (s1 - s0)
    total = _beyond(over_x, lattice) + _beyond(over_y, lattice) + _beyond(over_z, lattice)
    inner = v0 + a * slope_x
    distance, far_off = _join(inner, total, lattice)
    inverse = kind(1.0) / far_off
    steep = (kind(1.0) + (inner * inverse - _sign(inner))) * lattice[0]
    spread = inverse * lattice[10]
    return (
        distance,
        slope_x * _rate(u, over_x, lattice[5], lattice) * steep + spread * (over_x + _sign(over_x) * lattice[11]),
        slope_y * _rate(v, over_y, lattice[6], lattice) * steep + spread * (over_y + _sign(over_y) * lattice[11]),
        slope_z * _rate(w, over_z, lattice[7], lattice) * steep + spread * (over_z + _sign(over_z) * lattice[11]),
    )


@block
def between(place, top, table, row):
    """A flat table's value between two nodes of a row that begins at `row`; before node 0 and beyond `top` as there."""
    kind = type(place)
    place = place if place > kind(0.0) else kind(0.0)
    place = place if place < top else top
    low = whole(place)
    index = next_to(low, row)
    value_low = at(table, index)
    return value_low + (place - kind(low)) * (at(table, next_to(index, numba.int32(1))) - value_low)


@block
def layer_value(x, y, layer, lattice, level):
    """What `value` gives at the layer's height."""
    u, over_x = _along(x, lattice[1], lattice[4], lattice[5], lattice)
    v, over_y = _along(y, lattice[2], lattice[4], lattice[6], lattice)
    i, j = _low(u, lattice[12]), _low(v, lattice[13])
    kind = type(x)
    a, b = u - kind(i), v - kind(j)
    one = numba.int32(1)
    near = node(i, j, numba.int32(0), lattice[17], one)
    far = next_to(near, lattice[17])
    v0, v1 = at(layer, near), at(layer, far)
    v0 += b * (at(layer, next_to(near, one)) - v0)
    v1 += b * (at(layer, next_to(far, one)) - v1)
    total = _beyond(over_x, lattice) + _beyond(over_y, lattice) + _beyond(level[0], lattice)
    return _join(v0 + a * (v1 - v0), total, lattice)[0]


@block
def layer_value_and_gradient(x, y, layer, rise, lattice, level):
    """What `value_and_gradient` gives at the layer's height."""
    u, over_x = _along(x, lattice[1], lattice[4], lattice[5], lattice)
    v, over_y = _along(y, lattice[2], lattice[4], lattice[6], lattice)
    over_z = level[0]
    i, j = _low(u, lattice[12]), _low(v, lattice[13])
    kind = type(x)
    a, b = u - kind(i), v - kind(j)
    one = numba.int32(1)
    near = node(i, j, numba.int32(0), lattice[17], one)
    far = next_to(near, lattice[17])
    near_up, far_up = next_to(near, one), next_to(far, one)
    v0, v1 = at(layer, near), at(layer, far)
    t0, t1 = at(layer, near_up) - v0, at(layer, far_up) - v1
    v0 += b * t0
    v1 += b * t1
    slope_x, slope_y = v1 - v0, t0 + a * (t1 - t0)
    s0, s1 = at(rise, near), at(rise, far)
    s0 += b * (at(rise, near_up) - s0)
    s1 += b * (at(rise, far_up) - s1)
    slope_z = s0 + a * (s1 - s0)
    total = _beyond(over_x, lattice) + _beyond(over_y, lattice) + _beyond(over_z, lattice)
    inner = v0 + a * slope_x
    distance, far_off = _join(inner, total, lattice)
    inverse = kind(1.0) / far_off
    steep = (kind(1.0) + (inner * inverse - _sign(inner))) * lattice[0]
    spread = inverse * lattice[10]
    return (
        distance,
        slope_x * _rate(u, over_x, lattice[5], lattice) * steep + spread * (over_x + _sign(over_x) * lattice[11]),
        slope_y * _rate(v, over_y, lattice[6], lattice) * steep + spread * (over_y + _sign(over_y) * lattice[11]),
        slope_z * level[1] * steep + spread * (over_z + _sign(over_z) * lattice[11]),
    )


def grid_arguments(sdf: GridSDF, dtype: torch.dtype) -> Arrays:
    """Values (X * Y * Z), numbers of the lattice (15), both of `dtype`, and sizes (3): what look-ups take."""
    numbers, sizes = lattice_numbers(sdf)
    flat = sdf.values.detach().to(dtype).contiguous().view(-1)
    return flat.numpy(), torch.tensor(numbers, dtype=dtype).numpy(), np.array(sizes)


def layer_arguments(sdf: GridSDF, z: float | Tensor, dtype: torch.dtype) -> Arrays:
    """The layer at a height (X * Y), its slopes along z (X * Y), and (offset, rate) along z, all of `dtype`.

    Args:
        sdf: the table.
        z: height in the object frame, metres.
        dtype: of the arrays.
    """
    height = torch.as_tensor(z, dtype=dtype).detach()
    layer, rise, level = sdf.layer(height)
    return layer.view(-1).numpy(), rise.view(-1).numpy(), level.numpy()
