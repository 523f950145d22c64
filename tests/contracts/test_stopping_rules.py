"""Contract of the stopping rules: what holds for every rule that says whether a belief is sure."""

import math
from collections.abc import Callable

import pytest
import torch

from rumi.information.state_rules import CovarianceRule, MassRule

Rule = Callable[[torch.Tensor, torch.Tensor], bool]
RULES: dict[str, Rule] = {
    "covariance": CovarianceRule((0.01, 0.01)).holds,
    "mass": lambda states, log: MassRule(0.01).holds(states[:, None], log),
}


@pytest.fixture(params=RULES)
def rule(request: pytest.FixtureRequest) -> Rule:
    return RULES[request.param]


def belief(spread: float, count: int = 200) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(0)
    states = spread * torch.randn(count, 2, generator=random, dtype=torch.float64)
    return states, torch.randn(count, generator=random, dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_narrow_belief_is_sure_and_a_wide_one_is_not(rule, dtype):
    for spread, sure in ((0.001, True), (0.1, False)):
        states, log = (part.to(dtype) for part in belief(spread))
        assert rule(states, log) is sure


def test_one_particle_and_coincident_particles_are_sure(rule):
    assert rule(torch.zeros(1, 2), torch.zeros(1))
    assert rule(torch.ones(20, 2), torch.zeros(20))


def test_only_weights_up_to_a_factor_count(rule):
    for spread in (0.001, 0.005, 0.01, 0.1):
        states, log = belief(spread)
        assert rule(states, log + 5.0) is rule(states, log)


def test_particles_without_weight_do_not_count(rule):
    states, log = belief(0.001)
    far = torch.cat((states, states[:5] + 3.0))
    assert rule(far, torch.cat((log, torch.full((5,), -math.inf, dtype=log.dtype))))


def test_far_coordinates_change_nothing(rule):
    for spread in (0.001, 0.1):
        states, log = belief(spread)
        assert rule(states + 1000.0, log) is rule(states, log)


def test_invalid_beliefs_are_refused(rule):
    with pytest.raises(ValueError, match=r"Expected (one state or more|at least one particle)"):
        rule(torch.zeros(0, 2), torch.zeros(0))
    for weight in (-math.inf, math.nan):
        with pytest.raises(ValueError, match="Expected a finite log-weight"):
            rule(torch.zeros(3, 2), torch.full((3,), weight))
