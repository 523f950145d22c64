"""Quality diversity: an archive of elite poses over orientation, from which a belief is filled."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.errors import DegenerateBeliefError
from rumi.registration.descent import Search


def orientation_bins(rotation: Float[Tensor, "N 3 3"], width_rad: float, search: Search) -> Int[Tensor, "N"]:
    """Bin of each rotation: of yaw in SE(2), of about equal cells of SO(3) in SE(3).

    SE(3) cells are the Voronoi cells of a super-Fibonacci spiral of quaternions (Alexa 2022), as many as give
    cells of about `width_rad`.
    """
    if search == "SE(2)":
        yaw = torch.atan2(rotation[:, 1, 0], rotation[:, 0, 0])
        count = max(1, round(2 * math.pi / width_rad))
        return torch.floor((yaw + math.pi) * (count / (2 * math.pi))).long().clamp(0, count - 1)
    centres = super_fibonacci(max(1, round(8 * math.pi**2 / width_rad**3)), rotation)
    # trace(A^T B) is greatest for the nearest rotation
    return torch.cat([(part.flatten(1) @ centres.flatten(1).T).argmax(-1) for part in rotation.split(256)])


def fill(
    bins: Int[Tensor, "N"], discrepancy: Float[Tensor, "N"], margin: float | Tensor, count: int
) -> Int[Tensor, "P"]:
    """Indices of `count` particles, round robin over the bins' elites, best first, all within `margin` of the best.

    Every bin with a plausible pose is served before any bin is served twice; where the plausible poses run out,
    the round starts again, so that an index may come more than once.

    Raises:
        DegenerateBeliefError: some discrepancies are NaN, so that none is the best.
    """
    plausible = (discrepancy <= discrepancy.min() + margin).nonzero()[:, 0]
    if not len(plausible):
        raise DegenerateBeliefError("Expected poses with discrepancies, got NaN: check the observation's points")
    order = plausible[torch.argsort(discrepancy[plausible], stable=True)]
    by_bin = order[torch.argsort(bins[order], stable=True)]
    _, sizes = torch.unique_consecutive(bins[by_bin], return_counts=True)
    rank = torch.cat([torch.arange(int(size), device=bins.device) for size in sizes])
    # by round first, best first within a round
    round_robin = by_bin[_lexicographic(rank, discrepancy[by_bin])]
    repeats = math.ceil(count / len(round_robin))
    return round_robin.repeat(repeats)[:count]


def _lexicographic(first: Tensor, second: Tensor) -> Tensor:
    inner = torch.argsort(second, stable=True)
    return inner[torch.argsort(first[inner], stable=True)]


def super_fibonacci(count: int, like: Tensor) -> Float[Tensor, "K 3 3"]:
    """Rotations spread evenly over all of them: a spiral of quaternions (Alexa 2022), in the numbers of `like`."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    radius, other = (s / count).sqrt(), (1 - s / count).sqrt()
    alpha, beta = 2 * math.pi * s / math.sqrt(2.0), 2 * math.pi * s / 1.533751168755204288118041
    x, y, z, w = radius * alpha.sin(), radius * alpha.cos(), other * beta.sin(), other * beta.cos()
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2).to(like)
