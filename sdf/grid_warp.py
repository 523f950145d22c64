"""Building blocks for kernels of one source for GPU and CPU: a `GridSDF` looked up at one object-frame point.

`grid_sdf.py` has the definition; what these functions take of a `GridSDF` is made by `grid_arguments`:

    flat, numbers = grid_arguments(sdf, dtype)              a tensor (X * Y * Z), and reals for `gpu.Numbers(LATTICE)`
    v = value(x, y, z, flat, numbers)                       metres, in a kernel
    q = value_and_gradient(x, y, z, flat, numbers)          q[0] metres, q[1..3] the gradient in the object frame

All reals are of one type, and so are the results. A coordinate that is not finite counts as very far.
"""

from typing import Any

import torch
from torch import Tensor

from sdf import gpu
from sdf.check import FAR
from sdf.grid_sdf import GridSDF, lattice_numbers

wp = gpu.warp()

LATTICE = 15
"""Reals that describe a lattice."""
_FAR, _TINY = wp.constant(FAR), wp.constant(1e-30)


@wp.func
def along(x: Any, shift: Any, last: Any, n: Any):
    """Lattice coordinate, and fine spacings beyond the lattice, of a coordinate in metres."""
    far = type(x)(_FAR)
    x = wp.where(x < far, x, far)  # so is NaN
    x = wp.where(x > -far, x, -far)
    place = x * n[0] + shift
    fine = wp.clamp(place, n[4], last)
    kept = wp.clamp(place, n[4] - n[8], last + n[8])
    return fine + n[9] * (kept - fine), place - kept


@wp.func
def rate(cell: Any, offset: Any, last: Any, n: Any):
    """Lattice cells a fine spacing: of the cell that a lattice coordinate is in; 0 beyond the lattice."""
    one = type(cell)(1.0)
    within = wp.where(cell >= n[4] and cell < last, one, n[9])
    return wp.where(offset == type(cell)(0.0), within, type(cell)(0.0))


@wp.func
def beyond(offset: Any, n: Any):
    """What an offset beyond the lattice adds to the squared distance, square fine spacings."""
    size = wp.abs(offset)
    return size * (size + n[11] + n[11])


@wp.func
def far_off(inner: Any, total: Any, n: Any):
    """Size of the distance from the clamped point's value and what the offsets add."""
    return wp.sqrt(wp.max(total * (n[10] * n[10]) + inner * inner, type(inner)(_TINY)))


@wp.func
def side(x: Any):
    """Sign, 0 of 0."""
    none, one = type(x)(0.0), type(x)(1.0)
    return wp.where(x > none, one, wp.where(x < none, -one, none))


@wp.func
def value(x: Any, y: Any, z: Any, flat: wp.array(dtype=Any), n: Any):
    """Signed distance at an object-frame point, metres."""
    u, over_x = along(x, n[1], n[5], n)
    v, over_y = along(y, n[2], n[6], n)
    w, over_z = along(z, n[3], n[7], n)
    i, j, k = int(wp.min(u, n[12])), int(wp.min(v, n[13])), int(wp.min(w, n[14]))
    a, b, c = u - type(x)(i), v - type(x)(j), w - type(x)(k)
    up = int(n[14]) + 2
    across = (int(n[13]) + 2) * up
    near = i * across + j * up + k
    v00 = wp.lerp(flat[near], flat[near + 1], c)
    v01 = wp.lerp(flat[near + up], flat[near + up + 1], c)
    v10 = wp.lerp(flat[near + across], flat[near + across + 1], c)
    v11 = wp.lerp(flat[near + across + up], flat[near + across + up + 1], c)
    inner = wp.lerp(wp.lerp(v00, v01, b), wp.lerp(v10, v11, b), a)
    total = beyond(over_x, n) + beyond(over_y, n) + beyond(over_z, n)
    return inner + (far_off(inner, total, n) - wp.abs(inner))


@wp.func
def value_and_gradient(x: Any, y: Any, z: Any, flat: wp.array(dtype=Any), n: Any):
    """Signed distance at an object-frame point, metres, and its gradient there, as one vector."""
    u, over_x = along(x, n[1], n[5], n)
    v, over_y = along(y, n[2], n[6], n)
    w, over_z = along(z, n[3], n[7], n)
    i, j, k = int(wp.min(u, n[12])), int(wp.min(v, n[13])), int(wp.min(w, n[14]))
    a, b, c = u - type(x)(i), v - type(x)(j), w - type(x)(k)
    up = int(n[14]) + 2
    across = (int(n[13]) + 2) * up
    near = i * across + j * up + k
    s00, s01 = flat[near + 1] - flat[near], flat[near + up + 1] - flat[near + up]
    s10 = flat[near + across + 1] - flat[near + across]
    s11 = flat[near + across + up + 1] - flat[near + across + up]
    v00, v01 = flat[near] + c * s00, flat[near + up] + c * s01
    v10, v11 = flat[near + across] + c * s10, flat[near + across + up] + c * s11
    s0, s1 = s00 + b * (s01 - s00), s10 + b * (s11 - s10)
    t0, t1 = v01 - v00, v11 - v10
    v0 = v00 + b * t0
    slope_x = v10 + b * t1 - v0
    slope_y, slope_z = t0 + a * (t1 - t0), s0 + a * (s1 - s0)
    total = beyond(over_x, n) + beyond(over_y, n) + beyond(over_z, n)
    inner = v0 + a * slope_x
    size = far_off(inner, total, n)
    steep = (type(x)(1.0) + (inner / size - side(inner))) * n[0]
    spread = n[10] / size
    return wp.vector(
        inner + (size - wp.abs(inner)),
        slope_x * rate(u, over_x, n[5], n) * steep + spread * (over_x + side(over_x) * n[11]),
        slope_y * rate(v, over_y, n[6], n) * steep + spread * (over_y + side(over_y) * n[11]),
        slope_z * rate(w, over_z, n[7], n) * steep + spread * (over_z + side(over_z) * n[11]),
    )


@wp.func
def placed(m: wp.array3d(dtype=Any), row: int, x: Any, y: Any, z: Any):
    """A world point in the frame of an object: of transforms object_T_world (N, 4, 4), or (N, 3, 4), one row."""
    return wp.vector(
        m[row, 0, 0] * x + m[row, 0, 1] * y + m[row, 0, 2] * z + m[row, 0, 3],
        m[row, 1, 0] * x + m[row, 1, 1] * y + m[row, 1, 2] * z + m[row, 1, 3],
        m[row, 2, 0] * x + m[row, 2, 1] * y + m[row, 2, 2] * z + m[row, 2, 3],
    )


@wp.func
def within(poses: wp.array3d(dtype=Any), row: int, x: Any, y: Any, z: Any):
    """A world point in the frame of the object at a pose world_T_object, of a row of poses (N, 4, 4).

    From the point's difference from the pose, which is exact or nearly so however far off both are.
    """
    x -= poses[row, 0, 3]
    y -= poses[row, 1, 3]
    z -= poses[row, 2, 3]
    return wp.vector(
        poses[row, 0, 0] * x + poses[row, 1, 0] * y + poses[row, 2, 0] * z,
        poses[row, 0, 1] * x + poses[row, 1, 1] * y + poses[row, 2, 1] * z,
        poses[row, 0, 2] * x + poses[row, 1, 2] * y + poses[row, 2, 2] * z,
    )


def grid_arguments(sdf: GridSDF, dtype: torch.dtype) -> tuple[Tensor, list[float]]:
    """Values (X * Y * Z) of `dtype`, and the numbers of the lattice: what look-ups take."""
    return sdf.values.detach().to(dtype).contiguous().view(-1), lattice_numbers(sdf)[0]
