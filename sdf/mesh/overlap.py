"""Interior faces of a mesh: faces inside of other parts, which are no part of the surface."""

import numpy as np
import torch

from sdf.mesh.tree import split_long
from sdf.mesh.triangles import Triangles, area_vectors, winding_number

# of the diagonal: how far in front of a face its outside is asked about, and how long pieces are at most that are
# looked at whole, and that are asked about at their middle alone
_STEP, _COARSE, _FINE = 1e-5, 1.0 / 32.0, 1.0 / 400.0
# the surface winds so often about what is inside of another part; more than a half, for the sake of open surfaces
_INSIDE = 0.75
_ACCURACY = 2.0
_SAMPLES, _FEW = 20_000, 2000
_NOTHING = 1e-4
_CORNERS = np.array([[0.98, 0.01, 0.01], [0.01, 0.98, 0.01], [0.01, 0.01, 0.98], [1 / 3, 1 / 3, 1 / 3]])
_SIDES = np.array([[0.495, 0.495, 0.01], [0.01, 0.495, 0.495], [0.495, 0.01, 0.495]])
_PLACES, _MIDDLE = np.concatenate((_CORNERS, _SIDES)), _CORNERS[3:]


def outer_surface(triangles: Triangles) -> tuple[Triangles, float, float]:
    """The triangles in front of which is outside: where parts overlap, the distance to the others says nothing.

    Triangles are split to 1/32 of the diagonal, and where some pieces are inside and others near them are not, further
    down to 1/400; such a piece counts as its middle does. Where less than 1/10000 of the area is inside (a crease that
    crosses itself), by places on many triangles evenly chosen, all stay as they are.

    Returns:
        what is left; the share of the area that is not; and the length of the smallest pieces, metres, 0 if there
        was nothing to split.
    """
    corners = triangles.corners.double().cpu().numpy()
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    some = corners[:: max(1, len(corners) // _SAMPLES)]
    inside = _hidden(some, _PLACES if len(some) < _FEW else _MIDDLE, triangles, diagonal).mean(1)
    if float((inside * _areas(some)).sum()) <= _NOTHING * _area(some):
        return triangles, 0.0, 0.0
    pieces, owner = split_long(corners, _COARSE * diagonal)
    inside = _hidden(pieces, _MIDDLE, triangles, diagonal)[:, 0]
    mixed = _near_both(pieces, inside, 1.5 * _COARSE * diagonal)
    # pieces outside and inside, and the triangles that they are of
    out = [(pieces[~inside & ~mixed], owner[~inside & ~mixed])]
    gone = [(pieces[inside & ~mixed], owner[inside & ~mixed])]
    pieces, owner = pieces[mixed], owner[mixed]
    while len(pieces):
        small = _longest(pieces) <= _FINE * diagonal
        share = np.zeros(len(pieces))
        share[small] = _hidden(pieces[small], _MIDDLE, triangles, diagonal).mean(1)
        share[~small] = _hidden(pieces[~small], _PLACES, triangles, diagonal).mean(1)
        out.append((pieces[share == 0], owner[share == 0]))
        gone.append((pieces[share == 1], owner[share == 1]))
        cut = (share > 0) & (share < 1)
        pieces, owner = pieces[cut], owner[cut]
        if len(pieces):
            pieces, part = split_long(pieces, 0.6 * float(_longest(pieces).max()))
            owner = owner[part]
    pieces, owner = (np.concatenate(parts) for parts in zip(*out, strict=True))
    if len(pieces) == 0:  # no sign tells one side of such a surface from the other
        return triangles, 1.0, 0.0
    lost, of = (np.concatenate(parts) for parts in zip(*gone, strict=True))
    touched = np.zeros(len(corners), dtype=bool)
    touched[of] = True
    left = np.concatenate((corners[~touched], pieces[touched[owner]]))
    return Triangles(torch.from_numpy(left)), _area(lost) / _area(corners), _FINE * diagonal


def _near_both(pieces: np.ndarray, inside: np.ndarray, reach: float) -> np.ndarray:
    """Which pieces have one of the other kind near."""
    from scipy.spatial import cKDTree

    middle = pieces.mean(1)
    result = np.zeros(len(pieces), dtype=bool)
    if inside.any() and not inside.all():
        for kind in (False, True):
            gap, _ = cKDTree(middle[inside != kind]).query(middle[inside == kind], distance_upper_bound=reach)
            result[inside == kind] = np.isfinite(gap)
    return result


def _hidden(pieces: np.ndarray, places: np.ndarray, triangles: Triangles, diagonal: float) -> np.ndarray:
    """Whether it is inside just in front of each piece at each place: (P, K)."""
    if len(pieces) == 0:
        return np.zeros((0, len(places)), dtype=bool)
    normal = torch.nn.functional.normalize(area_vectors(torch.from_numpy(pieces)), dim=-1, eps=1e-300).numpy()
    points = np.einsum("kc,fcd->fkd", places, pieces) + _STEP * diagonal * normal[:, None]
    return (winding_number(torch.from_numpy(points), triangles, accuracy=_ACCURACY) > _INSIDE).numpy()


def _longest(pieces: np.ndarray) -> np.ndarray:
    return np.sqrt(((np.roll(pieces, -1, 1) - pieces) ** 2).sum(-1).max(1))


def _areas(pieces: np.ndarray) -> np.ndarray:
    return np.asarray(area_vectors(torch.from_numpy(pieces)).norm(dim=-1))


def _area(pieces: np.ndarray) -> float:
    return float(_areas(pieces).sum())
