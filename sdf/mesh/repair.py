"""Mesh repair, as far as signed distances need: oriented outward, holes closed, interior faces left out."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sdf.mesh.mesh import MeshError, TriangleMesh
from sdf.mesh.openings import Opening, close_openings
from sdf.mesh.orientation import Orientation, oriented
from sdf.mesh.overlap import outer_surface
from sdf.mesh.triangles import Triangles, area_vectors

# of the area times the diagonal: a mesh of less volume than this is a sheet
_FLAT = 1e-6


@dataclass(frozen=True)
class Repaired:
    """Repaired mesh, with the defects that were found.

    Attributes:
        solid: all faces, oriented outward, and those that close openings.
        windings: what the winding number is taken of: the same without faces that have no area.
        surface: what distance is measured to: the same without what lies inside of other parts.
        closed: whether the faces of `solid` leave no edge open, so that winding numbers are whole.
        duplicates: faces that were there before.
        degenerate: faces without area.
        orientation: parts and faces turned.
        openings: each opening, closed or not.
        hidden_share: share of the area that lies inside of other parts.
        detail: metres to which the surface is cut where parts meet; 0 where none do.
        volume: enclosed, cubic metres; overlaps count as often as they wind.
    """

    solid: TriangleMesh
    windings: Triangles
    surface: Triangles
    closed: bool
    duplicates: int
    degenerate: int
    orientation: Orientation
    openings: tuple[Opening, ...]
    hidden_share: float
    detail: float
    volume: float


def repaired(mesh: TriangleMesh) -> Repaired:
    """Put a mesh right.

    Doubled faces go, since they would count twice. Faces that share an edge are made to agree on which side is out,
    each part by its fewest faces; a part whose volume is then negative is turned, unless it is a cavity. Openings are
    closed by a fan where that cuts through empty space. Faces inside of other parts are no surface.

    Raises:
        MeshError: if no volume is enclosed.
    """
    faces, duplicates = _distinct(mesh.faces.numpy())
    vertices = mesh.vertices.numpy()
    if len(faces) == 0:
        raise MeshError("Expected faces with three different corners, got none: every face is a point or a line")
    turned, orientation = oriented(vertices, faces)
    whole = close_openings(vertices, turned)
    solid = TriangleMesh(torch.from_numpy(whole.vertices), torch.from_numpy(whole.faces))
    corners = solid.corners
    size = area_vectors(corners).norm(dim=-1)
    volume = enclosed_volume(corners)
    if not volume > _FLAT * float(size.sum()) * mesh.diagonal:
        raise MeshError(
            f"Expected a mesh that encloses a volume, got {1e9 * volume:.3g} mm^3 within a box of diagonal "
            f"{1e3 * mesh.diagonal:.3g} mm: is it a sheet, or are its parts turned inside out?"
        )
    solids = Triangles(corners[size > 0])
    surface, hidden, detail = outer_surface(solids)
    return Repaired(
        solid,
        solids,
        surface,
        whole.closed,
        duplicates,
        int((size == 0).sum()) + len(mesh.faces) - len(faces) - duplicates,
        orientation,
        whole.openings,
        hidden,
        detail,
        volume,
    )


def enclosed_volume(corners: Float[Tensor, "F 3 3"]) -> float:
    """Volume that oriented triangles enclose, cubic metres; of an open surface, with lids towards its middle."""
    a, b, c = (corners - corners.mean((0, 1))).unbind(-2)
    return float((a * torch.linalg.cross(b, c)).sum() / 6.0)


class _Distinct(NamedTuple):
    faces: np.ndarray
    duplicates: int


def _distinct(faces: np.ndarray) -> _Distinct:
    """Faces with three corners, each once, and how many were there again."""
    real = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    if len(real) == 0:
        return _Distinct(real, 0)
    order = np.sort(real, axis=1)
    by = np.lexsort(order.T)
    again = np.zeros(len(real), dtype=bool)
    again[by[1:]] = (order[by[1:]] == order[by[:-1]]).all(1)  # the sort is stable: the first stays
    return _Distinct(real[~again], int(again.sum()))
