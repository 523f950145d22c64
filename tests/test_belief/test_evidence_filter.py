import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from rumi.belief.evidence_filter import EvidenceFilter, SoftResampler, SystematicResampler
from rumi.belief.particles import PoseBelief
from rumi.errors import DegenerateBeliefError
from sdf import se3
from sensors.evidence import Evidence

F64 = torch.float64
SEEN = (0.3, -0.1, 0.4)  # measurements of x


@dataclass(frozen=True)
class Measured:
    """A measurement of x with Gaussian noise."""

    value: float
    sigma: Tensor

    def log_likelihood(self, states: Tensor, /) -> Tensor:
        off = (states[..., 0, 3] - self.value) / self.sigma
        return -0.5 * off.square() - self.sigma.log() - 0.5 * math.log(2.0 * math.pi)


def beliefs(scenes, particles, seed=0):
    random = torch.Generator().manual_seed(seed)
    x = torch.randn(scenes, particles, generator=random, dtype=F64)
    return PoseBelief.uniform(se3.from_planar(torch.stack((x, 0.0 * x, 0.0 * x), -1)))


def log_evidence(track, start, sigma):
    total, belief = 0.0, start
    for value in SEEN:
        belief, log, _ = track(belief, [Measured(value, sigma)])
        total = total + log
    return total, belief


def exact(sigma):
    """Of x standard normal and measurements of it."""
    seen = torch.tensor(SEEN, dtype=F64)
    covariance = sigma.square() * torch.eye(3, dtype=F64) + 1.0
    return torch.distributions.MultivariateNormal(torch.zeros(3, dtype=F64), covariance).log_prob(seen)


def random(seed=0):
    return torch.Generator().manual_seed(seed)


RESAMPLERS = {"systematic": SystematicResampler, "soft": SoftResampler}


@pytest.mark.parametrize("kind", RESAMPLERS)
def test_the_log_evidence_is_the_exact_one(kind):
    sigma = torch.tensor(0.3, dtype=F64)
    track = EvidenceFilter(RESAMPLERS[kind](random()), trigger=1.0)
    found, belief = log_evidence(track, beliefs(1, 100_000), sigma)
    assert float(found) == pytest.approx(float(exact(sigma)), abs=0.02)
    precision = 1.0 + 3.0 / 0.09
    mean = (belief.weights * belief.attached_T_object[..., 0, 3]).sum()
    assert float(mean) == pytest.approx(sum(SEEN) / 0.09 / precision, abs=0.01)


def test_without_resampling_the_gradient_is_that_of_finite_differences():
    track, start = EvidenceFilter(SystematicResampler(random()), trigger=0.0), beliefs(2, 20)
    sigma = torch.tensor(0.5, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda one: log_evidence(track, start, one)[0], sigma)


def slopes(make, sigma, scenes=40_000, particles=12, eps=0.02):
    """Mean gradient over many draws, finite difference of the mean, and the standard error of their difference."""
    start, at = beliefs(scenes, particles), torch.tensor(sigma, dtype=F64)

    def each(value):
        return log_evidence(EvidenceFilter(make(random(1)), trigger=1.0), start, value)[0]

    own = at.expand(scenes, 1).clone().requires_grad_()
    (slope,) = torch.autograd.grad(each(own).sum(), own)
    with torch.no_grad():
        difference = (each(at + eps) - each(at - eps)) / (2.0 * eps)
    error = (slope[:, 0] - difference).std() / math.sqrt(scenes)
    return float(slope.mean()), float(difference.mean()), float(error)


class Plain(SystematicResampler):
    """Without a slope, as resampling is where nobody minds."""

    def forward(self, states, log_weights):
        drawn, log_weights = super().forward(states, log_weights.detach())
        return drawn, log_weights


def test_bias_against_finite_differences_of_the_expected_loss():
    # mean over 40 000 beliefs of a dozen particles each, all resampled at every step
    found = {name: slopes(make, 0.4) for name, make in (RESAMPLERS | {"plain": Plain}).items()}
    bias = {name: abs(own - truth) / abs(truth) for name, (own, truth, _) in found.items()}
    noise = {name: 3.0 * error / abs(truth) for name, (_, truth, error) in found.items()}
    assert bias["systematic"] < 0.1 + noise["systematic"]
    assert bias["soft"] < 0.3 + noise["soft"]
    assert bias["plain"] > 2.0 * bias["systematic"]


def test_only_poor_scenes_are_resampled_and_each_draws_its_own():
    sharp, blunt = torch.tensor([[0.05], [50.0]], dtype=F64), torch.tensor([[0.05]], dtype=F64)
    start = beliefs(1, 50)
    both = PoseBelief.uniform(start.attached_T_object.expand(2, 50, 4, 4))
    together, log, info = EvidenceFilter(SystematicResampler([random(3), random(4)]))(both, [Measured(0.1, sharp)])
    assert info.resampled.tolist() == [True, False]
    alone, own, _ = EvidenceFilter(SystematicResampler([random(3)]))(start, [Measured(0.1, blunt)])
    assert torch.equal(together.attached_T_object[0], alone.attached_T_object[0]) and torch.equal(log[0], own[0])
    assert torch.equal(together.attached_T_object[1], start.attached_T_object[0])


def test_another_packages_resampler_and_a_move():
    def transport(states, log_weights):  # each particle becomes the mean: a transport in the extreme
        mean = (log_weights.exp()[..., None] * states).sum(-2, keepdim=True)
        return mean.expand_as(states), torch.zeros_like(log_weights), "and more"

    turned = se3.exp(0.2 * torch.randn(3, 30, 6, generator=random(), dtype=F64))
    track = EvidenceFilter(transport, trigger=1.0, move=lambda belief: belief.moved(torch.eye(4, dtype=F64)))
    belief, _, info = track(PoseBelief.uniform(turned), [Measured(0.1, torch.tensor(0.1, dtype=F64))])
    rotation = belief.attached_T_object[..., :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=F64).expand_as(rotation))
    assert info.resampled.all() and torch.allclose(belief.weights.sum(-1), torch.ones(3, dtype=F64))


def test_no_evidence_changes_nothing_and_what_cannot_be_is_refused():
    start, track = beliefs(2, 5), EvidenceFilter(SystematicResampler(random()))
    belief, log, _ = track(start, [])
    assert torch.allclose(log, torch.zeros(2, dtype=F64)) and torch.allclose(belief.log_weights, start.log_weights)
    with pytest.raises(ValueError, match="share of the particles"):
        EvidenceFilter(SystematicResampler(random()), trigger=2.0)
    with pytest.raises(ValueError, match="share above 0"):
        SoftResampler(random(), 0.0)
    with pytest.raises(DegenerateBeliefError):
        track(start, [Measured(math.inf, torch.tensor(1.0, dtype=F64))])
    assert isinstance(Measured(0.0, torch.ones(())), Evidence)
