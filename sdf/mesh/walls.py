"""Wall thickness of a mesh."""

import torch

from sdf.mesh.triangles import Triangles, nearest
from sdf.surface import sample_triangles

_SAMPLES = 2000
_STEPS = 48
# of the diagonal: where a ray starts and when it has arrived
_START, _ARRIVED = 2e-5, 1e-6
# cosine: what a ray meets is the other side of a wall if it faces away within 45 degrees
_OPPOSITE = -0.7
_SHARE = 0.01


def thinnest_wall(surface: Triangles, diagonal: float) -> float | None:
    """Thickness that 99 % of the walls' area has, metres; None where hardly any part of the surface has another behind.

    Rays go inward from points of the surface, each as far at a time as nothing is near, up to the first surface that
    faces the other way; where they meet another (a wedge, an edge) there is no wall.

    Args:
        surface: oriented outward.
        diagonal: of the mesh, metres.
    """
    start, normal = sample_triangles(surface, _SAMPLES, generator=torch.Generator().manual_seed(0))
    depth = torch.full((_SAMPLES,), _START * diagonal, dtype=torch.float64)
    thickness = torch.full_like(depth, torch.nan)
    going = torch.arange(_SAMPLES)
    for _ in range(_STEPS):
        place = start[going] - depth[going, None] * normal[going]
        found = nearest(place, surface)
        gap = (place - found.point).norm(dim=-1)
        # at first the nearest is the side that the ray has left, as far away as the ray has come
        arrived = (gap < _ARRIVED * diagonal) & (gap < 0.5 * depth[going])
        facing = (surface.normals[found.face] * normal[going]).sum(-1) < _OPPOSITE
        thickness[going[arrived & facing]] = depth[going[arrived & facing]]
        depth[going] += gap
        going = going[~arrived & (depth[going] < 2.0 * diagonal)]
        if len(going) == 0:
            break
    known = thickness[~thickness.isnan()]
    return float(known.quantile(_SHARE)) if len(known) >= 0.05 * _SAMPLES else None
