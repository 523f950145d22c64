"""Unsigned distances and inside flags of lattice nodes about a mesh."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sdf.lattice import Lattice
from sdf.mesh.repair import Repaired
from sdf.mesh.triangles import Triangles, nearest, winding_number

Progress = Callable[[str, float], None]
"""Called with what is being done and how much of it is done, from 0 to 1."""

# nodes at once; each takes some 100 bytes meanwhile
_CHUNK = 1 << 19
_COARSE = 4


def unsigned_distances(
    lattice: Lattice, surface: Triangles, band: float | None = None, progress: Progress | None = None
) -> np.ndarray:
    """Distance of every node from a surface, metres, float32 (X, Y, Z).

    Args:
        lattice: where the nodes are.
        surface: what they are distances from.
        band: metres; nodes beyond may have values interpolated between every fourth node along each axis (and every
            one in the wide cells), which are exact. None for exact ones everywhere.
        progress: called with what is being done and how much of it is done, from 0 to 1.
    """
    axes = [axis.numpy() for axis in lattice.axes]
    result = np.empty([len(axis) for axis in axes], dtype=np.float32)
    if band is None:
        _exact(axes, surface, result, None, progress)
        return result
    picks = [_coarse(len(axis), lattice.outer) for axis in axes]
    rough = np.empty([len(pick) for pick in picks], dtype=np.float32)
    wide = [axis[pick] for axis, pick in zip(axes, picks, strict=True)]
    _exact(wide, surface, rough, None, None)
    near = _near_cells(wide, rough, band)
    weights = [_weights(axis, part) for axis, part in zip(axes, wide, strict=True)]
    for i in range(len(axes[0])):
        low, share = weights[0][0][i], weights[0][1][i]
        plane = (1.0 - share) * rough[low] + share * rough[low + 1]
        for axis in (1, 2):
            below, part = weights[axis]
            part = part[:, None] if axis == 1 else part
            plane = (1.0 - part) * plane.take(below, axis - 1) + part * plane.take(below + 1, axis - 1)
        result[i] = plane
    # a node that two cells share is near if one of them is
    masks = [_cells_of(len(axis), pick) for axis, pick in zip(axes, picks, strict=True)]
    _exact(axes, surface, result, (near, masks), progress)
    return result


def inside_nodes(
    lattice: Lattice,
    repair: Repaired,
    bounds: Float[Tensor, "2 3"],
    distance: np.ndarray,
    progress: Progress | None = None,
) -> np.ndarray:
    """Which nodes (X, Y, Z) are inside: where the mesh winds more than half about them.

    None is inside beyond the mesh's bounds. Winding numbers of a closed mesh are whole, and the same throughout a
    region that no face passes through: there one node of each region of nodes further than half a spacing from the
    surface is asked about, and each of the rest.

    Args:
        lattice: where the nodes are.
        repair: the mesh.
        bounds: (2, 3), metres, of the mesh.
        distance: (X, Y, Z), metres, of the nodes from its surface.
        progress: called with what is being done and how much of it is done, from 0 to 1.
    """
    from scipy import ndimage

    inside = np.zeros(distance.shape, dtype=bool)
    axes = [axis.numpy() for axis in lattice.axes]
    low, high = bounds.double().numpy()
    window = tuple(
        slice(int(np.searchsorted(axis, a)), int(np.searchsorted(axis, b, "right")))
        for axis, a, b in zip(axes, low, high, strict=True)
    )
    axes = [axis[part] for axis, part in zip(axes, window, strict=True)]
    if not repair.closed:
        inside[window] = _wound(axes, np.arange(inside[window].size), repair, progress).reshape(inside[window].shape)
        return inside
    # two neighbours that far from the surface have none between them
    clear = distance[window] > 0.5 * lattice.spacing * (1.0 + 1e-4) + repair.detail
    region, count = ndimage.label(clear)
    part = np.zeros(clear.shape, dtype=bool)
    if count:
        deepest = ndimage.maximum_position(distance[window], region, np.arange(1, count + 1))
        heads = np.ravel_multi_index(np.array(deepest).T, clear.shape)
        part = np.concatenate(([False], _wound(axes, heads, repair, None)))[region]
    rest = np.flatnonzero(~clear)
    part.reshape(-1)[rest] = _wound(axes, rest, repair, progress)
    inside[window] = part
    return inside


def _wound(axes: list[np.ndarray], which: np.ndarray, repair: Repaired, progress: Progress | None) -> np.ndarray:
    """Whether the mesh winds more than half about nodes, given by their numbers."""
    shape = [len(axis) for axis in axes]
    result = np.empty(len(which), dtype=bool)
    for start in range(0, len(which), _CHUNK):
        index = np.unravel_index(which[start : start + _CHUNK], shape)
        points = torch.from_numpy(np.stack([axis[i] for axis, i in zip(axes, index, strict=True)], -1))
        result[start : start + _CHUNK] = (winding_number(points, repair.windings) > 0.5).numpy()
        if progress is not None:
            progress("sign", min(start + _CHUNK, len(which)) / len(which))
    return result


def _exact(
    axes: list[np.ndarray],
    surface: Triangles,
    result: np.ndarray,
    cells: tuple[np.ndarray, list[np.ndarray]] | None,
    progress: Progress | None,
) -> None:
    """Fill in distances of all nodes, or of those in some cells, a few layers at a time."""
    layer = result[0].size
    step = max(1, _CHUNK // layer)
    for start in range(0, len(axes[0]), step):
        rows = slice(start, min(start + step, len(axes[0])))
        points = np.empty((rows.stop - start, *result.shape[1:], 3))
        points[..., 0] = axes[0][rows, None, None]
        points[..., 1] = axes[1][:, None]
        points[..., 2] = axes[2]
        asked = points.reshape(-1, 3)
        chosen = None
        if cells is not None:
            near, masks = cells
            # each node's cells below and above, along each axis
            some = np.zeros(points.shape[:-1], dtype=bool)
            for x in masks[0][:, rows]:
                for y in masks[1]:
                    for z in masks[2]:
                        some |= near[np.ix_(x, y, z)]
            chosen = some.reshape(-1)
            asked = asked[chosen]
        places = torch.from_numpy(asked)
        gap = (nearest(places, surface).point - places).norm(dim=-1).numpy()
        flat = result[rows].reshape(-1)
        if chosen is None:
            flat[:] = gap
        else:
            flat[chosen] = gap
        if progress is not None:
            progress("distance", rows.stop / len(axes[0]))


def _coarse(count: int, outer: int) -> np.ndarray:
    """Every fourth node of the fine part, its last, and all wide ones."""
    last = count - 1 - outer
    return np.unique(np.concatenate((np.arange(outer), np.arange(outer, last, _COARSE), np.arange(last, count))))


def _near_cells(axes: list[np.ndarray], values: np.ndarray, band: float) -> np.ndarray:
    """Cells that may hold a point nearer than the band: distances change no faster than places."""
    least = values
    for axis in range(3):
        front, back = np.moveaxis(least, axis, 0)[:-1], np.moveaxis(least, axis, 0)[1:]
        least = np.moveaxis(np.minimum(front, back), 0, axis)
    x, y, z = (np.diff(axis) for axis in axes)
    reach = np.sqrt((x**2)[:, None, None] + (y**2)[:, None] + z**2)
    return least <= band + reach


def _weights(axis: np.ndarray, coarse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coarse node below each node, and how far it is to the next."""
    below = np.clip(np.searchsorted(coarse, axis, "right") - 1, 0, len(coarse) - 2)
    return below, ((axis - coarse[below]) / (coarse[below + 1] - coarse[below])).astype(np.float32)


def _cells_of(count: int, pick: np.ndarray) -> np.ndarray:
    """(2, count): the coarse cells that end and that begin at each node, the same one within."""
    nodes = np.arange(count)
    above = np.clip(np.searchsorted(pick, nodes, "right") - 1, 0, len(pick) - 2)
    below = np.clip(np.searchsorted(pick, nodes, "left") - 1, 0, len(pick) - 2)
    return np.stack((below, above))
