"""Stopping rules: closed forms of Gaussians, and beliefs that look sure and are not."""

import math

import pytest
import torch

from rumi.information.state_rules import CovarianceRule, MassRule, covariance


def gaussian(count: int = 20000, spread: tuple[float, ...] = (0.01, 0.02, 0.1)) -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    return torch.randn(count, len(spread), generator=random, dtype=torch.float64) * torch.tensor(spread).double()


def even(states: torch.Tensor) -> torch.Tensor:
    return states.new_zeros(len(states))


def holes(states: torch.Tensor, offset: float = 0.05) -> torch.Tensor:
    """Two holes of a rectangle at (x, y, yaw), either side of its middle."""
    way = offset * torch.stack((states[:, 2].cos(), states[:, 2].sin()), -1)
    return states[:, None, :2] + torch.stack((way, -way), 1)


def test_covariance_of_a_gaussian() -> None:
    states = gaussian()
    expected = torch.diag(torch.tensor([1e-4, 4e-4, 1e-2], dtype=torch.float64))
    torch.testing.assert_close(covariance(states, even(states)), expected, atol=2e-4, rtol=0.05)


def test_covariance_with_weights_is_that_of_copies() -> None:
    states, counts = gaussian(50), torch.arange(1, 51)
    copies = states.repeat_interleave(counts, 0)
    found = covariance(states, counts.double().log())
    torch.testing.assert_close(found, copies.mT.cov(correction=0))


def test_covariance_knows_of_angles() -> None:
    states = gaussian()
    away = states + torch.tensor([0.0, 0.0, math.pi]).double()
    wrapped = away.clone()
    wrapped[:, 2] = torch.remainder(wrapped[:, 2] + math.pi, 2 * math.pi) - math.pi
    periods = (None, None, 2 * math.pi)
    plain, other = covariance(states, even(states)), covariance(wrapped, even(states), periods)
    torch.testing.assert_close(other, plain, atol=2e-5, rtol=2e-3)
    assert float(covariance(wrapped, even(states))[2, 2]) > 5.0
    # half a turn is nothing where the object looks the same
    turned = states.clone()
    turned[::2, 2] += math.pi
    folded = covariance(turned, even(states), (None, None, math.pi))
    torch.testing.assert_close(folded, plain, atol=2e-5, rtol=2e-3)


def test_covariance_rule_looks_in_every_direction() -> None:
    states = gaussian()
    assert CovarianceRule((0.011, 0.022, 0.11)).holds(states, even(states))
    assert not CovarianceRule((0.011, 0.018, 0.11)).holds(states, even(states))
    assert CovarianceRule((0.005, 0.005, 0.05)).spread(states, even(states)) == pytest.approx(4.0, rel=0.02)
    # each dimension alone is within bounds; their diagonal is not
    together = gaussian(spread=(0.01,)).expand(-1, 2)
    assert CovarianceRule((0.011, 0.011)).spread(together, even(together)) == pytest.approx(
        math.sqrt(2) / 1.1, rel=0.02
    )


def test_mass_of_a_gaussian() -> None:
    """A single target with a spread of 3 mm: P(within r) = 1 - exp(-r^2 / 2 s^2)."""
    states = gaussian(4000, (0.003, 0.003))
    aim = MassRule(0.005).aim(states[:, None], even(states))
    assert aim.probability == pytest.approx(1 - math.exp(-(0.005**2) / (2 * 0.003**2)), abs=0.03)
    assert float(aim.points.norm()) < 0.001
    assert MassRule(0.005, 0.7).holds(states[:, None], even(states))
    assert not MassRule(0.005, 0.8).holds(states[:, None], even(states))


def test_half_a_turn_is_the_same_where_the_holes_are_alike() -> None:
    states = gaussian(500, (0.001, 0.001, 0.01))
    states[::2, 2] += math.pi
    targets = holes(states)
    assert MassRule(0.005).aim(targets, even(states)).probability > 0.98


def test_two_modes_are_not_sure() -> None:
    states = gaussian(1000, (0.001, 0.001, 0.01))
    states[600:, 0] += 0.1
    aim = MassRule(0.005).aim(holes(states), even(states))
    assert aim.probability == pytest.approx(0.6, abs=0.01)
    assert float(aim.points.mean(0)[0].abs()) < 0.005


def test_the_mean_is_tried_beside_the_particles() -> None:
    """No particle lies in the middle of a ring, from which all are within reach."""
    way = torch.linspace(0, 2 * math.pi, 41)[:-1]
    ring = 0.003 * torch.stack((way.cos(), way.sin()), -1)[:, None]
    assert MassRule(0.0045).aim(ring, torch.zeros(40)).probability == pytest.approx(1.0)


def test_refuses_what_has_no_meaning() -> None:
    for wrong in ({"tolerance_m": 0.0}, {"probability": 1.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            MassRule(**{"tolerance_m": 0.01} | wrong)
    with pytest.raises(ValueError, match="most above 0"):
        CovarianceRule((0.1, 0.0))
    with pytest.raises(ValueError, match="one period"):
        CovarianceRule((0.1, 0.1), (None,))
    with pytest.raises(ValueError, match="at least one"):
        MassRule(0.01).aim(torch.zeros(0, 2, 2), torch.zeros(0))
    with pytest.raises(ValueError, match="alike"):
        MassRule(0.01).aim(torch.zeros(3, 5, 2), torch.zeros(3))
