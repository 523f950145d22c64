"""Updates by a pose reading are the closed form of normal motion and noise."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from rumi.belief.pose_reading import MotionNoise, PoseReading, ReadingUpdate, pose_difference, update_by_reading

DOUBLE = {"dtype": torch.float64}
MOTION = MotionNoise(1e-4, 2e-4, 0.03)
NOISE = torch.tensor([1e-3, 1e-3, 0.02], **DOUBLE).square()
OTHERS = torch.tensor([[0.1, 0.1, 1.0], [0.01, 0.01, 0.2], [8e-3, 8e-3, 0.15], [0.03, 0.03, 0.5]], **DOUBLE).square()


def reading_of(value: Tensor, *, rates: tuple[float, float] = (0.01, 0.05), far: float = 0.0) -> PoseReading:
    back = torch.tensor([[0.0, 0.0, 0.0], [2e-3, 0.0, 0.1], [5e-3, -1e-3, 3.1]], **DOUBLE) + far
    return PoseReading(value, NOISE, OTHERS, back, NOISE * torch.tensor([[2.0], [2.0], [1e-4]], **DOUBLE), rates)


def particles(count: int, far: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    scale = torch.tensor([2e-3, 2e-3, 0.05], **DOUBLE)
    before = far + scale * torch.randn(count, 3, generator=generator, **DOUBLE)
    pushed = before + scale * torch.randn(count, 3, generator=generator, **DOUBLE)
    return before, pushed, torch.randn(count, generator=generator, **DOUBLE).log_softmax(-1)


def updated(reading: PoseReading, count: int, far: float = 0.0) -> ReadingUpdate:
    return update_by_reading(*particles(count, far), MOTION, reading, generator=torch.Generator().manual_seed(0))


def test_weights_and_densities_are_those_of_normal_motion_and_noise() -> None:
    value, count = torch.tensor([1e-3, -2e-3, 0.03], **DOUBLE), 5
    rates = (1e-12, 1e-12)
    found = updated(reading_of(value, rates=rates), count)
    before, pushed, log_weights = particles(count)
    variance = MOTION.variance(pushed - before) + NOISE
    normal = torch.distributions.Normal(pushed, variance.sqrt()).log_prob(value).sum(-1)
    np.testing.assert_allclose(found.log_weights, (log_weights + normal).log_softmax(-1), atol=1e-7)
    assert found.log_density == pytest.approx(float(torch.logsumexp(log_weights + normal, -1)), abs=1e-7)
    knocked = torch.distributions.Normal(pushed, (variance + OTHERS[3]).sqrt()).log_prob(value).sum(-1)
    assert float(found.others[3]) == pytest.approx(float(torch.logsumexp(log_weights + knocked, -1)), abs=1e-9)
    assert found.told == pytest.approx(1.0, abs=1e-4)
    assert found.effective == pytest.approx(1.0 / float(found.log_weights.exp().square().sum()))


def test_draws_are_of_the_posterior_given_the_reading() -> None:
    count = 100_000
    before, pushed = torch.zeros(1, 3, **DOUBLE), torch.tensor([[0.01, 0.0, 0.2]], **DOUBLE)
    value = torch.tensor([0.012, 1e-3, 0.17], **DOUBLE)
    even = torch.zeros(count, **DOUBLE).log_softmax(-1)
    found = update_by_reading(
        before.expand(count, 3),
        pushed.expand(count, 3),
        even,
        MOTION,
        reading_of(value, rates=(1e-9, 1e-9)),
        generator=torch.Generator().manual_seed(0),
    )
    variance = MOTION.variance(pushed - before)[0]
    gain = variance / (variance + NOISE)
    mean, deviation = pushed[0] + gain * (value - pushed[0]), ((1.0 - gain) * variance).sqrt()
    assert bool(((found.mean - mean).abs() < 5.0 * deviation / math.sqrt(count)).all())
    np.testing.assert_allclose(found.pose.std(0), deviation, rtol=5.0 / math.sqrt(2.0 * count))


@pytest.mark.parametrize("far", [1e3, 1e150])
def test_readings_and_poses_far_off_leave_numbers(far: float) -> None:
    for value in (torch.zeros(3, **DOUBLE), torch.full((3,), far, **DOUBLE)):
        found = updated(reading_of(value, far=far), 4, far)
        assert bool(found.log_weights.isfinite().all())
        assert bool(found.pose.isfinite().all())
        assert math.isfinite(found.told)
        assert found.told + found.untold <= 1.0 + 1e-9


def test_yaws_differ_by_the_short_way_round() -> None:
    first, second = torch.tensor([0.0, 0.0, 3.1], **DOUBLE), torch.tensor([[0.0, 0.0, -3.1]], **DOUBLE)
    np.testing.assert_allclose(pose_difference(first, second), [[0.0, 0.0, 6.2 - 2.0 * math.pi]], atol=1e-12)
