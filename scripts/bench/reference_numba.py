"""The exact discrepancy of an upright mug, fused for the CPU; `reference.py` has the definition."""

import math

import numba

from sdf.compiled import Kernel
from sdf.part_numba import indices


@numba.njit(error_model="numpy")
def _rectangle(a, b):
    """Signed distance to a rectangle from how far two coordinates are beyond its edges."""
    outside = math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2)
    return outside + min(max(a, b), 0.0)


@numba.njit(error_model="numpy")
def _mug(x, y, z, mug):
    """Signed distance of a point from a mug: the least of its cup's and its handle's."""
    outer, height, wall, base, tube, ring, half_angle = mug
    r = math.sqrt(x * x + y * y)
    full_r, full_z = r - outer, abs(z - 0.5 * height) - 0.5 * height
    inside = max(_rectangle(full_r, full_z), -_rectangle(r - outer + wall, base - z))
    cup = inside
    if inside >= 0.0:
        side = _rectangle(abs(r - outer + 0.5 * wall) - 0.5 * wall, full_z)
        cup = min(side, _rectangle(full_r, abs(z - 0.5 * base) - 0.5 * base))
    u, w = x - outer, abs(z - 0.5 * height)
    far = math.sqrt(u * u + y * y + w * w) - ring - tube
    if far > cup:
        return cup  # no part of the handle is nearer
    if math.atan2(w, u) > half_angle:
        du, dw = u - ring * math.cos(half_angle), w - ring * math.sin(half_angle)
        handle = math.sqrt(du * du + y * y + dw * dw)
    else:
        off = math.sqrt(u * u + w * w) - ring
        handle = math.sqrt(off * off + y * y)
    return min(cup, handle - tube)


def _mug_totals(planar, surface, hinged, sign, free_scale, tolerance, mug, totals, part):
    for g in indices(part, len(planar)):
        cos, sin = math.cos(planar[g, 2]), math.sin(planar[g, 2])
        total = 0.0
        for m in range(len(surface)):
            dx, dy = surface[m, 0] - planar[g, 0], surface[m, 1] - planar[g, 1]
            total += abs(_mug(cos * dx + sin * dy, cos * dy - sin * dx, surface[m, 2], mug))
        for m in range(len(hinged)):
            dx, dy = hinged[m, 0] - planar[g, 0], hinged[m, 1] - planar[g, 1]
            distance = _mug(cos * dx + sin * dy, cos * dy - sin * dx, hinged[m, 2], mug)
            total += free_scale * max(-tolerance - sign[m] * distance, 0.0)
        totals[g] = total


mug_totals = Kernel(_mug_totals)
