"""Readings far more exact than particles are apart."""

from dataclasses import dataclass

import pytest
import torch

from rumi.belief.state_space import PlaneSpace
from rumi.belief.static_filter import ResampleMoveFilter, ResampleMoveSettings, TemperedEvidence
from rumi.errors import DegenerateBeliefError

F64 = torch.float64
FOLLOW = ResampleMoveFilter(PlaneSpace(None), lambda states: torch.zeros(len(states), dtype=F64))


@dataclass
class TwoPlaces:
    """Either of two places, as likely, each with Gaussian noise."""

    noise: float

    def log_likelihood(self, states):
        places = torch.tensor([[-0.3, 0.0], [0.3, 0.1]], dtype=F64)
        return -0.5 * (states[:, None] - places).square().sum(-1).amin(-1) / self.noise**2


class Nowhere:
    """What cannot be anywhere."""

    def log_likelihood(self, states):
        return torch.full((len(states),), -torch.inf, dtype=F64)


def start(seed, follow=FOLLOW):
    generator = torch.Generator().manual_seed(seed)
    return follow.start(torch.rand(400, 2, generator=generator, dtype=F64) - 0.5), generator


def test_both_modes_live_on():
    noise = 1e-4
    told = TwoPlaces(noise)
    follow = ResampleMoveFilter(PlaneSpace(None), FOLLOW.log_prior, ResampleMoveSettings(jitter_m=(3e-5, 0.05)))
    lost = 0
    for seed in range(5):
        belief, generator = start(seed, follow)
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
    belief, generator = start(0)
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

    states = start(0)[0].states
    for power in (0.0, 0.3, 1.0):
        expected = old.log_likelihood(states) + power * new.log_likelihood(states)
        assert torch.allclose(TemperedEvidence(Both(), new, power).log_likelihood(states), expected)
    assert bool((TemperedEvidence(Nowhere(), Nowhere(), 0.5).log_likelihood(states) == -torch.inf).all())


def test_what_no_particle_explains_is_refused():
    belief, generator = start(0)
    with pytest.raises(DegenerateBeliefError, match="No particle explains"):
        FOLLOW.update_tempered(belief, Nowhere(), Nowhere(), generator=generator)
