"""Touches as evidence on a rectangle's middle, whatever its yaw."""

import math

import pytest
import torch

from sdf.sweep import sweep_rectangle
from sensors.touch.circle_touch import CircleTouches, width_share

F64 = torch.float64
HALF = torch.tensor([0.1, 0.05], dtype=F64)
RADIUS = 0.0125


def test_the_share_of_yaws_that_are_narrower():
    yaw = (torch.arange(20000, dtype=F64) + 0.5) / 20000 * math.pi
    reach = HALF[0] * yaw.cos().abs() + HALF[1] * yaw.sin().abs()
    distance = torch.linspace(0.0, 0.15, 40, dtype=F64)
    wanted = (reach < distance[:, None]).double().mean(1)
    assert torch.allclose(width_share(distance, HALF), wanted, atol=1e-3)
    assert float(width_share(torch.tensor(0.049, dtype=F64), HALF)) == 0.0
    assert float(width_share(torch.tensor(0.112, dtype=F64), HALF)) == 1.0
    assert float(width_share(torch.tensor(-1.0, dtype=F64), HALF)) == pytest.approx(0.0)


def test_a_long_way_meets_a_block_as_often_as_it_says():
    generator = torch.Generator().manual_seed(0)
    start, end = torch.tensor([-1.0, 0.0], dtype=F64), torch.tensor([1.0, 0.0], dtype=F64)
    for side in (0.03, 0.08, 0.1, 0.12, 0.13):
        poses = torch.zeros(4000, 3, dtype=F64)
        poses[:, 1] = side
        poses[:, 2] = math.pi * torch.rand(4000, generator=generator, dtype=F64)
        missed = float((~sweep_rectangle(poses, HALF, start, end, RADIUS).hit).double().mean())
        told = CircleTouches.none(HALF, RADIUS, 0.005).with_way(start, end).log_likelihood(poses[:1, :2])
        assert float(told.exp()) == pytest.approx(missed, abs=0.03)


def test_a_touch_leaves_a_ring_behind_it():
    here = CircleTouches.none(HALF, RADIUS, 0.005)
    point, normal = torch.zeros(2, dtype=F64), torch.tensor([1.0, 0.0], dtype=F64)
    places = torch.tensor([[-0.05, 0.0], [-0.08, 0.05], [-0.2, 0.0], [0.08, 0.0], [0.0, 0.0]], dtype=F64)
    found = here.with_touch(point, normal).log_likelihood(places)
    assert found[:2].tolist() == pytest.approx([0.0, 0.0])
    assert bool((found[2:] < -40).all())


def test_no_true_place_is_ruled_out():
    generator = torch.Generator().manual_seed(1)
    poses = torch.rand(300, 3, generator=generator, dtype=F64) * torch.tensor([0.3, 0.3, 3.0])
    start, end = torch.rand(2, 300, 2, generator=generator, dtype=F64) - 0.3
    felt = sweep_rectangle(poses, HALF, start, end, RADIUS)
    for k in (felt.hit & (felt.distance > 0)).nonzero()[:, 0].tolist():
        touch = CircleTouches.none(HALF, RADIUS, 0.005).with_touch(felt.point[k], felt.normal[k])
        assert float(touch.log_likelihood(poses[k : k + 1, :2])) > -1e-12
    assert int(felt.hit.sum()) > 40


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_ways_that_are_no_numbers_are_refused(bad: float) -> None:
    here, nowhere = CircleTouches.none(HALF, RADIUS, 0.005), torch.tensor([0.0, bad], dtype=F64)
    for pair in ((HALF, nowhere), (nowhere, HALF)):
        with pytest.raises(ValueError, match="_w to be finite"):
            here.with_way(*pair)
