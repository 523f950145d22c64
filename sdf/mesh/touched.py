"""Data association of a contact with a triangle: by nearness of the point and agreement of the normal."""

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import backend, compiled
from sdf.check import check_shape, is_eager
from sdf.mesh.triangles import Nearest, Triangles, closest_point, nearest

# pairs of a point and a triangle at once
_PAIRS = 1 << 19


def touched_face(
    points: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"], triangles: Triangles, reach_m: float | Tensor
) -> Nearest:
    """The triangle with the least |p - q|^2 + reach^2 |n - n_f|^2, both parts of one triangle, and the point q on it.

    With reach = sigma_p / sigma_n it is the triangle that makes a touch's point and normal likeliest together (time
    allocation, Eq. 5); with 0 it is the nearest. Autograd reaches the points through `point`, the triangle held fixed.

    Args:
        points: (*b, 3), metres, finite.
        normals: (*b, 3), outward, unit.
        triangles: what was touched; one without area has the normal 0.
        reach_m: metres that a chord of 1 between normals counts for.
    """
    check_shape("points", points, "(*b, 3)")
    if normals.shape != points.shape:
        raise ValueError(f"Expected a normal for every point, {tuple(points.shape)}, got {tuple(normals.shape)}")
    if is_eager():
        if not reach_m >= 0:
            raise ValueError(f"Expected a reach of 0 or more, got {reach_m}")
        if reach_m == 0:
            return nearest(points, triangles)
    version = backend.dispatch("touched_face", points, normals, triangles.corners)
    face, point = version(points.reshape(-1, 3), normals.reshape(-1, 3), triangles, reach_m)
    return Nearest(face.view(points.shape[:-1]), point.view(points.shape))


@backend.register("touched_face")
def _touched_plain(
    points: Tensor, normals: Tensor, triangles: Triangles, reach: float | Tensor
) -> tuple[Tensor, Tensor]:
    corners, facing = triangles.corners.to(points), triangles.normals.to(points)
    faces = [torch.zeros(0, dtype=torch.long, device=points.device)]
    size = max(1, _PAIRS // len(corners))
    with torch.no_grad():
        for start in range(0, len(points), size):
            rows = slice(start, start + size)
            gap = (points[rows, None] - closest_point(points[rows, None], corners)).square().sum(-1)
            chord = (normals[rows, None] - facing).square().sum(-1)
            faces.append((gap + reach**2 * chord).argmin(-1))
    face = torch.cat(faces)
    return face, closest_point(points, corners[face])


@backend.register("touched_face", "numba", compiled.supports)
def _touched_numba(
    points: Tensor, normals: Tensor, triangles: Triangles, reach: float | Tensor
) -> tuple[Tensor, Tensor]:
    from sdf.mesh.touched_numba import touched_kernel

    places, facing = (x.detach().double().contiguous() for x in (points, normals))
    face = torch.empty(len(points), dtype=torch.long)
    found = torch.empty_like(places)
    own = triangles.normals.double().contiguous().numpy()
    touched_kernel(
        places.numpy(), facing.numpy(), *triangles.tree.for_distance, own, float(reach), face.numpy(), found.numpy()
    )
    return face, found.to(points)
