"""Two-level bounding volumes of an observation's free and occupied points, as arrays for the compiled kernels.

A free point costs nothing where its signed distance is above the tolerance. In a ball of radius r no distance is less
than that of its centre by more than r times the steepness of the table, so one look-up may settle all points of a ball:
the result is the same, and most free points are never looked up.
"""

import weakref
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sdf.grid_sdf import GridSDF
from sensors.semantics import Semantics

# large boxes: this part of the object's radius; small ones have half their edge
_PART = 0.25


class Tiles(NamedTuple):
    """Points of B scenes as arrays; the last axes are as long as the observation, and filled as far as `counts` says.

    Attributes:
        surface: (B, 3, M).
        hinged: (B, 3, M), free and occupied points, box by box.
        signs: (B, M), 1 for free, -1 for occupied.
        small_first: (B, M + 1), where each small box begins among `hinged`.
        small_balls: (B, 5, M), centre, radius and sign of each.
        large_first, large_balls: the same of large boxes, among small ones.
        counts: (B, 4), numbers of surface points, hinged points, small and large boxes.
    """

    surface: np.ndarray
    hinged: np.ndarray
    signs: np.ndarray
    small_first: np.ndarray
    small_balls: np.ndarray
    large_first: np.ndarray
    large_balls: np.ndarray
    counts: np.ndarray


def tiles(points: Tensor, semantics: Tensor, valid: Tensor, radius: float) -> Tiles:
    """Arrays of the valid points (*b, M, 3) with semantics (*b, M), for an object of some radius (metres).

    Those of the last points are kept, since a filter step asks for the same ones up to three times.
    """
    global _last
    stamp = (*(_version(part) for part in (points, semantics, valid)), radius)
    last = _last
    if last is not None and last[0]() is points and last[1]() is semantics and last[2]() is valid and last[3] == stamp:
        return last[4]
    result = _sorted(points, semantics, valid, radius)
    _last = (weakref.ref(points, _forget), weakref.ref(semantics), weakref.ref(valid), stamp, result)
    return result


def _sorted(points: Tensor, semantics: Tensor, valid: Tensor, radius: float) -> Tiles:
    from sensors.tiles_numba import sort_points

    count, dtype = points.shape[-2], points.dtype
    flat = points.detach().reshape(-1, count, 3).contiguous()
    semantics = semantics.reshape(-1, count)
    kinds = torch.where(semantics == Semantics.FREE, 1, torch.where(semantics == Semantics.SURFACE, 2, -1))
    kinds = (kinds * valid.reshape(-1, count)).to(torch.int8)
    scenes = len(flat)

    def blank(*shape: int, kind: torch.dtype = dtype) -> np.ndarray:
        return torch.empty(scenes, *shape, dtype=kind).numpy()

    result = Tiles(
        blank(3, count),
        blank(3, count),
        blank(count),
        blank(count + 1, kind=torch.int32),
        blank(5, count),
        blank(count + 1, kind=torch.int32),
        blank(5, count),
        blank(4, kind=torch.int64),
    )
    sort_points(flat.numpy(), kinds.numpy(), 0.5 * _PART * max(radius, 1e-3), *result)
    return result


_Last = tuple["weakref.ref[Tensor]", "weakref.ref[Tensor]", "weakref.ref[Tensor]", tuple[int | float, ...], Tiles]
_last: _Last | None = None


def _forget(gone: "weakref.ref[Tensor]") -> None:
    """Let go of the arrays of points that are no more."""
    global _last
    if _last is not None and _last[0] is gone:
        _last = None


def _version(tensor: Tensor) -> int:
    return 0 if tensor.is_inference() else tensor._version


def steepness(sdf: GridSDF) -> float:
    """Greatest slope of a tabulated distance: no two points differ by more, a metre.

    Within the lattice, what its nodes allow any interpolant of them. Beyond it the slope is that along the faces and 1
    across them where the outermost values are no less than their distance from the object's bounds, as true distances
    are; else infinite: nothing can be said. Worked out once a table.
    """
    values = sdf.values.detach()
    stamp = (values.data_ptr(), _version(values), values.dtype)
    known = _KNOWN.get(sdf)
    if known is not None and known[0] == stamp:
        return known[1]
    square = 0.0
    for axis in range(3):
        rise = values.diff(dim=axis).abs().movedim(axis, 0)
        fine, wide = sdf.outer, len(rise) - sdf.outer
        slopes = [float(rise[fine:wide].max()) / sdf.spacing]
        if sdf.outer:
            slopes.append(max(float(rise[:fine].max()), float(rise[wide:].max())) / sdf.outer_spacing)
        square += max(*slopes, 1.01) ** 2
    result = square**0.5 if _true_at_its_faces(sdf) else float("inf")
    _KNOWN[sdf] = (stamp, result)
    return result


def _true_at_its_faces(sdf: GridSDF) -> bool:
    values, least = sdf.values.detach(), 0.999 * sdf.inset
    ends = [values[[0, -1]], values[:, [0, -1]], values[:, :, [0, -1]]]
    edges = [values[[0, -1]][:, [0, -1]], values[[0, -1]][:, :, [0, -1]], values[:, [0, -1]][:, :, [0, -1]]]
    corners = values[[0, -1]][:, [0, -1]][:, :, [0, -1]]
    levels = ((ends, 1.0), (edges, 2.0), ([corners], 3.0))
    return all(float(part.min()) >= least * number**0.5 for parts, number in levels for part in parts)


_KNOWN: weakref.WeakKeyDictionary[GridSDF, tuple[tuple[int, int, torch.dtype], float]] = weakref.WeakKeyDictionary()
