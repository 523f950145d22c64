"""Weights of samples: the perturbation cost, scaling, extreme costs and temperatures."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kmppi import KernelKnots, NonFiniteCostsError, perturbation_cost, sample_weights, scale_costs

SCALES = ["raw", "std"]
COSTS = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=20).map(lambda v: torch.tensor(v, dtype=torch.float64))


def test_golden_perturbation_cost(golden):
    case = golden("rumi.kmppi.perturb_cost")
    given = case["inputs"]
    theta = torch.tensor(given["theta"], dtype=torch.float64)[:, None]
    noise = torch.tensor(given["eps_theta"], dtype=torch.float64)[:, None]
    variance = torch.tensor([given["sigma2"]], dtype=torch.float64)
    got = perturbation_cost(theta, noise, variance, given["lam"])
    assert got.item() == pytest.approx(case["expected"]["theta_space"], abs=case["atol"])
    # the same over controls with the knots' variance is another number, the one not to have
    matrix = KernelKnots(given["H"], given["Hv"], "rbf", given["scale"]).matrix
    wrong = perturbation_cost(matrix @ theta, matrix @ noise, variance, given["lam"])
    assert wrong.item() == pytest.approx(case["expected"]["u_space_pytorch_mppi"], abs=case["atol"])


def test_perturbation_cost_is_the_log_likelihood_ratio(generator):
    """Of sampling around zero and around the nominal, but for a term that all samples share."""
    nominal = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(50, 4, 3, generator=generator, dtype=torch.float64)
    variance = torch.tensor([0.5, 1.5, 2.0], dtype=torch.float64)

    def log_density(mean):
        return (-0.5 * (nominal + noise - mean) ** 2 / variance).sum((1, 2))

    ratio = log_density(torch.zeros_like(nominal)) - log_density(nominal)
    got = perturbation_cost(nominal, noise, variance, 0.3)
    torch.testing.assert_close(got - got[0], -0.3 * (ratio - ratio[0]))


def test_perturbation_cost_keeps_batch_axes(generator):
    noise = torch.randn(2, 5, 4, 3, generator=generator, dtype=torch.float64)
    nominal, variance = noise[0, 0], torch.ones(3, dtype=torch.float64)
    got = perturbation_cost(nominal, noise, variance, 1.0)
    assert got.shape == (2, 5)
    torch.testing.assert_close(got[1, 2], perturbation_cost(nominal, noise[1, 2], variance, 1.0))


def test_weights_are_the_softmax(generator):
    costs = torch.rand(30, generator=generator, dtype=torch.float64)
    extra = torch.rand(30, generator=generator, dtype=torch.float64)
    expected = torch.tensor([math.exp(-(c + e) / 0.2) for c, e in zip(costs.tolist(), extra.tolist(), strict=True)])
    got = sample_weights(costs, 0.2, perturbation=extra)
    torch.testing.assert_close(got, (expected / expected.sum()).double(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("scale", SCALES)
@given(costs=COSTS, offset=st.floats(-1e4, 1e4))
def test_a_constant_changes_nothing(scale, costs, offset):
    # whole numbers, so that adding is exact and the property is about weighing, not about rounding
    costs, offset = costs.round(), round(offset)
    before = sample_weights(costs, 0.5, cost_scale=scale)
    torch.testing.assert_close(sample_weights(costs + offset, 0.5, cost_scale=scale), before, rtol=1e-6, atol=1e-9)
    assert before.sum().item() == pytest.approx(1.0)


@given(costs=COSTS, factor=st.floats(1e-6, 1e6))
def test_std_forgets_the_unit_and_raw_does_not(costs, factor):
    costs = costs.round()
    scaled = scale_costs(costs, "std")
    torch.testing.assert_close(scale_costs(factor * costs, "std"), scaled, rtol=1e-9, atol=1e-9)
    if costs.std() > 0:
        assert scaled.std(correction=0).item() == pytest.approx(1.0)
    torch.testing.assert_close(scale_costs(factor * costs, "raw"), factor * scale_costs(costs, "raw"))


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_costs_that_are_not_finite_weigh_nothing(scale, bad, dtype):
    costs = torch.tensor([1.0, bad, 1.2, bad, 0.9], dtype=dtype)
    extra = torch.tensor([0.1, 0.7, 0.2, -5.0, 0.0], dtype=dtype)
    got = sample_weights(costs, 0.1, cost_scale=scale, perturbation=extra)
    keep = torch.tensor([0, 2, 4])
    torch.testing.assert_close(got[keep], sample_weights(costs[keep], 0.1, cost_scale=scale, perturbation=extra[keep]))
    assert got[1] == 0 and got[3] == 0


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("huge", [1e30, 1e37, 1e300])
def test_huge_costs(scale, huge):
    dtype = torch.float64 if huge > 1e38 else torch.float32
    costs = torch.tensor([huge, -huge, 0.0], dtype=dtype)
    got = sample_weights(costs, 1e-3, cost_scale=scale)
    torch.testing.assert_close(got, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("temperature", [10.0**p for p in range(-6, 7)])
def test_any_temperature(scale, temperature, dtype):
    costs = torch.tensor([3.0, 1.0, 2.0, 1.5], dtype=dtype)
    got = sample_weights(costs, temperature, cost_scale=scale)
    assert got.isfinite().all() and got.sum().item() == pytest.approx(1.0)
    assert got.argsort(descending=True)[0] == 1
    if temperature <= 1e-3:
        torch.testing.assert_close(got, torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64))
    if temperature >= 1e5:
        torch.testing.assert_close(got, torch.full((4,), 0.25, dtype=torch.float64), rtol=0, atol=1e-4)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("value", [0.0, 5.0, -1e-30, 1e30])
def test_equal_costs_weigh_equally(scale, value):
    got = sample_weights(torch.full((4,), value), 1e-6, cost_scale=scale)
    torch.testing.assert_close(got, torch.full((4,), 0.25, dtype=torch.float64))


def test_float32_costs_far_from_zero_are_told_apart():
    costs = torch.tensor([4096.0, 4096.0 + 2.0**-10, 4097.0], dtype=torch.float32)
    got = sample_weights(costs, 1e-3)
    assert got[1].item() / got[0].item() == pytest.approx(math.exp(-(2.0**-10) / 1e-3), rel=1e-9)


def test_nothing_finite_is_an_error():
    with pytest.raises(NonFiniteCostsError, match="at least one finite cost, got 3 of nan or infinity"):
        sample_weights(torch.tensor([math.nan, math.inf, -math.inf]), 1.0)
