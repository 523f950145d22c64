"""Faces that lie inside of other parts of a mesh, and so are no surface."""

import numpy as np
import torch

from sdf.tree import split_long
from sdf.triangles import Triangles, area_vectors, winding_number

# of the diagonal: how far in front of a face its outside is asked about, and how long pieces are at most that are
# looked at whole, and that are asked about at their middle alone
_STEP, _COARSE, _FINE = 1e-5, 1.0 / 32.0, 1.0 / 400.0
# the surface winds so often about what is inside of another part; more than a half, for the sake of open surfaces
_INSIDE = 0.75
_SAMPLES = 20_000
_NOTHING = 1e-4
_CORNERS = np.array([[0.98, 0.01, 0.01], [0.01, 0.98, 0.01], [0.01, 0.01, 0.98], [1 / 3, 1 / 3, 1 / 3]])
_SIDES = np.array([[0.495, 0.495, 0.01], [0.01, 0.495, 0.495], [0.495, 0.01, 0.495]])
_PLACES = np.concatenate((_CORNERS, _SIDES))


def outer_surface(triangles: Triangles) -> tuple[Triangles, float, float]:
    """The triangles in front of which is outside: where parts overlap, the distance to the others says nothing.

    Triangles that are partly inside of another part are split, down to 1/400 of the diagonal; those pieces count as
    their middles do. Where less than 1/10000 of the area is inside (a crease that crosses itself), by places on many
    triangles evenly chosen, all stay as they are.

    Returns:
        what is left; the share of the area that is not; and the length of the smallest pieces, metres, 0 if there
        was nothing to split.
    """
    corners = triangles.corners.double().cpu().numpy()
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    some = corners[:: max(1, len(corners) // _SAMPLES)]
    inside = _hidden(some, _PLACES, triangles, diagonal).mean(1)
    if float((inside * _areas(some)).sum()) <= _NOTHING * _area(some):
        return triangles, 0.0, 0.0
    pieces, _ = split_long(corners, _COARSE * diagonal)
    kept, dropped = [], 0.0
    while len(pieces):
        small = _longest(pieces) <= _FINE * diagonal
        tiny = pieces[small]
        inside = _hidden(tiny, _PLACES[3:4], triangles, diagonal)[:, 0]
        kept.append(tiny[~inside])
        dropped += _area(tiny[inside])
        pieces = pieces[~small]
        inside = _hidden(pieces, _PLACES, triangles, diagonal)
        kept.append(pieces[~inside.any(1)])
        dropped += _area(pieces[inside.all(1)])
        pieces = pieces[inside.any(1) & ~inside.all(1)]
        if len(pieces):
            pieces, _ = split_long(pieces, 0.6 * float(_longest(pieces).max()))
    left = np.concatenate(kept)
    if len(left) == 0:  # no sign tells one side of such a surface from the other
        return triangles, 1.0, 0.0
    return Triangles(torch.from_numpy(left)), dropped / _area(corners), _FINE * diagonal


def _hidden(pieces: np.ndarray, places: np.ndarray, triangles: Triangles, diagonal: float) -> np.ndarray:
    """Whether it is inside just in front of each piece at each place: (P, K)."""
    if len(pieces) == 0:
        return np.zeros((0, len(places)), dtype=bool)
    normal = torch.nn.functional.normalize(area_vectors(torch.from_numpy(pieces)), dim=-1, eps=1e-300).numpy()
    points = np.einsum("kc,fcd->fkd", places, pieces) + _STEP * diagonal * normal[:, None]
    return (winding_number(torch.from_numpy(points), triangles) > _INSIDE).numpy()


def _longest(pieces: np.ndarray) -> np.ndarray:
    return np.sqrt(((np.roll(pieces, -1, 1) - pieces) ** 2).sum(-1).max(1))


def _areas(pieces: np.ndarray) -> np.ndarray:
    return np.asarray(area_vectors(torch.from_numpy(pieces)).norm(dim=-1))


def _area(pieces: np.ndarray) -> float:
    return float(_areas(pieces).sum())
