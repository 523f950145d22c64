"""Surface sampling: points uniform by area on an exact SDF or on triangles."""

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.base import SDF
from sdf.mesh.triangles import Triangles, area_vectors
from sdf.voxel_grid import lattice_keys

_SHELL = 3e-4
_SPREAD = 16
_PATIENCE = 50


def sample_surface(
    sdf: SDF, count: int, *, generator: torch.Generator
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Points on the surface of an exact SDF with their outward unit normals, uniform by area, float64.

    Points drawn within 0.3 mm of the surface are carried onto it along the gradient: a bend gains on one side what
    it loses on the other, so that the density is uniform wherever the object is thicker than that. More are drawn
    than asked for, and every 16th is kept in an order that follows the surface, so that each part of it gets its
    share more evenly than by chance.

    Args:
        sdf: exact near its surface; where it is only a bound (inside a union's joints) points are dropped.
        count: number of points.
        generator: all randomness (a CPU generator).

    Raises:
        ValueError: if no point is asked for, or no surface is found within the SDF's bounds.
    """
    if count < 1:
        raise ValueError(f"Expected a count of 1 or more surface points, got {count}")
    low, high = sdf.bounds.double().cpu() + torch.tensor([[-_SHELL], [_SHELL]], dtype=torch.float64)
    wanted = _SPREAD * count
    found: list[tuple[Tensor, Tensor]] = []
    total = 0
    while total < wanted:
        if len(found) == _PATIENCE and total == 0:
            raise ValueError(f"Expected a surface within bounds {sdf.bounds.tolist()}, found none: is the SDF exact?")
        unit = torch.rand(65536, 3, generator=generator, dtype=torch.float64)
        points = low + (high - low) * unit
        with torch.no_grad():
            points = points[sdf.distance(points).abs() < _SHELL]
        distance, gradient = sdf(points)
        points = points - distance[:, None] * gradient
        distance, gradient = sdf(points)
        length = gradient.norm(dim=-1)
        good = (distance.abs() < 1e-7) & ((length - 1.0).abs() < 1e-6)
        found.append((points[good], gradient[good]))
        total += int(good.sum())
    points, normals = (torch.cat(parts)[:wanted] for parts in zip(*found, strict=True))
    return _spread(points, normals)


def sample_triangles(
    triangles: Triangles, count: int, *, generator: torch.Generator
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Points on triangles with their unit normals, uniform by area, spread as by `sample_surface`, float64.

    Args:
        triangles: at least one of them with an area.
        count: number of points.
        generator: all randomness (a CPU generator).
    """
    if count < 1:
        raise ValueError(f"Expected a count of 1 or more surface points, got {count}")
    corners = triangles.corners.double().cpu()
    wanted = _SPREAD * count
    # by the running sum of areas: torch.multinomial takes 2^24 triangles at most, and in float32
    area = area_vectors(corners).norm(dim=-1).cumsum(0)
    draws = torch.rand(wanted, 3, generator=generator, dtype=torch.float64)
    chosen = torch.searchsorted(area, draws[:, 0] * area[-1], right=True).clamp_max(len(corners) - 1)
    # the square root makes them uniform within a triangle
    root = draws[:, 1].sqrt()
    shares = torch.stack((1.0 - root, root * (1.0 - draws[:, 2]), root * draws[:, 2]), -1)
    points = (shares[..., None] * corners[chosen]).sum(1)
    return _spread(points, triangles.normals.double().cpu()[chosen])


def _spread(points: Float[Tensor, "W 3"], normals: Float[Tensor, "W 3"]) -> tuple[Tensor, Tensor]:
    """Every 16th of some points, by the side that the surface faces, then by place."""
    side = 2 * normals.abs().argmax(-1) + (torch.gather(normals, -1, normals.abs().argmax(-1)[:, None])[:, 0] > 0)
    order = torch.argsort((side << 51) + lattice_keys(points, 0.02), stable=True)
    keep = order[torch.arange(len(points) // _SPREAD) * _SPREAD + _SPREAD // 2]
    return points[keep], normals[keep]
