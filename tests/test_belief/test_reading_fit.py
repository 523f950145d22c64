"""A reading is held against the particles one by one, until one explains it."""

import math

import pytest
import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.reading_fit import unexplained
from sdf import se3
from sdf.base import SDF
from sdf.primitives import Box
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics


@pytest.fixture(scope="module")
def box() -> SDF:
    """A box of 60, 40 and 20 mm."""
    return Box((0.03, 0.02, 0.01))


def _belief(count: int, spread_m: float, seed: int = 0) -> PoseBelief:
    random = torch.Generator().manual_seed(seed)
    twists = spread_m * torch.randn(count, 6, generator=random) * torch.tensor([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    return PoseBelief.uniform(se3.exp(twists))


def _reading(seed: int = 1) -> Observation:
    random = torch.Generator().manual_seed(seed)
    surface = torch.randn(7, 3, generator=random) * 0.02
    free = torch.randn(11, 3, generator=random) * 0.03
    return concatenate([Observation.of(surface, Semantics.SURFACE), Observation.of(free, Semantics.FREE)])


def _by_hand(belief: PoseBelief, added: Observation, sdf: SDF) -> list[tuple[float, float]]:
    """Of each particle, one after the other."""
    found = []
    for pose in belief.attached_T_object:
        local = se3.apply(se3.inverse(pose), added.points)
        distance = sdf.distance(local)
        surface = distance[added.of_class(Semantics.SURFACE)].abs().sort().values
        off = float(surface[(len(surface) - 1) // 2])
        found.append((off, max(0.0, float((-distance[added.of_class(Semantics.FREE)]).max()))))
    return found


def test_the_particle_that_explains_most_is_told(box: SDF) -> None:
    """The least of the greater of both distances over all particles, as by hand, of any order of the particles."""
    belief, added = _belief(100, 0.01), _reading()
    every = _by_hand(belief, added, box)
    found = unexplained(belief, added, box)
    assert found == pytest.approx(min(every, key=max), abs=1e-6)


@pytest.mark.parametrize("enough_m", [0.0, 0.002, 0.005, 0.02, math.inf])
def test_no_further_particle_is_asked_once_one_explains_the_reading(box: SDF, enough_m: float) -> None:
    """What is told is within the bound exactly where the best particle is."""
    asked = 0

    class Counting(Box):
        def distance(self, points: Tensor) -> Tensor:
            nonlocal asked
            asked += len(points) if points.ndim == 3 else 1
            return super().distance(points)

    belief, added = _belief(200, 0.01), _reading()
    counting = Counting((0.03, 0.02, 0.01))
    best = max(min(_by_hand(belief, added, box), key=max))
    found = max(unexplained(belief, added, counting, enough_m))
    assert (found <= enough_m) == (best <= enough_m)
    if enough_m == 0.0:
        assert found == pytest.approx(best, abs=1e-6)
    if enough_m == math.inf:
        assert 0 < asked < 200


def test_a_reading_without_points_leaves_nothing(box: SDF) -> None:
    """Nothing felt and nothing free: no distance."""
    assert unexplained(_belief(3, 0.01), Observation.empty(), box) == (0.0, 0.0)


def test_populations_that_follow_one_another_are_asked_alike() -> None:
    """The one population that explains a reading is met among the first particles, wherever it is in the belief."""
    asked = 0

    class Counting(Box):
        def distance(self, points: Tensor) -> Tensor:
            nonlocal asked
            asked += len(points)
            return super().distance(points)

    far = se3.make(torch.eye(3), torch.tensor([1.0, 0.0, 0.0])).expand(400, 4, 4)
    here = se3.identity((400,))
    added = Observation.of(torch.tensor([[0.03, 0.0, 0.0]]), Semantics.SURFACE)
    for order in ([far, here], [here, far]):
        belief, asked = PoseBelief.uniform(torch.cat(order)), 0
        found = unexplained(belief, added, Counting((0.03, 0.02, 0.01)), 0.001)
        assert found == pytest.approx((0.0, 0.0), abs=1e-6) and 0 < asked < 100
