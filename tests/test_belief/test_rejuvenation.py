"""Metropolis moves of resampled poses: the exact posterior, the score, and scenes each as alone."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from rumi.belief.evidence_filter import EvidenceFilter, SystematicResampler
from rumi.belief.rejuvenation import rejuvenate
from sdf.containers import container, index
from tests.test_belief.test_evidence_filter import F64, SEEN, Measured, beliefs, random

VALUES = [*SEEN] * 5


def standard(planar):
    return -0.5 * planar[..., :2].square().sum(-1)


def follow(sigma, *, moves):
    """Beliefs of thirty poses, resampled at each of 15 measurements of x; and their log evidence."""
    track, draw = EvidenceFilter(SystematicResampler(random()), trigger=1.0), random(1)
    belief, seen, total = beliefs(300, 30), [], torch.zeros((), dtype=F64)
    for value in VALUES:
        seen.append(Measured(value, sigma))
        belief, log, info = track(belief, seen[-1:])
        if moves:
            belief = rejuvenate(belief, seen, standard, rows=info.resampled, generator=draw, jitter_m=(0.03, 0.5))
        total = total + log.mean()
    return belief.attached_T_object[..., :2, 3].detach().unbind(-1), total


def test_moves_leave_the_posterior_as_it_is_and_part_the_copies():
    sigma = torch.tensor(0.2, dtype=F64)
    (x, y), _ = follow(sigma, moves=True)
    precision = 1.0 + len(VALUES) / 0.04
    assert float(x.mean()) == pytest.approx(sum(VALUES) / 0.04 / precision, abs=0.01)
    assert float(x.std()) == pytest.approx(precision**-0.5, rel=0.1)
    assert float(y.std()) == pytest.approx(1.0, rel=0.1), "spread as by the prior: nothing was measured of it"
    (copies, _), _ = follow(sigma, moves=False)
    assert copies[0].unique().numel() < 10 < 28 < min(row.unique().numel() for row in x)


def test_the_log_evidence_and_its_slope_are_nearer_to_the_exact_ones_with_moves():
    sigma = torch.tensor(0.2, dtype=F64, requires_grad=True)
    count = len(VALUES)
    normal = torch.distributions.MultivariateNormal(
        torch.zeros(count, dtype=F64), sigma.square() * torch.eye(count, dtype=F64) + 1.0
    )
    truth = normal.log_prob(torch.tensor(VALUES, dtype=F64))
    (slope,) = torch.autograd.grad(truth, sigma)
    off = []
    for moves in (True, False):
        _, total = follow(sigma, moves=moves)
        (found,) = torch.autograd.grad(total, sigma)
        off.append((abs(float(total.detach() - truth.detach())), abs(float(found - slope))))
    assert off[0][0] < 0.3 * off[1][0] and off[0][1] < 0.3 * off[1][1], off


def test_scenes_are_moved_each_as_alone_and_only_those_asked_for():
    sigma = torch.tensor([[0.1], [0.2], [0.3]], dtype=F64)
    start, rows = beliefs(3, 11), torch.tensor([True, False, True])
    seen = Of(sigma)
    together = rejuvenate(start, [seen], standard, rows=rows, generator=[random(k) for k in range(3)])
    assert torch.equal(together.attached_T_object[1], start.attached_T_object[1])
    for row in (0, 2):
        alone, one = index(start, row), torch.tensor(True)
        moved = rejuvenate(alone, [Of(sigma[row])], standard, rows=one, generator=random(row))
        assert torch.equal(together.attached_T_object[row], moved.attached_T_object)
        assert not torch.equal(moved.attached_T_object, alone.attached_T_object)
    none = rejuvenate(start, [seen], standard, rows=torch.zeros(3, dtype=torch.bool), generator=random())
    assert none is start
    lone = rejuvenate(beliefs(1, 1), [Of(sigma[:1])], standard, rows=torch.tensor([True]), generator=random())
    assert torch.isfinite(lone.attached_T_object).all()
    with pytest.raises(ValueError, match="rows of one scene, or of a batch"):
        rejuvenate(start, [seen], standard, rows=rows[:2], generator=random())


@container()
@dataclass(frozen=True)
class Of:
    """A measurement of x with noise of each scene's own."""

    sigma: Tensor

    def log_likelihood(self, states: Tensor, /) -> Tensor:
        return Measured(0.3, self.sigma).log_likelihood(states)


def test_the_weights_have_the_score_of_evidence_and_prior():
    """The slope of a posterior's expectation by the weights is that of finite differences of the reweighted mean."""
    sigma = torch.tensor(0.4, dtype=F64, requires_grad=True)
    moved = rejuvenate(beliefs(1, 50), [Measured(0.3, sigma)], standard, rows=torch.tensor([True]), generator=random())
    poses, log = moved.attached_T_object.detach(), moved.log_weights
    assert torch.allclose(log.exp(), torch.full_like(log, 1 / 50))
    (found,) = torch.autograd.grad((log.exp() * poses[..., 0, 3]).sum(), sigma)

    def mean(value):
        change = Measured(0.3, value).log_likelihood(poses) - Measured(0.3, sigma.detach()).log_likelihood(poses)
        return float((change.softmax(-1) * poses[..., 0, 3]).sum())

    difference = (mean(sigma.detach() + 1e-5) - mean(sigma.detach() - 1e-5)) / 2e-5
    assert float(found) == pytest.approx(difference, rel=1e-6)
