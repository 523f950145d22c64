"""Border of a tool's section: points on it, in groups of near ones that one bound settles together."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

BORDER_GROUP = 8
"""Points of a tool's border that one bound settles together."""


class Border(NamedTuple):
    """Points on the border of a tool's section, tool frame, metres.

    Attributes:
        points: (n, 2).
        groups: (G, size), their numbers in groups of near ones; some are there more than once to fill a group.
        sets: (G, size, 2), the points of each group.
        centres: (G, 2), of the box about each group.
        radii: (G), of the group about it.
        radius: greatest distance of a point from the frame's origin.
    """

    points: Float[Tensor, "n 2"]
    groups: Int[Tensor, "G size"]
    sets: Float[Tensor, "G size 2"]
    centres: Float[Tensor, "G 2"]
    radii: Float[Tensor, "G"]
    radius: float

    @classmethod
    def of(cls, points: Float[Tensor, "n 2"], groups: Int[Tensor, "G size"]) -> "Border":
        """The same points and groups, with what bounds them."""
        sets = points[groups]
        return cls(points, groups, sets, *bounding_balls(sets), float(points.norm(dim=-1).max()))


def bounding_balls(sets: Float[Tensor, "G size D"]) -> tuple[Float[Tensor, "G D"], Float[Tensor, "G"]]:
    """Middle of the box about each group of points, and radius of the group about it."""
    centres = 0.5 * (sets.amin(1) + sets.amax(1))
    return centres, (sets - centres[:, None]).norm(dim=-1).amax(-1)


def near_groups(points: Float[Tensor, "n D"], size: int) -> Int[Tensor, "G size"]:
    """Halved along its longer side until a group has no more than `size` points."""
    parts = [torch.arange(len(points), device=points.device)]
    while len(parts[0]) > size:
        halves = []
        for part in parts:
            own = points[part]
            across = part[own[:, (own.amax(0) - own.amin(0)).argmax()].argsort(stable=True)]
            halves += [across[: (len(part) + 1) // 2], across[len(part) // 2 :]]
        parts = halves
    filled = torch.arange(size, device=points.device)
    return torch.stack([part[filled % len(part)] for part in parts])
