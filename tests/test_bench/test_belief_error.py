"""A belief against a reference on coarse cells."""

import math

import pytest
import torch

from scripts.bench.belief_error import CoarseReference

F64 = torch.float64


def cloud(mean, count=4000, std=(0.001, 0.001, 0.05), seed=0):
    random = torch.Generator().manual_seed(seed)
    return torch.tensor(mean, dtype=F64) + torch.randn(count, 3, generator=random, dtype=F64) * torch.tensor(std)


def even(planar):
    return torch.full((len(planar),), 1.0 / len(planar), dtype=F64)


def test_a_belief_that_is_the_reference_has_no_error():
    planar = cloud((0.5, 0.1, 1.0))
    error = CoarseReference(planar, even(planar)).error(planar, even(planar))
    assert error.total_variation == pytest.approx(0.0, abs=1e-12)
    assert error.total_variation_yaw == pytest.approx(0.0, abs=1e-12)
    assert (error.uncovered, error.modes, error.modes_lost) == (0.0, 1, 0)
    assert error.spread_ratio == pytest.approx(1.0)


def test_two_points_by_hand():
    places = torch.tensor([[0.0005, 0.0005, 0.01], [0.1005, 0.0005, 1.01]], dtype=F64)
    reference = CoarseReference(places, torch.tensor([0.7, 0.3], dtype=F64))
    error = reference.error(places, torch.tensor([0.4, 0.6], dtype=F64))
    assert error.total_variation == pytest.approx(0.3)
    assert (error.modes, error.modes_lost) == (2, 0)
    alone = reference.error(places[:1], torch.ones(1, dtype=F64))
    assert alone.total_variation == pytest.approx(0.3)
    assert (alone.modes_lost, alone.uncovered) == (1, pytest.approx(0.3))


def test_yaw_goes_round():
    planar = cloud((0.0, 0.0, math.pi), std=(0.0003, 0.0003, 0.2))
    wrapped = planar.clone()
    wrapped[:, 2] = torch.remainder(planar[:, 2] + math.pi, 2 * math.pi) - math.pi
    reference = CoarseReference(planar, even(planar))
    error = reference.error(wrapped, even(planar))
    assert error.total_variation == pytest.approx(0.0, abs=1e-9)
    assert error.modes == 1
