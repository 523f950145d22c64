"""How far a particle belief is from a reference posterior over (x, y, yaw)."""

import itertools
import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

EDGES = (0.002, 0.002, math.radians(10.0))
"""Edges of the cells on which beliefs are compared: metres, metres, radians."""

Masses = dict[int, float]
_HALF, _WIDE = 1 << 19, 1 << 20


class BeliefError(NamedTuple):
    """A belief against the reference.

    Attributes:
        total_variation: half the summed difference of mass over the cells of x, y and yaw; 0 to 1.
        total_variation_yaw: the same over the cells of yaw alone.
        uncovered: reference mass in cells of yaw that hold at least 1 % of it and no particle weight.
        modes: connected regions of the reference with at least 1 % of its mass.
        modes_lost: of these, those without particle weight.
        spread_ratio: standard deviation about the mean in x and y, the belief's over the reference's.
    """

    total_variation: float
    total_variation_yaw: float
    uncovered: float
    modes: int
    modes_lost: int
    spread_ratio: float


class CoarseReference:
    """A reference posterior on coarse cells, on lattices shifted by half a cell each way.

    Args:
        planar: rows (x, y, yaw), metres and radians.
        weights: sum to 1.
        edges: of the cells; the yaw's must divide the circle.
    """

    def __init__(
        self,
        planar: Float[Tensor, "G 3"],
        weights: Float[Tensor, "G"],
        edges: tuple[float, float, float] = EDGES,
    ) -> None:
        self._size, self._turns = torch.tensor(edges, dtype=torch.float64), round(2 * math.pi / edges[2])
        self._shifts = torch.tensor(list(itertools.product((0.0, 0.5), repeat=3)), dtype=torch.float64)
        self._masses = [self._of(planar, weights, shift) for shift in self._shifts]
        self._regions = self._connected(self._masses[0][0])
        self._spread = _spread(planar.double(), weights.double())

    def error(self, planar: Float[Tensor, "N 3"], weights: Float[Tensor, "N"]) -> BeliefError:
        """Compare weighted particles with the reference, mean over the lattices.

        Args:
            planar: the particles' (x, y, yaw).
            weights: sum to 1.
        """
        full, angle, uncovered = [], [], []
        for shift, (cells, yaws) in zip(self._shifts, self._masses, strict=True):
            own_cells, own_yaws = self._of(planar, weights, shift)
            full.append(_total_variation(cells, own_cells))
            angle.append(_total_variation(yaws, own_yaws))
            uncovered.append(sum(m for cell, m in yaws.items() if m >= 0.01 and own_yaws.get(cell, 0.0) < 1e-6))
        held, _ = self._of(planar, weights, self._shifts[0])
        lost = sum(all(held.get(cell, 0.0) < 1e-6 for cell in region) for region in self._regions)
        total, yaw, gap = (sum(values) / len(values) for values in (full, angle, uncovered))
        ratio = _spread(planar.double(), weights.double()) / self._spread
        return BeliefError(total, yaw, gap, len(self._regions), lost, ratio)

    def _of(self, planar: Tensor, weights: Tensor, shift: Tensor) -> tuple[Masses, Masses]:
        """Mass by cell, and by cell of yaw alone."""
        cells = torch.floor(planar.double() / self._size + shift + 1e-9).long()
        yaw = cells[:, 2] % self._turns
        # a whole number a cell: places within a kilometre
        return _masses(((cells[:, 0] + _HALF) * _WIDE + cells[:, 1] + _HALF) * 1024 + yaw, weights), _masses(
            yaw, weights
        )

    def _connected(self, masses: Masses) -> list[set[int]]:
        """Regions of touching cells, among those that make up 99 % of the mass, that hold at least 1 % of it."""
        left: set[int] = set()
        total = 0.0
        for cell, mass in sorted(masses.items(), key=lambda item: -item[1]):
            if total >= 0.99:
                break
            left.add(cell)
            total += mass
        steps = [(i * _WIDE + j) * 1024 for i, j in itertools.product((-1, 0, 1), repeat=2)]
        regions = []
        while left:
            region, edge = set(), [left.pop()]
            while edge:
                cell = edge.pop()
                region.add(cell)
                place, yaw = cell - cell % 1024, cell % 1024
                near = {place + step + (yaw + k) % self._turns for step in steps for k in (-1, 0, 1)} & left
                left -= near
                edge += near
            if sum(masses[cell] for cell in region) >= 0.01:
                regions.append(region)
        return regions


def _masses(keys: Int[Tensor, "N"], weights: Float[Tensor, "N"]) -> Masses:
    unique, inverse = torch.unique(keys, return_inverse=True)
    mass = torch.zeros(len(unique), dtype=torch.float64).index_add_(0, inverse, weights.double())
    return dict(zip(unique.tolist(), mass.tolist(), strict=True))


def _total_variation(a: Masses, b: Masses) -> float:
    return 0.5 * sum(abs(a.get(cell, 0.0) - b.get(cell, 0.0)) for cell in a.keys() | b.keys())


def _spread(planar: Float[Tensor, "N 3"], weights: Float[Tensor, "N"]) -> float:
    place = planar[:, :2]
    mean = (weights[:, None] * place).sum(0)
    return float((weights * (place - mean).square().sum(-1)).sum().sqrt())
