"""Mesh for registration from contacts: triangles, a tree of them, and its symmetries."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf import se3
from sdf.mesh.build import from_mesh
from sdf.mesh.find_symmetry import find_symmetries
from sdf.mesh.mesh import MeshError, TriangleMesh, check_size, load_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.mesh.triangles import Triangles, area_vectors, nearest
from sdf.surface import sample_triangles
from sdf.symmetry import Symmetries

_CELLS = 40  # along the longest side of the table
_MARGIN = 0.25  # of the diagonal, that the table goes beyond the mesh
_LOOKED_AT, _NODES = 1500, 100  # points by which symmetries are found, and nodes along the diagonal
_TOLERANCE = 0.01  # of the diagonal, to which symmetries hold


@dataclass(frozen=True, eq=False)
class TouchSurface:
    """Surface of a mesh for contacts, in a frame whose origin is the middle of the mesh's box.

    Attributes:
        middle_o: (3,), that origin in the mesh's own frame, metres.
        diagonal: of the mesh's box, metres.
        triangles: facing outward; of a mesh that encloses no volume as they came.
        low: (3,), the first cell's corner, metres.
        step: edge of a cell, metres.
        cells: (X, Y, Z), a piece of the triangles' tree that is nearest to each cell's middle; further out its last
            cells count.
        symmetries: rotations about a point, in the mesh's own frame.
    """

    middle_o: Float[Tensor, "3"]
    diagonal: float
    triangles: Triangles
    low: Float[Tensor, "3"]
    step: float
    cells: Int[Tensor, "X Y Z"]
    symmetries: Symmetries

    @classmethod
    def of(
        cls, source: "TouchSurface | MeshSDF | TriangleMesh | str | Path", symmetries: Symmetries | None = None
    ) -> "TouchSurface":
        """What a mesh is; what is one already stays.

        Args:
            source: a file, a mesh in metres, or its SDF.
            symmetries: in the mesh's own frame; found on the surface by default, to 1 % of the diagonal.

        Raises:
            sdf.mesh.mesh.MeshError: no mesh, one without faces that have an area, or one of a size that no object
                in metres has.
        """
        if isinstance(source, TouchSurface):
            return source
        exact, corners, bounds = _solid(source)
        middle, diagonal = bounds.mean(0), float((bounds[1] - bounds[0]).norm())
        triangles = Triangles(corners - middle)
        pad = _MARGIN * diagonal
        low, high = bounds[0] - middle - pad, bounds[1] - middle + pad
        step = float((high - low).max()) / _CELLS
        counts = ((high - low) / step).ceil().long()
        axes = [low[k] + step * (torch.arange(int(counts[k]), dtype=torch.float64) + 0.5) for k in range(3)]
        cells = _nearest_pieces(torch.cartesian_prod(*axes), triangles).reshape(*counts.tolist())
        if symmetries is None:
            symmetries = Symmetries.none() if exact is None else _found(exact)
        return cls(middle, diagonal, triangles, low, step, cells, symmetries.to(torch.float64))

    def centred(self, world_T_object: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
        """Poses of the frame in the middle, given those of the mesh's own."""
        return world_T_object @ self._object_T_middle(self.middle_o).to(world_T_object)

    def uncentred(self, world_T_middle: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
        """Poses of the mesh's own frame, given those of the one in the middle."""
        return world_T_middle @ self._object_T_middle(-self.middle_o).to(world_T_middle)

    def pieces(self, points: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        """The piece that the table has for each point, which is only about the nearest."""
        most = torch.tensor(self.cells.shape, device=points.device) - 1
        cell = ((points - self.low.to(points)) / self.step).floor().long()
        x, y, z = torch.minimum(cell.clamp_min(0), most).unbind(-1)
        return self.cells.to(points.device)[x, y, z]

    @staticmethod
    def _object_T_middle(shift: Tensor) -> Tensor:
        return se3.make(torch.eye(3, dtype=torch.float64), shift.double())


def _solid(source: MeshSDF | TriangleMesh | str | Path) -> tuple[MeshSDF | None, Tensor, Tensor]:
    """The mesh put right, where it encloses something; its triangles, and their box."""
    if isinstance(source, MeshSDF):
        mesh, exact = source.mesh, source
    else:
        mesh = source if isinstance(source, TriangleMesh) else load_mesh(source)
        check_size(mesh)
        try:
            exact = MeshSDF(mesh)
        except MeshError:  # a sheet can be touched too
            corners = mesh.corners
            some = area_vectors(corners).norm(dim=-1) > 0
            if not bool(some.any()):
                raise
            return None, corners[some], mesh.bounds
    return exact, exact.repair.surface.corners.double(), mesh.bounds


def _found(exact: MeshSDF) -> Symmetries:
    table = from_mesh(exact, spacing=exact.mesh.diagonal / _NODES, padding=0.05 * exact.mesh.diagonal)
    points, _ = sample_triangles(exact.repair.surface, _LOOKED_AT, generator=torch.Generator().manual_seed(0))
    return find_symmetries(table, points, tolerance_m=_TOLERANCE * exact.mesh.diagonal).symmetries


def _nearest_pieces(points: Float[Tensor, "N 3"], triangles: Triangles) -> Int[Tensor, "N"]:
    pieces = torch.from_numpy(triangles.tree.corners).reshape(-1, 3, 3)
    return nearest(points, Triangles(pieces)).face
