"""Boundary loops of an open mesh, and triangle fans that close them."""

from dataclasses import dataclass

import numpy as np
import torch

from sdf.mesh.orientation import edge_table
from sdf.mesh.triangles import Triangles, nearest, winding_number

# a fan closes an opening where the surface winds so much about its triangles, that is, where it has two sides to part
_LEAST, _MOST = 0.1, 0.9
# of the opening's width: a fan that lies on the surface closes nothing, the surface was in pieces
_CLEAR = 1e-3
_MOST_EDGES = 300_000


@dataclass(frozen=True)
class Opening:
    """A ring of edges that one face only has.

    Attributes:
        edges: number of edges.
        width: diagonal of its bounding box, metres.
        closed: whether a fan closes it.
    """

    edges: int
    width: float
    closed: bool


@dataclass(frozen=True)
class Closed:
    """A mesh with its openings closed.

    Attributes:
        vertices: (V, 3), metres; the fans' middles last.
        faces: (F, 3), the fans last.
        closed: whether no edge is open.
        openings: all of them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    closed: bool
    openings: tuple[Opening, ...]


def close_openings(vertices: np.ndarray, faces: np.ndarray) -> Closed:
    """Close each ring of open edges by a fan about its middle.

    Whatever the ring's form, ring and fan fit together along every edge, each as often as the faces leave it open: the
    fan of a closed way has no other border. It need not be flat, nor free of overlaps, for the winding number to be
    whole then. What a fan would have to cut through faces for, or to lie upon them, stays open.

    Args:
        vertices: (V, 3), metres.
        faces: (F, 3), each with three different corners, neighbours agreeing on which side is out.
    """
    rings = open_rings(faces)
    if rings is None:
        width = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        return Closed(vertices, faces, False, (Opening(_MOST_EDGES, width, False),))
    if not rings:
        return Closed(vertices, faces, True, ())
    fans, middles, owner = [], [], []
    for number, ring in enumerate(rings):
        apex = len(vertices) + number
        middles.append(vertices[ring].mean(0))
        following = np.roll(ring, -1)
        if len(ring) == 3:  # a face that is missing is put back
            fans.append(np.stack((ring[::-1],)))
        elif len(ring) > 3:
            fans.append(np.stack((following, ring, np.full(len(ring), apex)), -1))
        owner.append(np.full(len(fans[-1]), number))
    every = np.concatenate((vertices, np.stack(middles)))
    patches, of = np.concatenate(fans), np.concatenate(owner)
    low = np.stack([vertices[ring].min(0) for ring in rings])
    width = np.linalg.norm(np.stack([vertices[ring].max(0) for ring in rings]) - low, axis=1)
    good = _parting(every[patches], of, width, vertices[faces])
    kept = patches[good[of]]
    openings = tuple(
        Opening(len(ring), float(size), bool(ok)) for ring, size, ok in zip(rings, width, good, strict=True)
    )
    return Closed(every, np.concatenate((faces, kept)), bool(good.all()), openings)


def open_rings(faces: np.ndarray) -> list[np.ndarray] | None:
    """Closed ways along the edges that faces leave open, in the direction that the faces go along them.

    None if there are more open edges than a surface has: these are loose triangles.
    """
    edges = edge_table(faces)
    net = np.bincount(edges.which, edges.forward).astype(np.int64)
    count = np.abs(net)
    which = np.repeat(np.arange(len(net)), count)
    if len(which) > _MOST_EDGES:
        return None
    if len(which) == 0:
        return []
    ahead = net[which] > 0
    start = np.where(ahead, edges.ends[which, 0], edges.ends[which, 1])
    end = np.where(ahead, edges.ends[which, 1], edges.ends[which, 0])
    onward: dict[int, list[int]] = {}
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        onward.setdefault(a, []).append(b)
    rings = []
    # at every vertex as many open edges begin as end, so that a way never gets stuck; where it meets itself,
    # a ring is done
    for begin in list(onward):
        while onward[begin]:
            way, place = [begin], {begin: 0}
            while True:
                vertex = onward[way[-1]].pop()
                if vertex in place:
                    rings.append(np.array(way[place[vertex] :]))
                    for left in way[place[vertex] + 1 :]:
                        del place[left]
                    del way[place[vertex] + 1 :]
                    if vertex == begin and not onward[begin]:
                        break
                    if len(way) == 1 and not onward[way[0]]:
                        break
                else:
                    place[vertex] = len(way)
                    way.append(vertex)
    return rings


def _parting(patches: np.ndarray, of: np.ndarray, width: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Whether each opening's fan parts inside from outside: most of its area is neither, and clear of the faces."""
    surface = Triangles(torch.from_numpy(corners))
    middle = torch.from_numpy(patches.mean(1))
    around = winding_number(middle, surface).numpy() % 1.0  # within another part it is one more
    gap = (nearest(middle, surface).point - middle).norm(dim=-1).numpy()
    area = np.linalg.norm(np.cross(patches[:, 1] - patches[:, 0], patches[:, 2] - patches[:, 0]), axis=1)
    fit = (around > _LEAST) & (around < _MOST) & (gap > _CLEAR * width[of])
    total = np.bincount(of, area, len(width))
    parts = np.bincount(of, area * fit, len(width)) > 0.5 * total
    return parts | (total == 0)
