"""Expected divergence of the posterior from the prior."""

import math

import pytest
import torch

from rumi.information.contact_gain import divergence, expected_divergence, with_kinds

F64 = torch.float64


def test_golden(golden):
    case = golden("s003.rect")
    log = torch.tensor(case["inputs"]["w0"], dtype=F64).log()
    likelihood = torch.tensor(case["expected"]["loglik"], dtype=F64)
    assert float(divergence(log, likelihood)) == pytest.approx(case["expected"]["KLD"], abs=case["atol"])
    # constants and the scale of the weights cancel
    other = divergence(log + 3.0, likelihood + case["expected"]["log_norm_const"])
    assert float(other) == pytest.approx(case["expected"]["KLD"], abs=1e-10)


def test_it_is_the_definition_and_never_negative():
    generator = torch.Generator().manual_seed(0)
    log = torch.randn(5, 30, generator=generator, dtype=F64)
    likelihood = 4.0 * torch.randn(5, 30, generator=generator, dtype=F64)
    posterior = (log + likelihood).log_softmax(-1)
    wanted = (posterior.exp() * (posterior - log.log_softmax(-1))).sum(-1)
    assert torch.allclose(divergence(log, likelihood), wanted, atol=1e-12)
    small = divergence(log.float(), 1e-4 * likelihood.float())
    assert bool((small >= 0).all()) and bool((small < 1e-5).all())
    assert torch.equal(divergence(log, torch.full_like(likelihood, 7.0)) < 1e-12, torch.ones(5, dtype=torch.bool))


def test_weights_of_nothing_and_readings_of_nothing():
    log = torch.tensor([0.0, -math.inf, 0.0], dtype=F64)
    assert float(divergence(log, torch.tensor([0.0, 5.0, -math.inf], dtype=F64))) == pytest.approx(math.log(2.0))
    assert float(divergence(log, torch.full((3,), -math.inf, dtype=F64))) == 0.0


def test_what_is_no_number_is_refused():
    log, even = torch.zeros(3, dtype=F64), torch.zeros(2, 3, dtype=F64)
    for bad in (math.nan, math.inf):
        likelihood = even.clone()
        likelihood[1, 0] = bad
        with pytest.raises(ValueError, match="got NaN or inf"):
            divergence(log, likelihood)
        with pytest.raises(ValueError, match="got NaN or inf"):
            expected_divergence(log, likelihood)
    for weights in (torch.full((3,), -math.inf, dtype=F64), torch.tensor([math.nan, 0.0, 0.0], dtype=F64)):
        with pytest.raises(ValueError, match="log-weights of which one is finite"):
            divergence(weights, even)


def test_drawn_readings_give_the_mutual_information():
    """A Gaussian state read with Gaussian noise: 1/2 log(1 + spread^2 / noise^2)."""
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(3000, generator=generator, dtype=F64)
    for noise in (0.25, 1.0):
        readings = states[:1500] + noise * torch.randn(1500, generator=generator, dtype=F64)
        likelihood = -0.5 * ((readings[:, None] - states) / noise) ** 2
        found = expected_divergence(torch.zeros(3000, dtype=F64), likelihood)
        assert float(found) == pytest.approx(0.5 * math.log1p(noise**-2), rel=0.06)


def test_noise_free_readings_take_the_weights_of_their_states():
    generator = torch.Generator().manual_seed(0)
    log, likelihood = torch.randn(6, generator=generator).double(), torch.randn(6, 6, generator=generator).double()
    each = torch.stack([divergence(log, row) for row in likelihood])
    assert float(expected_divergence(log, likelihood)) == pytest.approx(float((log.softmax(0) * each).sum()))
    even = expected_divergence(log, likelihood[:4])
    assert float(even) == pytest.approx(float(each[:4].mean()))
    assert expected_divergence(log, likelihood.expand(3, 6, 6)).shape == (3,)


def test_a_miss_is_a_reading_too():
    # half of the states are missed: which half it is, is all there is to learn where the touches are alike
    hits = torch.tensor([True, True, False, False])
    likelihood = with_kinds(torch.zeros(4, 4, dtype=F64), hits.long(), hits.long())
    assert float(expected_divergence(torch.zeros(4, dtype=F64), likelihood)) == pytest.approx(math.log(2.0))
    every = torch.ones(4, dtype=torch.bool)
    alike = with_kinds(torch.zeros(4, 4, dtype=F64), every.long(), every.long())
    assert float(expected_divergence(torch.zeros(4, dtype=F64), alike)) < 1e-12
    none = with_kinds(torch.zeros(4, 4, dtype=F64), 0 * every.long(), 0 * every.long())
    assert float(expected_divergence(torch.zeros(4, dtype=F64), none)) < 1e-12


def test_a_state_too_few(no_shape_check):
    with pytest.raises(ValueError, match="each of the 3 states, got 4"):
        expected_divergence(torch.zeros(3), torch.zeros(2, 4))


def test_a_reading_that_nothing_explains_has_no_slope():
    generator = torch.Generator().manual_seed(0)
    likelihood = torch.randn(4, 3, generator=generator, dtype=F64)
    likelihood[0], likelihood[2, 1] = -math.inf, -math.inf
    inputs = torch.randn(3, generator=generator, dtype=F64).requires_grad_(), likelihood.requires_grad_()
    found = divergence(inputs[0], inputs[1])
    with torch.no_grad():
        assert torch.equal(divergence(*inputs), found)
    slopes = torch.autograd.grad(found.sum(), inputs, retain_graph=True)
    rest = torch.autograd.grad(divergence(inputs[0], inputs[1][1:]).sum(), inputs)
    for slope, expected in zip(slopes, rest, strict=True):
        assert bool(slope.isfinite().all())
        torch.testing.assert_close(slope, expected)
    (slope,) = torch.autograd.grad(expected_divergence(*inputs, torch.zeros(4, dtype=F64)), inputs[0])
    assert bool(slope.isfinite().all())
    assert float(slope.abs().max()) > 0
