"""Consistent orientation of a mesh: faces agree with their neighbours, parts with what is about them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from sdf.mesh.triangles import Triangles, winding_number

_SAMPLES = 5
# of the area to the power of 3/2: a part of less volume is flat
_FLAT = 1e-6
# of the area: what closing a part would take at least, in parts that are not taken for bodies of their own
_OPEN = 0.3


@dataclass(frozen=True)
class Orientation:
    """Statistics of the orientation of a mesh's faces.

    Attributes:
        parts: number of parts, of faces joined by edges that two of them share.
        turned_faces: faces that disagreed with most of their part.
        turned_parts: parts turned as a whole.
        cavities: parts that bound a hollow inside of another.
        one_sided: parts that have no two sides (as a Moebius band).
    """

    parts: int
    turned_faces: int
    turned_parts: int
    cavities: int
    one_sided: int


class EdgeTable(NamedTuple):
    """All edges of some faces.

    Attributes:
        which: (3 F,), number of the undirected edge that each face's edge is; edge k of face f is entry 3 f + k.
        forward: (3 F,), 1 where the face goes along it from the lower vertex to the higher, else -1.
        ends: (E, 2), its vertices, the lower first.
    """

    which: np.ndarray
    forward: np.ndarray
    ends: np.ndarray


def edge_table(faces: np.ndarray) -> EdgeTable:
    """Number the edges of faces (F, 3); edge k goes from corner k to corner k + 1."""
    start, end = faces.reshape(-1), np.roll(faces, -1, 1).reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    most = int(faces.max()) + 1
    keys, which = np.unique(low * most + high, return_inverse=True)
    return EdgeTable(which.reshape(-1), np.where(start < end, 1, -1), np.stack((keys // most, keys % most), -1))


def oriented(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, Orientation]:
    """Faces turned so that all parts have their outside out, and what that took.

    Args:
        vertices: (V, 3), metres.
        faces: (F, 3), each with three different corners.
    """
    part, flip, one_sided = _agreement(faces)
    parts = int(part.max()) + 1
    corners = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    # of the two ways a part can be made to agree, the one that turns the lesser area
    turn_area = np.bincount(part, area * flip, parts)
    total_area = np.bincount(part, area, parts)
    flip = flip ^ (turn_area > 0.5 * total_area)[part]
    flip[np.isin(part, one_sided)] = False
    result = np.where(flip[:, None], faces[:, ::-1], faces)
    turned, cavities = _outward(vertices, result, area, part, parts)
    result = np.where(turned[part][:, None], result[:, ::-1], result)
    return result, Orientation(parts, int(flip.sum()), int(turned.sum()), cavities, len(one_sided))


def _agreement(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Part of each face, whether it disagrees with the first of its part, and the parts where all fails.

    Two faces at an edge agree if they go along it in opposite directions. In the double cover, where every face
    stands once as it is and once turned, a part that can be made to agree falls into two.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(faces)
    edges = edge_table(faces)
    order = np.argsort(edges.which, kind="stable")
    shared = np.bincount(edges.which)
    first = np.concatenate(([0], np.cumsum(shared)[:-1]))[shared == 2]
    a, b = order[first], order[first + 1]
    agree = edges.forward[a] != edges.forward[b]
    fa, fb = a // 3, b // 3
    graph = coo_matrix((np.ones(len(fa), np.int8), (fa, fb)), (count, count))
    parts, part = connected_components(graph, directed=False)
    rows = np.concatenate((fa, fa + count))
    columns = np.concatenate((np.where(agree, fb, fb + count), np.where(agree, fb + count, fb)))
    cover = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), (2 * count, 2 * count))
    _, label = connected_components(cover, directed=False)
    as_it_is, turned = label[:count], label[count:]
    one_sided = np.unique(part[as_it_is == turned])
    # the copy of the part's first face tells which copy of it the others are in
    lead = np.full(parts, -1)
    lead[part[::-1]] = as_it_is[::-1]
    return part, as_it_is != lead[part], one_sided


def _outward(
    vertices: np.ndarray, faces: np.ndarray, area: np.ndarray, part: np.ndarray, parts: int
) -> tuple[np.ndarray, int]:
    """Which parts to turn, and how many are cavities.

    A part that encloses less than nothing is inside out, or it bounds a hollow: then the parts that enclose something
    wind about it.
    """
    corners = vertices[faces]
    middle = np.stack([np.bincount(part, corners[..., k].mean(1), parts) for k in range(3)], -1)
    a, b, c = np.moveaxis(corners - (middle / np.bincount(part)[:, None])[part][:, None], 1, 0)
    share = (a * np.cross(b, c)).sum(-1)
    volume = np.bincount(part, share, parts) / 6.0
    # of a piece that is open or flat, its volume says nothing: it may be a dent of a larger surface
    total = np.bincount(part, area, parts)
    cross = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    gape = np.linalg.norm(np.stack([np.bincount(part, cross[:, k], parts) for k in range(3)], -1), axis=1)
    solid = (np.abs(volume) > _FLAT * total**1.5) & (gape < _OPEN * total)
    whole = corners.reshape(-1, 3) - corners.reshape(-1, 3).mean(0)
    x, y, z = whole.reshape(-1, 3, 3).transpose(1, 0, 2)
    inside_out = float((x * np.cross(y, z)).sum()) < 0
    sign = -1.0 if inside_out else 1.0
    turned = np.full(parts, inside_out)
    suspects = np.flatnonzero(solid & (sign * volume < 0))
    if len(suspects) == 0:
        return turned, 0
    holders = ~np.isin(part, suspects)
    hollow = np.zeros(len(suspects), dtype=bool)
    if holders.any():
        triangles = Triangles(torch.from_numpy(corners[holders]))
        order = np.argsort(part, kind="stable")
        starts = np.searchsorted(part[order], np.arange(parts))
        sizes = np.bincount(part, minlength=parts)
        places = np.linspace(0, sizes[suspects] - 1, _SAMPLES).astype(int).T  # some faces of each
        middle = corners[order[starts[suspects][:, None] + places]].mean(2)
        around = winding_number(torch.from_numpy(middle), triangles).numpy()
        hollow = (sign * around > 0.5).mean(1) > 0.5
    turned[suspects[~hollow]] ^= True
    return turned, int(hollow.sum())
