"""Times of motions: the paper's figures, the integral of the speed, and what must hold of any."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rumi.robot.motion_time import SpeedLimits, path_time, poke_time, travel_time

LIMITS = SpeedLimits(0.25, 0.5)
POSITIVE = st.floats(0.01, 2.0)


def wide(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_golden(golden):
    case = golden("s003.texec")
    for (distance, speed, acceleration), expected in zip(case["inputs"]["D_v_a"], case["expected"]["t"], strict=True):
        found = travel_time(wide(distance), SpeedLimits(speed, acceleration))
        torch.testing.assert_close(found, wide(expected), atol=case["atol"], rtol=0)
    both = travel_time(wide(0.3, 0.1), LIMITS).sum()
    assert float(both) == pytest.approx(case["expected"]["t_two_segments_0p3_0p1"], abs=case["atol"])


@given(POSITIVE, POSITIVE, POSITIVE)
def test_the_speed_over_that_time_covers_the_distance(distance: float, speed: float, acceleration: float) -> None:
    took = float(travel_time(wide(distance), SpeedLimits(speed, acceleration)))
    at = torch.linspace(0.0, took, 20001, dtype=torch.float64)
    profile = torch.minimum(acceleration * torch.minimum(at, took - at), torch.tensor(speed))
    assert float(torch.trapezoid(profile, at)) == pytest.approx(distance, rel=1e-5)


def test_both_branches_meet() -> None:
    edge = LIMITS.speed_m_s**2 / LIMITS.acceleration_m_s2
    below, at, above = travel_time(wide(edge * (1 - 1e-9), edge, edge * (1 + 1e-9)), LIMITS).tolist()
    assert below == pytest.approx(at, abs=1e-8)
    assert above == pytest.approx(at, abs=1e-8)
    assert at == pytest.approx(2 * LIMITS.speed_m_s / LIMITS.acceleration_m_s2)


def test_longer_ways_take_longer() -> None:
    took = travel_time(torch.linspace(0.0, 1.0, 500, dtype=torch.float64), LIMITS)
    assert bool((took.diff() > 0).all())
    assert took[0] == 0.0


def test_a_poke_is_two_motions_with_a_rest_between() -> None:
    start, standoff, target = torch.zeros(2, 3), torch.tensor([0.3, 0.0, 0.0]), torch.tensor([0.3, 0.1, 0.0])
    each = travel_time(torch.tensor([0.3, 0.1]), LIMITS)
    torch.testing.assert_close(poke_time(start, standoff, target, LIMITS), each.sum().expand(2))
    slow = SpeedLimits(0.01, 0.5)
    expected = each[0] + travel_time(torch.tensor(0.1), slow)
    torch.testing.assert_close(poke_time(start, standoff, target, LIMITS, slow), expected.expand(2))
    path = torch.stack((start[0], standoff, target))
    torch.testing.assert_close(path_time(path, LIMITS), each.sum())
    assert float(path_time(path[:1], LIMITS)) == 0.0
    assert path_time(torch.zeros(0, 5, 3), LIMITS).shape == (0,)


def test_gradient() -> None:
    distance = wide(0.01, 0.1, 0.2, 1.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: travel_time(d, LIMITS), distance)


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_refuses_limits_that_never_arrive(value: float) -> None:
    with pytest.raises(ValueError, match="speed_m_s"):
        SpeedLimits(value, 1.0)
    with pytest.raises(ValueError, match="acceleration_m_s2"):
        SpeedLimits(1.0, value)


def test_refuses_negative_distances() -> None:
    with pytest.raises(ValueError, match="distances"):
        travel_time(wide(0.1, -0.1), LIMITS)
