"""Binary contact: golden numbers, distances spelt out, and how the model compares with the binary one."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from sdf import se3
from sdf.primitives import Sphere
from sensors.touch.contact_model import (
    ContactModel,
    proximity_probability,
    robot_distance,
    touching_probability,
)

F64 = torch.float64
BALL = Sphere(0.05).double()


def test_golden_proximity(golden: Callable[[str], dict[str, Any]]) -> None:
    case = golden("meas.eq10")
    given, expected = case["inputs"], torch.tensor(case["expected"]["p1"], dtype=F64)
    distance = torch.tensor(given["d"], dtype=F64)
    found = proximity_probability(distance, given["alpha_tp"], given["alpha_fp"], given["gamma"])
    torch.testing.assert_close(found, expected, atol=case["atol"], rtol=0)
    # not clamped, it would be no probability
    assert case["expected"]["p1_unclamped"][0] > 1
    assert float(found.max()) <= given["alpha_tp"]
    module = ContactModel(given["alpha_tp"], given["alpha_fp"], given["gamma"])
    torch.testing.assert_close(module(distance), expected, atol=case["atol"], rtol=0)


def test_the_binary_model_is_the_proximity_model_without_reach(generator: torch.Generator) -> None:
    distance = 0.05 * torch.randn(100, generator=generator, dtype=F64)
    sharp = proximity_probability(distance, 0.9, 0.05, 1e9)
    torch.testing.assert_close(touching_probability(distance, 0.9, 0.05), sharp)
    torch.testing.assert_close(ContactModel(0.9, 0.05, None)(distance), sharp)
    near = ContactModel(0.9, 0.05, None, tolerance=0.01)(torch.tensor([0.009, 0.011], dtype=F64))
    assert near.tolist() == pytest.approx([0.9, 0.05])


def test_gradients_reach_distance_and_parameters() -> None:
    model = ContactModel(trainable=True)
    assert {name for name, _ in model.named_parameters()} == {
        "raw_true_positive",
        "raw_false_positive",
        "raw_decay",
    }
    distance = torch.tensor([0.0005, 0.002], dtype=F64, requires_grad=True)
    contact = torch.tensor([True, False])
    model.log_likelihood(distance, contact).sum().backward()
    assert float(model.raw_decay.grad.abs()) > 0
    assert torch.autograd.gradcheck(lambda d: model.log_likelihood(d, contact), distance)
    assert "decay" in ContactModel().state_dict()


def arm(generator: torch.Generator, batch: tuple[int, ...] = (), instants: int = 4) -> Tensor:
    """Points of two links at some instants."""
    points = 0.08 * torch.randn(*batch, instants, 12, 3, generator=generator, dtype=F64)
    points[..., 6:, 0] += 0.1
    return points


def poses(generator: torch.Generator, batch: tuple[int, ...] = (), count: int = 7) -> Tensor:
    return se3.exp(0.1 * torch.randn(*batch, count, 6, generator=generator, dtype=F64))


def test_distance_is_that_of_the_nearest_point_of_all_links(generator: torch.Generator) -> None:
    points, where = arm(generator), poses(generator)
    found = robot_distance(BALL, where, points)
    for n in range(7):
        for k in range(4):
            expected = min(math.dist(p, where[n, :3, 3].tolist()) - 0.05 for p in points[k].tolist())
            assert float(found[n, k]) == pytest.approx(expected, abs=1e-12)


def test_sure_rates_never_give_minus_infinity() -> None:
    sure = ContactModel(1.0, 0.0, None)
    told = sure.log_likelihood(torch.tensor([-0.01, 0.0, 0.1], dtype=F64), torch.tensor([False, True, True]))
    assert bool(torch.isfinite(told).all())


def test_without_points_the_robot_is_infinitely_far(generator: torch.Generator) -> None:
    assert torch.equal(
        robot_distance(BALL, poses(generator), torch.zeros(3, 0, 3, dtype=F64)),
        torch.full((7, 3), torch.inf, dtype=F64),
    )


def test_refusals() -> None:
    with pytest.raises(ValueError, match="true_positive"):
        ContactModel(1.2)
    for decay in (0.0, float("inf"), float("nan"), 1e300):
        with pytest.raises(ValueError, match="decay above 0"):
            ContactModel(decay=decay)
    steep = ContactModel(0.9, 0.1, 1e11)(torch.tensor([-1.0, 0.0, 1e-9, 1e30]))
    torch.testing.assert_close(steep, torch.tensor([0.9, 0.9, 0.1, 0.1]))


@pytest.mark.parametrize("rate", [1.0, 1.0 - 1e-9])
def test_silence_at_touch_is_told_from_silence_near_it_in_float32(rate: float) -> None:
    distance = torch.tensor([0.0, 1e-11, 1e-8, 1e-5])
    found = ContactModel(rate, 0.0, 1000.0).log_likelihood(distance, torch.zeros(4, dtype=torch.bool), floor=1e-30)
    wanted = (1.0 - rate) - rate * torch.expm1(-1000.0 * distance.double())
    torch.testing.assert_close(found.double(), wanted.clamp_min(1e-30).log(), rtol=1e-6, atol=1e-5)


def test_silence_of_the_binary_model() -> None:
    found = ContactModel(0.9, 0.1, None).log_likelihood(torch.tensor([0.0, 1.0]), torch.zeros(2, dtype=torch.bool))
    torch.testing.assert_close(found, torch.tensor([0.1, 0.9]).log())


def test_what_is_infinitely_far_trains_nothing_to_nan() -> None:
    distance = torch.tensor([math.inf, 0.001], dtype=F64)
    for contact in (True, False):
        model = ContactModel(trainable=True)
        told = model.log_likelihood(distance, torch.tensor([contact] * 2))
        told.sum().backward()
        gradients = {name: p.grad for name, p in model.named_parameters()}
        assert all(g is not None and bool(g.isfinite()) for g in gradients.values()), gradients
        nothing = 0.1 if contact else 0.9
        assert told[0].item() == pytest.approx(math.log(nothing))
