"""Surface nets: a triangle mesh of the zero level of a signed distance function."""

import torch
from jaxtyping import Int
from torch import Tensor

from sdf.base import SDF
from sdf.mesh.mesh import TriangleMesh

_CELLS = 64  # along the longest side, by default
_MARGIN = 2  # cells about the shape
_AT_ONCE = 1 << 17  # points that are looked up together
_STEPS = 3  # of Newton's method, by which vertices come to lie on the surface


def mesh_of(sdf: SDF, spacing: float | None = None) -> TriangleMesh:
    """A closed triangle mesh of an SDF's zero level, by surface nets: a vertex in each cell that the surface crosses.

    Vertices are carried onto the surface along the gradient; edges that are sharper than the cells are chamfered.
    Source: Gibson, Constrained elastic surface nets (1998).

    Args:
        sdf: of a closed shape.
        spacing: metres between the nodes of the lattice; by default a 64th of the longest side.

    Raises:
        ValueError: the spacing is not above 0, or no surface lies within the SDF's bounds.
    """
    low, high = sdf.bounds.double().cpu()
    step = float((high - low).max()) / _CELLS if spacing is None else spacing
    if not step > 0:
        raise ValueError(f"Expected a spacing above 0, got {step}")
    ends = torch.stack((low - _MARGIN * step, high + (_MARGIN + 1) * step), -1)
    axes = [torch.arange(first, last, step, dtype=torch.float64) for first, last in ends.tolist()]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    with torch.no_grad():
        values = torch.cat([sdf.distance(some) for some in points.reshape(-1, 3).split(_AT_ONCE)])
    inside = (values < 0).reshape(points.shape[:-1])
    cells = inside.unfold(0, 2, 1).unfold(1, 2, 1).unfold(2, 2, 1).flatten(-3)
    crossed = cells.any(-1) & ~cells.all(-1)
    if not bool(crossed.any()):
        raise ValueError(f"Expected a surface within the bounds {sdf.bounds.tolist()}, found none")
    number = torch.full(crossed.shape, -1, dtype=torch.long)
    number[crossed] = torch.arange(int(crossed.sum()))
    vertices = points[:-1, :-1, :-1][crossed] + 0.5 * step
    with torch.no_grad():
        for _ in range(_STEPS):
            distance, gradient = sdf(vertices)
            vertices = vertices - (distance / gradient.square().sum(-1).clamp_min(0.25))[:, None] * gradient
    quads = torch.cat([_quads(inside, number, axis) for axis in range(3)])
    return TriangleMesh(vertices, torch.cat((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]])))


def _quads(inside: Tensor, number: Tensor, axis: int) -> Int[Tensor, "Q 4"]:
    """The cells about each edge along an axis that the surface crosses, counter-clockwise from outside."""
    order = [(axis + shift) % 3 for shift in range(3)]
    solid, cell = inside.permute(order), number.permute(order)
    begins, ends = solid[:-1, 1:-1, 1:-1], solid[1:, 1:-1, 1:-1]
    around = torch.stack((cell[:, :-1, :-1], cell[:, 1:, :-1], cell[:, 1:, 1:], cell[:, :-1, 1:]), -1)
    return torch.cat((around[begins & ~ends], around[~begins & ends].flip(-1)))
