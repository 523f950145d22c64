"""The exact signed distance function of a triangle mesh."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3
from sdf.base import SDF
from sdf.mesh.mesh import TriangleMesh
from sdf.mesh.repair import Repaired, repaired
from sdf.mesh.triangles import Triangles, nearest, winding_number
from sdf.primitives import object_points

# metres: nearer than this, the direction to the surface is the triangle's normal rather than a quotient of roundings
_ON = 1e-9


class MeshSDF(SDF):
    """Signed distance of a mesh: distance to the nearest triangle, inside where it winds more than half about a point.

    The mesh is put right first (`sdf.mesh.repair`), so that it may be open, overlapping or badly oriented. Distances
    are worked out in float64; autograd reaches the points. A point that is not finite counts as very far outside.

    Args:
        mesh: as it came.
        repair: what putting it right gave, if that is known.
    """

    def __init__(self, mesh: TriangleMesh, *, repair: Repaired | None = None) -> None:
        super().__init__(mesh.bounds.to(torch.get_default_dtype()))
        self.mesh = mesh
        self.repair = repaired(mesh) if repair is None else repair

    @property
    def solid(self) -> TriangleMesh:
        """The mesh put right: oriented outward, openings closed."""
        return self.repair.solid

    def moved(self, new_T_old: Float[Tensor, "4 4"]) -> "MeshSDF":
        """The same surface in another frame, without putting it right again."""
        pose = new_T_old.double().cpu()
        windings, surface = (
            Triangles(se3.apply(pose, part.corners.reshape(-1, 3)).reshape(-1, 3, 3))
            for part in (self.repair.windings, self.repair.surface)
        )
        repair = replace(self.repair, solid=self.repair.solid.moved(pose), windings=windings, surface=surface)
        return MeshSDF(self.mesh.moved(pose), repair=repair)

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres; the derivative to the points is the unit vector away from the surface."""
        points = object_points(points_o).double()
        with torch.no_grad():
            found = nearest(points, self.repair.surface)
            side = torch.where(self._inside(points), -1.0, 1.0).to(points)
        offset = points - found.point
        squared = offset.square().sum(-1)
        off = squared > _ON**2
        normal = self.repair.surface.normals.to(points.device)[found.face]
        on_plane = (offset * normal).sum(-1)
        away = side * torch.where(off, squared, torch.ones_like(squared)).sqrt()
        return torch.where(off, away, on_plane).to(points_o.dtype)

    def _inside(self, points: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
        """Whether the mesh winds more than half about points; nothing beyond its bounds is inside."""
        low, high = self.mesh.bounds.to(points)
        inside = ((points >= low) & (points <= high)).all(-1)
        inside[inside.clone()] = winding_number(points[inside], self.repair.windings) > 0.5
        return inside

    def __deepcopy__(self, memo: dict[int, object]) -> "MeshSDF":
        """Another with bounds of its own; the mesh itself never changes and is shared."""
        other = MeshSDF(self.mesh, repair=self.repair)
        other.bounds = self.bounds.clone()
        return other
