"""Which modes a posterior of poses has, by brute force, and which of them some poses leave out."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.registration.descent import DescentSettings, descend
from rumi.registration.register import uniform_starts
from sdf import se3, so3
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation

# cells that stand for the plausible set, what links them to one mode, and what counts as keeping a mode
CELL, LINK, KEPT = (0.01, 0.2), (0.02, 0.35), (0.03, 0.5)
"""Metres between the object's middles, and radians."""
_MOST = 400
_FINE = DescentSettings(iterations=40, margin_m=0.1)


class Modes(NamedTuple):
    """Connected parts of the poses that are plausible.

    Attributes:
        frame_T_object: (L, 4, 4), a pose for each cell of them.
        weight: (L,), of each, relative to the best of all.
        mode: (L,), number of the part it belongs to.
    """

    frame_T_object: Float[Tensor, "L 4 4"]
    weight: Float[Tensor, "L"]
    mode: Int[Tensor, "L"]


def plausible_modes(
    discrepancy: Discrepancy,
    observation: Observation,
    peakiness: float,
    *,
    starts: int,
    plausible: float = 0.01,
    generator: torch.Generator,
) -> Modes:
    """Modes among the poses that many starts all over end at; at most 400 cells of them are told apart."""
    middle = discrepancy.sdf.bounds.mean(0)
    begin = uniform_starts(observation, discrepancy.sdf.bounds, starts, generator=generator)
    poses = torch.cat([descend(discrepancy, part, observation, "SE(3)", _FINE) for part in begin.split(4000)])
    cost = discrepancy(poses, observation)
    left = (cost <= cost.min() - math.log(plausible) / peakiness).nonzero()[:, 0]
    cells: list[int] = []
    while len(left) and len(cells) < _MOST:
        best = int(left[cost[left].argmin()])
        cells.append(best)
        left = left[~_near(poses[left], poses[best][None], middle, CELL)[:, 0]]
    chosen = torch.tensor(cells)
    near = _near(poses[chosen], poses[chosen], middle, LINK)
    mode = torch.arange(len(chosen))
    while True:
        lower = torch.where(near, mode[None], len(chosen)).amin(1)
        if torch.equal(lower, mode):
            break
        mode = lower
    return Modes(poses[chosen], torch.exp(-peakiness * (cost[chosen] - cost.min())), mode)


def lost_modes(modes: Modes, kept: Float[Tensor, "P 4 4"], middle_o: Float[Tensor, "3"]) -> list[float]:
    """Weights of the modes that no kept pose is near to."""
    covered = _near(modes.frame_T_object, kept, middle_o, KEPT).any(1)
    return [
        float(modes.weight[modes.mode == k].max())
        for k in modes.mode.unique()
        if not bool(covered[modes.mode == k].any())
    ]


def _near(a: Tensor, b: Tensor, middle_o: Tensor, within: tuple[float, float]) -> Tensor:
    """Which poses of a (rows) are near which of b (columns), by place of the object's middle and orientation."""
    from_a, from_b = (se3.apply(x, middle_o.expand(len(x), 1, 3))[:, 0] for x in (a, b))
    turn = so3.angle(a[:, None, :3, :3].mT @ b[None, :, :3, :3])
    return (torch.cdist(from_a, from_b) < within[0]) & (turn < within[1])
