"""A belief over what does not move."""

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from rumi.belief.static_filter import ResampleMoveFilter, ResampleMoveSettings, TemperedEvidence
from rumi.errors import DegenerateBeliefError
from rumi.information.neighbours import StateMetric
from sdf import skipped_work
from sensors.touch.rectangle_touch import RectangleTouches
from sensors.touch.touch_likelihood import TouchNoise

F64 = torch.float64
METRICS = {"place": StateMetric.euclidean(2), "plane": StateMetric.planar(0.1)}


def drawn(metric, count, generator, spread=0.3):
    return spread * torch.randn(count, metric.dims, generator=generator, dtype=F64)


def flat(states):
    return torch.zeros(len(states), dtype=states.dtype)


@dataclass
class Gauss:
    """Readings of x and y with Gaussian noise."""

    readings: Tensor
    noise: float

    def log_likelihood(self, states):
        return -0.5 * ((self.readings[:, None] - states[:, :2]) / self.noise).square().sum((0, 2))


def test_it_is_the_posterior_of_a_gaussian():
    """Readings one by one, with particles resampled and moved on the way: mean and spread in closed form."""
    generator = torch.Generator().manual_seed(1)
    truth, noise, prior = torch.tensor([0.12, -0.07], dtype=F64), 0.01, 0.1
    readings = truth + noise * torch.randn(12, 2, generator=generator, dtype=F64)
    follow = ResampleMoveFilter(StateMetric.euclidean(2), lambda s: -0.5 * (s / prior).square().sum(-1))
    belief = follow.start(prior * torch.randn(2000, 2, generator=generator, dtype=F64))
    resampled = 0
    for k in range(len(readings)):
        every = Gauss(readings[: k + 1], noise)
        belief, info = follow.update(belief, Gauss(readings[k : k + 1], noise), every, generator=generator)
        resampled += info.resampled
        assert not info.resampled or 0.05 < info.accepted < 0.95
    assert resampled >= 3
    precision = prior**-2 + len(readings) * noise**-2
    mean = readings.sum(0) * noise**-2 / precision
    weights = belief.log_weights.exp()
    found = (weights[:, None] * belief.states).sum(0)
    spread = (weights[:, None] * (belief.states - found).square()).sum(0).sqrt()
    assert float((found - mean).abs().max()) < 4 * precision**-0.5 / math.sqrt(500)
    assert torch.allclose(spread, torch.full((2,), precision**-0.5, dtype=F64), rtol=0.1)
    best = belief.best
    assert float((best - mean).norm()) < precision**-0.5
    assert torch.allclose(belief.log_target, follow.log_target(belief.states, Gauss(readings, noise)), atol=1e-6)


@pytest.mark.parametrize("metric", METRICS.values(), ids=METRICS)
def test_moves_leave_a_distribution_as_it_is(metric):
    """Particles of a Gaussian in the metric stay so, in place and in every turn."""
    generator = torch.Generator().manual_seed(2)
    centre = drawn(metric, 1, generator)
    widths = torch.tensor([0.02, 0.05, 0.2][: metric.dims], dtype=F64)

    def log_prior(states):
        apart = metric.difference(states, centre.expand_as(states))
        return -0.5 * (apart / widths).square().sum(-1)

    def spread(states):
        return metric.difference(states, centre.expand_as(states)).square().mean(0).sqrt()

    follow = ResampleMoveFilter(metric, log_prior, ResampleMoveSettings(moves=30))
    # too wide at first: moves must bring it in
    steps = 2.0 * widths * torch.randn(1000, metric.dims, generator=generator, dtype=F64)
    belief = follow.start(centre + steps)
    for _ in range(3):
        belief, _ = follow.move(belief, None, ess=0.0, generator=generator)
    assert torch.allclose(spread(belief.states), widths, rtol=0.15)


def test_nothing_is_predicted():
    generator = torch.Generator().manual_seed(3)
    states = drawn(StateMetric.planar(0.1), 30, generator)
    reading = Gauss(torch.zeros(1, 2, dtype=F64), 10.0)
    with skipped_work.account() as account:
        still = ResampleMoveFilter(StateMetric.planar(0.1), flat)
        belief, info = still.update(still.start(states), reading, reading, generator=generator)
        assert torch.equal(belief.states, states) and not info.resampled
    assert account.skipped() == {"predictions": 1.0}


def test_one_particle_moves_as_often_as_others():
    generator = torch.Generator().manual_seed(0)
    asked = []

    def log_prior(states):
        asked.append(len(states))
        return flat(states)

    follow = ResampleMoveFilter(StateMetric.euclidean(2), log_prior, ResampleMoveSettings(moves=6))
    for count in (1, 2, 3):
        belief = follow.start(torch.zeros(count, 2, dtype=F64))
        asked.clear()
        moved, info = follow.move(belief, None, ess=1.0, generator=generator)
        assert sum(asked) == 6 * count and info.accepted == 1.0
        assert not bool((moved.states == 0).any())


class Nowhere:
    """What cannot be anywhere."""

    def log_likelihood(self, states):
        return torch.full((len(states),), -math.inf, dtype=F64)


def test_a_reading_that_nothing_explains():
    follow = ResampleMoveFilter(StateMetric.planar(0.1), flat)
    belief = follow.start(torch.zeros(5, 3, dtype=F64))
    for update in (follow.update, follow.update_tempered):
        with pytest.raises(DegenerateBeliefError, match="No particle explains"):
            update(belief, Nowhere(), Nowhere(), generator=torch.Generator().manual_seed(0))
    empty = RectangleTouches.none(torch.tensor([0.1, 0.05], dtype=F64), TouchNoise(), 0.01)
    assert torch.equal(follow.log_target(belief.states, empty), torch.zeros(5, dtype=F64))


FOLLOW = ResampleMoveFilter(StateMetric.euclidean(2), lambda states: torch.zeros(len(states), dtype=F64))


@dataclass
class TwoPlaces:
    """Either of two places, as likely, each with Gaussian noise."""

    noise: float

    def log_likelihood(self, states):
        places = torch.tensor([[-0.3, 0.0], [0.3, 0.1]], dtype=F64)
        return -0.5 * (states[:, None] - places).square().sum(-1).amin(-1) / self.noise**2


def square(seed, follow=FOLLOW):
    generator = torch.Generator().manual_seed(seed)
    return follow.start(torch.rand(400, 2, generator=generator, dtype=F64) - 0.5), generator


def test_both_modes_live_on():
    noise = 1e-4
    told = TwoPlaces(noise)
    follow = ResampleMoveFilter(StateMetric.euclidean(2), FOLLOW.log_prior, ResampleMoveSettings(jitter_m=(3e-5, 0.05)))
    lost = 0
    for seed in range(5):
        belief, generator = square(seed, follow)
        after = follow.update_tempered(belief, told, told, generator=generator)
        weights, left = after.log_weights.exp(), after.states[:, 0] < 0
        assert 0.3 < float(weights[left].sum()) < 0.7
        # each of the two as wide as the noise says
        off = after.states[left] - torch.tensor([-0.3, 0.0])
        share = weights[left] / weights[left].sum()
        assert float((share @ off.square().sum(-1) / 2.0).sqrt()) == pytest.approx(noise, rel=0.3)
        assert torch.allclose(after.log_target, told.log_likelihood(after.states), atol=1e-6)
        plain, _ = follow.update(belief, told, told, generator=generator)
        share = float(plain.log_weights.exp()[plain.states[:, 0] < 0].sum())
        lost += share < 0.05 or share > 0.95
    assert lost >= 3  # what it is for


def test_what_is_not_sharp_goes_in_at_once():
    told = TwoPlaces(0.5)
    belief, generator = square(0)
    before = generator.get_state()
    after = FOLLOW.update_tempered(belief, told, told, generator=generator)
    plain, _ = FOLLOW.update(belief, told, told, generator=generator)
    assert torch.equal(generator.get_state(), before)
    assert torch.equal(after.states, plain.states) and torch.allclose(after.log_weights, plain.log_weights)


def test_a_power_of_the_new_evidence_alone():
    old, new = TwoPlaces(0.2), TwoPlaces(0.1)

    class Both:
        def log_likelihood(self, states):
            return old.log_likelihood(states) + new.log_likelihood(states)

    states = square(0)[0].states
    for power in (0.0, 0.3, 1.0):
        expected = old.log_likelihood(states) + power * new.log_likelihood(states)
        assert torch.allclose(TemperedEvidence(Both(), new, power).log_likelihood(states), expected)
    assert bool((TemperedEvidence(Nowhere(), Nowhere(), 0.5).log_likelihood(states) == -torch.inf).all())
