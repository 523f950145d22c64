"""Nearest triangle and generalised winding number at many points.

Two hot operations. Their plain versions go over all pairs, in chunks; the compiled ones over a tree.
"""

import math
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf import backend, compiled
from sdf.check import check_shape
from sdf.mesh.tree import Tree, build_tree, has_long

# pairs of a point and a triangle at once; each takes some 200 bytes meanwhile
_PAIRS = 1 << 19
ACCURACY = 3.0
"""How many times its radius a group of triangles is away before it counts as one dipole."""


class Nearest(NamedTuple):
    """Nearest points on some triangles.

    Attributes:
        face: (*b), index of the triangle.
        point: (*b, 3), on it, metres.
    """

    face: Int[Tensor, "*b"]
    point: Float[Tensor, "*b 3"]


class Triangles:
    """Triangles with the tree that quick versions need, built at first use.

    Args:
        corners: (F, 3, 3), metres, counter-clockwise from outside.

    Attributes:
        normals: (F, 3), unit; zero where a triangle has no area.
    """

    def __init__(self, corners: Float[Tensor, "F 3 3"]) -> None:
        check_shape("corners", corners, "(F, 3, 3)")
        if len(corners) == 0:
            raise ValueError("Expected at least one triangle, got none")
        self.corners = corners.detach()
        vectors = area_vectors(self.corners)
        self.normals = torch.nn.functional.normalize(vectors, dim=-1, eps=torch.finfo(vectors.dtype).tiny)

    @cached_property
    def tree(self) -> Tree:
        """Boxes of ever smaller groups."""
        return build_tree(self.corners.double().cpu().numpy())

    @cached_property
    def dipoles(self) -> Tree:
        """Dipoles of ever smaller groups; the same tree unless long triangles are split."""
        corners = self.corners.double().cpu().numpy()
        return build_tree(corners, split=True) if has_long(corners) else self.tree


def area_vectors(corners: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Normals as long as the triangles' areas."""
    a, b, c = corners.unbind(-2)
    return 0.5 * torch.linalg.cross(b - a, c - a)


def nearest(points: Float[Tensor, "*b 3"], triangles: Triangles) -> Nearest:
    """The nearest triangle to each point, and where on it.

    Autograd reaches the points through `point`, the triangle held fixed. Where two are equally near, either comes.

    Args:
        points: (*b, 3), metres, finite.
        triangles: what is near.
    """
    check_shape("points", points, "(*b, 3)")
    version = backend.dispatch("nearest_triangle", points, triangles.corners)
    face, point = version(points.reshape(-1, 3), triangles)
    return Nearest(face.view(points.shape[:-1]), point.view(points.shape))


def winding_number(
    points: Float[Tensor, "*b 3"], triangles: Triangles, *, accuracy: float = ACCURACY
) -> Float[Tensor, "*b"]:
    """How many times the triangles wind about each point: 1 inside a closed surface, 0 outside, between at a hole.

    The sum of the triangles' solid angles over 4 pi (Jacobson et al. 2013, eq. 5; Van Oosterom and Strackee 1983). The
    plain version is exact and differentiable. The compiled one takes a group of triangles that is `accuracy` times its
    radius away for one dipole (Barill et al. 2018): its error is below 0.05 at 3 for each time that
    a surface winds, and none at inf.

    Args:
        points: (*b, 3), metres, finite.
        triangles: the surface; it need not be closed.
        accuracy: see above.
    """
    check_shape("points", points, "(*b, 3)")
    if not accuracy > 1:
        raise ValueError(f"Expected an accuracy above 1, got {accuracy}")
    version = backend.dispatch("winding_number", points, triangles.corners)
    result: Tensor = version(points.reshape(-1, 3), triangles, accuracy)
    return result.view(points.shape[:-1])


@backend.register("nearest_triangle")
def _nearest_plain(points: Tensor, triangles: Triangles) -> tuple[Tensor, Tensor]:
    corners = triangles.corners.to(points)
    faces = [torch.zeros(0, dtype=torch.long, device=points.device)]
    with torch.no_grad():
        for part in _parts(points, corners):
            gap = (part[:, None] - closest_point(part[:, None], corners)).square().sum(-1)
            faces.append(gap.argmin(-1))
    face = torch.cat(faces)
    return face, closest_point(points, corners[face])


@backend.register("winding_number")
def _winding_plain(points: Tensor, triangles: Triangles, accuracy: float) -> Tensor:
    corners = triangles.corners.to(points)
    sums = [solid_angle(part[:, None], corners).sum(-1) / (4.0 * math.pi) for part in _parts(points, corners)]
    return torch.cat(sums) if sums else points.new_empty(0)


@backend.register("nearest_triangle", "numba", compiled.supports)
def _nearest_numba(points: Tensor, triangles: Triangles) -> tuple[Tensor, Tensor]:
    from sdf.mesh.tree_numba import nearest_kernel

    places = points.detach().double().contiguous()
    face = torch.empty(len(points), dtype=torch.long)
    found = torch.empty_like(places)
    nearest_kernel(places.numpy(), *triangles.tree.for_distance, face.numpy(), found.numpy())
    return face, found.to(points)


@backend.register("winding_number", "numba", compiled.supports)
def _winding_numba(points: Tensor, triangles: Triangles, accuracy: float) -> Tensor:
    from sdf.mesh.tree_numba import winding_kernel

    places = points.detach().double().contiguous()
    result = torch.empty(len(points), dtype=torch.float64)
    winding_kernel(places.numpy(), *triangles.dipoles.for_winding, float(accuracy), result.numpy())
    return result.to(points)


def closest_point(points: Float[Tensor, "*#b 3"], corners: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Where on each triangle it is nearest to a point: the foot on its plane if within, else on the nearest edge.

    Args:
        points: metres; broadcasts against
        corners: metres; a triangle without area counts as its edges.
    """
    tiny = torch.finfo(corners.dtype).tiny
    edges = corners.roll(-1, -2) - corners
    offset = points[..., None, :] - corners
    share = ((offset * edges).sum(-1) / edges.square().sum(-1).clamp_min(tiny)).clamp(0.0, 1.0)
    feet = corners + share[..., None] * edges
    gaps = (points[..., None, :] - feet).square().sum(-1)
    side = gaps.argmin(-1, keepdim=True)[..., None]
    on_edge = feet.gather(-2, side.expand(*side.shape[:-1], 3)).squeeze(-2)
    normal = torch.linalg.cross(edges[..., 0, :], edges[..., 1, :])
    size = normal.square().sum(-1, keepdim=True)
    beside = torch.linalg.cross(*torch.broadcast_tensors(edges, offset))
    within = ((beside * normal[..., None, :]).sum(-1).amin(-1) >= 0) & (size[..., 0] > 0)
    height = (offset[..., 0, :] * normal).sum(-1, keepdim=True) / size.clamp_min(tiny)
    return torch.where(within[..., None], points - height * normal, on_edge)


def solid_angle(points: Float[Tensor, "*#b 3"], corners: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*b"]:
    """Solid angle of each triangle seen from a point, positive from behind; Van Oosterom and Strackee (1983), eq. 8."""
    a, b, c = (corners - points[..., None, :]).unbind(-2)
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    volume = (a * torch.linalg.cross(b, c)).sum(-1)
    base = la * lb * lc + (a * b).sum(-1) * lc + (a * c).sum(-1) * lb + (b * c).sum(-1) * la
    return 2.0 * torch.atan2(volume, base)


def _parts(points: Tensor, corners: Tensor) -> list[Tensor]:
    """Points in chunks of a bounded number of pairs."""
    size = max(1, _PAIRS // len(corners))
    return [points[i : i + size] for i in range(0, len(points), size)]
