"""Discs, in space balls, that together cover a tool's body: what bounds what its points meet."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Cover(NamedTuple):
    """Points of a tool's body by the discs, in space balls, that cover it; tool frame, metres.

    Attributes:
        points: (n, 3), in a plane with the heights that they have in the world.
        height: of all points, if they have one.
        centres: (k, 3).
        radius: of the discs, metres.
        order: (n), numbers of the points by disc.
        sets: (n, 3), the points by disc.
        starts: (k + 1), where those of each disc begin.
    """

    points: Float[Tensor, "n 3"]
    height: float | None
    centres: Float[Tensor, "k 3"]
    radius: float
    order: Int[Tensor, "n"]
    sets: Float[Tensor, "n 3"]
    starts: Int[Tensor, "k1"]

    @classmethod
    def of(cls, points: Float[Tensor, "n 3"], discs: tuple[Float[Tensor, "k D"], float] | None) -> "Cover":
        """Of points and discs; None for one disc that holds all there is."""
        centres, radius = (points.new_zeros(1, points.shape[-1]), math.inf) if discs is None else discs
        axes = centres.shape[-1]
        owner = torch.cdist(points[:, :axes], centres).argmin(-1)
        starts = torch.searchsorted(owner.sort().values, torch.arange(len(centres) + 1, device=points.device))
        order = owner.argsort(stable=True)
        height = float(points[0, 2]) if bool((points[:, 2] == points[0, 2]).all()) else None
        spatial = torch.cat((centres, centres.new_zeros(len(centres), 3 - axes)), -1)
        return cls(points, height, spatial, radius, order, points[order], starts)


def covering_discs(points: Float[Tensor, "n D"], count: int) -> tuple[Float[Tensor, "k D"], float]:
    """Centres of discs of one radius that together cover some points, and the radius, metres."""
    # farthest points as a start, then each centre moves to the middle of the box about its own points
    centers = points.mean(0, keepdim=True)
    while len(centers) < count:
        farthest = torch.cdist(points, centers).amin(-1).argmax()
        centers = torch.cat((centers, points[farthest][None]))
    best, least = centers, float(torch.cdist(points, centers).amin(-1).max())
    for _ in range(30):
        owner = torch.cdist(points, centers).argmin(-1)
        own = [points[owner == index] for index in range(count)]
        centers = torch.stack([0.5 * (p.amin(0) + p.amax(0)) if len(p) else centers[i] for i, p in enumerate(own)])
        radius = float(torch.cdist(points, centers).amin(-1).max())
        if radius < least:
            best, least = centers, radius
    return best, least
