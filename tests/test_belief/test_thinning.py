"""Fewer particles that stand for the same belief."""

import pytest
import torch

from rumi.belief.particles import PoseBelief, subsample
from sdf import se3


def belief(count: int = 100, spread: float = 1.0) -> PoseBelief:
    random = torch.Generator().manual_seed(0)
    places = torch.randn(count, 3, generator=random, dtype=torch.float64)
    uniform = PoseBelief.uniform(se3.from_planar(places))
    return uniform.reweighted(spread * torch.randn(count, generator=random, dtype=torch.float64))


def test_keeps_the_means() -> None:
    whole = belief(2000)
    fewer = subsample(whole, 200)
    assert len(fewer.log_weights) <= 200
    for mean in (lambda b: (b.weights[:, None] * b.world_T_object[:, :3, 3]).sum(0),):
        torch.testing.assert_close(mean(fewer), mean(whole), atol=0.1, rtol=0)
    assert float(fewer.weights.sum()) == pytest.approx(1.0)


def test_heavy_particles_stay_heavy() -> None:
    whole = belief(10).reweighted(torch.tensor([0.0] * 9 + [3.0], dtype=torch.float64))
    fewer = subsample(whole, 5)
    heaviest = fewer.world_T_object[fewer.weights.argmax()]
    torch.testing.assert_close(heaviest, whole.world_T_object[9])
    # three of the five teeth fall on a share of e^3 / (9 + e^3)
    assert float(fewer.weights.max()) == pytest.approx(0.6)


def test_nothing_to_do() -> None:
    whole = belief(7)
    assert subsample(whole, 7) is whole
    assert len(subsample(whole, 1).log_weights) == 1
    with pytest.raises(ValueError, match="count"):
        subsample(whole, 0)
