"""The planner: what it samples, what it gives back, and what it converges to."""

import pytest
import torch

from kmppi import MPPI, ControlPlan, MPPISettings, NonFiniteCostsError, perturbation_cost, sample_weights
from tests.fixtures.plans import quadratic, seeded, settings

KNOTS = [None, 4]


def assert_same(a, b):
    torch.testing.assert_close(a, b, rtol=0, atol=0)


@pytest.mark.parametrize("knots", KNOTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_comes_back(knots, dtype, device):
    mppi = MPPI(settings(knots=knots), 3, dtype, device)
    start = mppi.initial(generator=seeded())
    seen = []

    def objective(controls):
        seen.append(controls)
        return controls.square().sum((1, 2))

    plan, rollouts = mppi.plan(start, objective, iterations=3, generator=seeded(1))
    count = knots or 7
    assert start.knots.shape == plan.knots.shape == (count, 3) and plan.controls.shape == (7, 3)
    assert rollouts.iterations == len(seen) == 3
    assert rollouts.controls is seen[-1]
    assert rollouts.weights.sum().item() == pytest.approx(1.0, abs=1e-6)
    assert 1.0 <= rollouts.ess.item() <= 64.0
    assert rollouts.ess.item() == pytest.approx(1.0 / rollouts.weights.square().sum().item(), rel=1e-5)
    for tensor in (plan.knots, plan.controls, rollouts.controls, rollouts.costs, rollouts.weights, rollouts.ess):
        assert tensor.dtype == dtype and tensor.device.type == device.type
    assert_same(rollouts.costs, seen[-1].square().sum((1, 2)))


@pytest.mark.parametrize("knots", KNOTS)
@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), ((0.2, -3.0), (0.4, -1.0)), (-0.5, (0.1, 2.0))])
def test_nothing_leaves_the_limits(knots, low, high, dtype):
    mppi = MPPI(settings(knots=knots, control_min=low, control_max=high, noise_variance=50.0), 2, dtype)

    def inside(values):
        return bool(((values >= mppi.control_min) & (values <= mppi.control_max)).all())

    start = mppi.initial(generator=seeded())
    plan, rollouts = mppi.plan(start, lambda u: u.sum((1, 2)), iterations=4, generator=seeded(1))
    for at in (start, plan, mppi.shift(plan, 3), mppi.shift(plan, 20)):
        assert inside(at.knots) and inside(at.controls)
    assert inside(rollouts.controls)


def test_controls_are_clipped_after_interpolation_too():
    mppi = MPPI(MPPISettings(), 1, torch.float64)
    worst = mppi.parameterization.matrix.abs().sum(1).argmax()
    knots = mppi.parameterization.matrix[worst].sign()[:, None]
    raw = mppi.parameterization.matrix @ knots
    assert raw.abs().max() > 1.8
    plan = mppi.from_knots(knots)
    assert_same(plan.knots, knots)
    torch.testing.assert_close(plan.controls, raw.clamp(-1.0, 1.0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("knots", KNOTS)
def test_the_first_sample_is_the_nominal_one(knots, dtype):
    mppi = MPPI(settings(knots=knots), 2, dtype)
    start = mppi.initial(generator=seeded())
    _, rollouts = mppi.plan(start, quadratic(0.0), generator=seeded(1))
    torch.testing.assert_close(rollouts.controls[0], start.controls)
    _, without = MPPI(settings(knots=knots, include_nominal=False), 2, dtype).plan(
        start, quadratic(0.0), generator=seeded(1)
    )
    assert (without.controls[0] - start.controls).abs().max() > 0.01
    assert_same(without.controls[1:], rollouts.controls[1:])


def test_best_is_the_least_finite_cost(dtype):
    mppi = MPPI(settings(), 2, dtype)
    costs = torch.arange(64, 0, -1, dtype=dtype)
    costs[63], costs[62] = torch.nan, -torch.inf
    _, rollouts = mppi.plan(mppi.initial(generator=seeded()), lambda u: costs, generator=seeded(1))
    assert_same(rollouts.best, rollouts.controls[61])


@pytest.mark.parametrize("scale", ["raw", "std"])
@pytest.mark.parametrize("knots", KNOTS)
def test_same_seed_same_bytes_and_no_global_draw(knots, scale):
    mppi = MPPI(settings(knots=knots, cost_scale=scale), 2)

    def run(seed):
        generator = seeded(seed)
        start = mppi.initial(generator=generator)
        return mppi.plan(mppi.shift(start, 2), quadratic(0.3), iterations=3, generator=generator)

    before = torch.get_rng_state()
    plan, rollouts = run(5)
    again, rollouts_again = run(5)
    assert_same(torch.get_rng_state(), before)
    assert_same(plan.knots, again.knots)
    assert_same(rollouts.costs, rollouts_again.costs)
    assert not torch.equal(run(6)[0].knots, plan.knots)


def test_iterations_are_the_same_call_repeated(dtype):
    mppi = MPPI(settings(), 2, dtype)
    generator, objective = seeded(), quadratic(0.3)
    plan = start = mppi.initial(generator=seeded(9))
    for _ in range(3):
        plan, _ = mppi.plan(plan, objective, generator=generator)
    assert_same(mppi.plan(start, objective, iterations=3, generator=seeded())[0].knots, plan.knots)


@pytest.mark.parametrize(("answers", "done"), [([True], 1), ([False, True], 2), ([False] * 4, 5)])
def test_should_stop_is_asked_between_iterations(answers, done, dtype):
    mppi = MPPI(settings(), 2, dtype)
    start, asked = mppi.initial(generator=seeded()), iter(answers)
    plan, rollouts = mppi.plan(
        start, quadratic(0.3), iterations=5, should_stop=lambda: next(asked), generator=seeded(1)
    )
    assert rollouts.iterations == done
    assert next(asked, None) is None
    assert_same(mppi.plan(start, quadratic(0.3), iterations=done, generator=seeded(1))[0].knots, plan.knots)


def test_iterations_default_to_the_settings(dtype):
    mppi = MPPI(settings(iterations=3), 2, dtype)
    _, rollouts = mppi.plan(mppi.initial(generator=seeded()), quadratic(0.0), generator=seeded())
    assert rollouts.iterations == 3


def test_as_many_knots_as_steps_is_mppi():
    per_step = MPPI(settings(knots=None), 2, torch.float64)
    kernel = MPPI(settings(knots=7, kernel_scale=1.0), 2, torch.float64)
    a = per_step.initial(generator=seeded())
    b = kernel.initial(generator=seeded())
    for seed in range(4):
        a, rollouts_a = per_step.plan(a, quadratic(0.3), iterations=2, generator=seeded(seed))
        b, rollouts_b = kernel.plan(b, quadratic(0.3), iterations=2, generator=seeded(seed))
        torch.testing.assert_close(rollouts_a.controls, rollouts_b.controls, rtol=0, atol=1e-11)
        torch.testing.assert_close(a.controls, b.controls, rtol=0, atol=1e-11)
        # the shifts agree where they do not extrapolate
        torch.testing.assert_close(
            per_step.shift(a, 2).controls[:5], kernel.shift(b, 2).controls[:5], rtol=0, atol=1e-11
        )


@pytest.mark.parametrize("perturbation", [True, False])
@pytest.mark.parametrize("knots", [None, 2])
def test_one_update_is_the_posterior_mean(knots, perturbation):
    """A quadratic cost makes exp(-cost / temperature) a Gaussian likelihood, whose posterior is known in closed form.

    With the perturbation cost the prior is the noise around zero, whatever was sampled around; without it, the noise
    around the nominal.
    """
    temperature, variance = 0.5, 0.4
    chosen = MPPISettings(
        horizon=3, knots=knots, kernel_scale=1.0, samples=200_000, noise_variance=variance, temperature=temperature,
        control_min=-50.0, control_max=50.0, perturbation_cost=perturbation,
    )  # fmt: skip
    mppi = MPPI(chosen, 1, torch.float64)
    matrix = mppi.parameterization.matrix
    target = torch.tensor([[0.8], [-0.3], [0.5]], dtype=torch.float64)
    nominal = torch.full((matrix.shape[1], 1), 0.4, dtype=torch.float64)
    plan, _ = mppi.plan(mppi.from_knots(nominal), quadratic(target), generator=seeded())

    precision = 2.0 / temperature * matrix.T @ matrix + torch.eye(matrix.shape[1], dtype=torch.float64) / variance
    prior = torch.zeros_like(nominal) if perturbation else nominal
    expected = torch.linalg.solve(precision, 2.0 / temperature * matrix.T @ target + prior / variance)
    torch.testing.assert_close(plan.knots, expected, rtol=0, atol=0.01)


@pytest.mark.parametrize("scale", ["raw", "std"])
def test_weights_know_the_noise_that_was_left_after_clipping(scale, dtype):
    mppi = MPPI(settings(knots=None, cost_scale=scale, noise_variance=3.0), 2, dtype)
    start = mppi.initial(generator=seeded())
    plan, rollouts = mppi.plan(start, quadratic(0.3), generator=seeded(1))
    # one control a knot: what was rolled out is the clipped knots
    left = rollouts.controls - start.knots
    assert (rollouts.controls.abs() == 1.0).any()
    extra = perturbation_cost(start.knots, left, mppi.noise_variance, 0.1)
    expected = sample_weights(rollouts.costs, 0.1, cost_scale=scale, perturbation=extra).to(dtype)
    torch.testing.assert_close(rollouts.weights, expected)
    torch.testing.assert_close(plan.knots, torch.einsum("k,ksa->sa", expected, rollouts.controls))


@pytest.mark.parametrize("scale", ["raw", "std"])
@pytest.mark.parametrize("knots", KNOTS)
def test_reaches_the_minimum_of_a_convex_quadratic(knots, scale, dtype):
    chosen = settings(
        knots=knots, cost_scale=scale, samples=300, noise_variance=0.02, temperature=0.1, perturbation_cost=False
    )
    mppi = MPPI(chosen, 2, dtype)
    # within what the knots can stand for; the second dimension's minimum lies beyond the limit
    wave = torch.tensor([0.5, -0.2, 0.1, 0.6], dtype=dtype)[:, None].expand(4, 2)
    target = mppi.controls(wave) if knots else torch.full((7, 2), 0.4, dtype=dtype)
    target[:, 1] = 1.4
    start = mppi.from_knots(torch.zeros(knots or 7, 2, dtype=dtype))
    plan, _ = mppi.plan(start, quadratic(target), iterations=80, generator=seeded())
    best = target.clamp(-1.0, 1.0)
    assert (start.controls - best).abs().max() > 0.5
    assert (plan.controls - best).abs().max() < 0.12


@pytest.mark.parametrize("scale", ["raw", "std"])
def test_adding_a_constant_to_the_cost_changes_nothing(scale):
    mppi = MPPI(settings(cost_scale=scale), 2, torch.float64)
    start = mppi.initial(generator=seeded())
    plain, _ = mppi.plan(start, quadratic(0.3), iterations=3, generator=seeded(1))
    lifted, _ = mppi.plan(start, lambda u: quadratic(0.3)(u) - 123.0, iterations=3, generator=seeded(1))
    torch.testing.assert_close(lifted.knots, plain.knots, rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", ["raw", "std"])
@pytest.mark.parametrize("temperature", [1e-6, 1.0, 1e6])
def test_extreme_temperatures(scale, temperature):
    """The coldest update is the best sample, the hottest leaves the mean of the samples; both are finite."""
    mppi = MPPI(settings(cost_scale=scale, temperature=temperature, perturbation_cost=False), 2)
    plan, rollouts = mppi.plan(mppi.initial(generator=seeded()), quadratic(0.3), generator=seeded(1))
    assert plan.controls.isfinite().all()
    if temperature < 1e-3:
        torch.testing.assert_close(plan.controls, rollouts.best)
        assert rollouts.ess.item() == pytest.approx(1.0)
    if temperature > 1e3:
        assert rollouts.ess.item() == pytest.approx(64.0, rel=1e-3)


@pytest.mark.parametrize("knots", KNOTS)
def test_bad_samples_are_never_followed(knots, dtype):
    mppi = MPPI(settings(knots=knots), 1, dtype)

    def objective(controls):
        first = controls[:, 0, 0]
        costs = controls.square().sum((1, 2))
        costs[first > 0.0] = torch.nan
        costs[first < -0.5] = torch.inf
        return costs

    start = mppi.from_knots(torch.full((knots or 7, 1), -0.25, dtype=dtype))
    plan, rollouts = mppi.plan(start, objective, iterations=5, generator=seeded())
    assert (rollouts.weights[~rollouts.costs.isfinite()] == 0).all()
    assert 0 < int(rollouts.costs.isfinite().sum()) < 64
    assert -0.5 <= plan.controls[0, 0].item() <= 0.0


def test_no_finite_cost_is_an_error(dtype):
    mppi = MPPI(settings(), 1, dtype)
    with pytest.raises(NonFiniteCostsError, match="got 64 of nan or infinity"):
        mppi.plan(mppi.initial(generator=seeded()), lambda u: u.sum((1, 2)) * torch.nan, generator=seeded())


@pytest.mark.parametrize("knots", [None, 1])
def test_horizon_of_one(knots, dtype):
    mppi = MPPI(settings(horizon=1, knots=knots), 2, dtype)
    start = mppi.initial(generator=seeded())
    plan, rollouts = mppi.plan(start, quadratic(0.5), iterations=10, generator=seeded())
    assert plan.controls.shape == (1, 2) and rollouts.controls.shape == (64, 1, 2)
    assert quadratic(0.5)(plan.controls[None]) < quadratic(0.5)(start.controls[None])
    assert mppi.shift(plan, 1).controls.abs().max() < plan.controls.abs().max()


@pytest.mark.parametrize("knots", KNOTS)
def test_shift(knots, dtype):
    mppi = MPPI(settings(knots=knots), 2, dtype)
    plan = mppi.initial(generator=seeded())
    torch.testing.assert_close(mppi.shift(plan, 0).controls, plan.controls, rtol=1e-5, atol=1e-6)
    # two steps are one spacing of the knots, so that what is left is what was planned
    torch.testing.assert_close(mppi.shift(plan, 2).knots[: -2 if knots is None else -1],
                               plan.knots[2 if knots is None else 1:], rtol=1e-5, atol=1e-6)  # fmt: skip
    assert mppi.shift(plan, 100).controls.abs().max() < 1e-6
    with pytest.raises(ValueError, match="executed to be 0 or more, got -1"):
        mppi.shift(plan, -1)


def test_plans_carry_no_graph(dtype):
    mppi = MPPI(settings(), 1, dtype)
    weight = torch.ones((), dtype=dtype, requires_grad=True)
    plan, rollouts = mppi.plan(
        mppi.initial(generator=seeded()), lambda u: weight * u.square().sum((1, 2)), generator=seeded()
    )
    assert not plan.knots.requires_grad and not rollouts.costs.requires_grad


def test_a_plan_moves_to_another_dtype():
    plan = MPPI(settings(), 1).initial(generator=seeded())
    wide = plan.to(torch.float64)
    assert isinstance(wide, ControlPlan) and wide.knots.dtype == wide.controls.dtype == torch.float64
    mppi = MPPI(settings(), 1, torch.float64)
    torch.testing.assert_close(mppi.shift(plan, 2).knots, mppi.shift(wide, 2).knots)


@pytest.mark.usefixtures("no_shape_check")
def test_wrong_shapes_are_named(dtype):
    mppi = MPPI(settings(), 2, dtype)
    start = mppi.initial(generator=seeded())
    with pytest.raises(ValueError, match=r"one floating cost a sample, shape \(64,\), got shape \(64, 1\)"):
        mppi.plan(start, lambda u: u.sum((1, 2))[:, None], generator=seeded())
    with pytest.raises(ValueError, match=r"got shape .* of torch\.int64"):
        mppi.plan(start, lambda u: u.sum((1, 2)).long(), generator=seeded())
    with pytest.raises(ValueError, match=r"knots to have shape \(\*b, S, A\) with \(S, A\) = \(4, 2\), got \(5, 2\)"):
        mppi.from_knots(torch.zeros(5, 2, dtype=dtype))
    with pytest.raises(ValueError, match="iterations to be 1 or more, got 0"):
        mppi.plan(start, quadratic(0.0), iterations=0, generator=seeded())
