"""The planner with proposals, and sampling changes of controls."""

import pytest
import torch

from kmppi import MPPI, ControlPlan
from tests.fixtures.plans import quadratic, seeded, settings


def smooth(**changes):
    return settings(**{"knots": None, "changes": True} | changes)


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), ((0.2, -3.0), (0.4, -1.0))])
def test_sampled_changes_leave_no_limit_of_the_controls(low, high, dtype):
    mppi = MPPI(smooth(control_min=low, control_max=high, noise_variance=50.0), 2, dtype)
    start = mppi.initial(generator=seeded())
    plan, rollouts = mppi.plan(start, lambda u: u.sum((1, 2)), iterations=4, generator=seeded(1))
    for controls in (start.controls, plan.controls, mppi.shift(plan, 3).controls, rollouts.controls):
        assert bool(((controls >= mppi.control_min) & (controls <= mppi.control_max)).all())
    torch.testing.assert_close(plan.knots.cumsum(0), plan.controls)


def test_sampled_changes_converge_to_the_target(dtype):
    target = torch.linspace(-0.5, 0.7, 7, dtype=dtype)[:, None]
    mppi = MPPI(smooth(noise_variance=0.003, temperature=0.01, samples=400, perturbation_cost=False), 1, dtype)
    plan, _ = mppi.plan(mppi.initial(generator=seeded()), quadratic(target), iterations=60, generator=seeded(1))
    assert (plan.controls - target).abs().max() < 0.1


@pytest.mark.parametrize("knots", [None, 4])
def test_change_cost_weighs_what_it_says(knots):
    """As if the objective held it; the costs that are given back are the objective's alone."""
    weight, base = 0.7, quadratic(0.3)

    def jumpy(controls):
        return base(controls) + weight * controls.diff(dim=1).square().sum((1, 2))

    start = MPPI(settings(knots=knots), 2, torch.float64).initial(generator=seeded())
    own = MPPI(settings(knots=knots, change_cost=weight), 2, torch.float64).plan(start, base, generator=seeded(1))
    objective = MPPI(settings(knots=knots), 2, torch.float64).plan(start, jumpy, generator=seeded(1))
    torch.testing.assert_close(own[0].knots, objective[0].knots)
    torch.testing.assert_close(own[1].costs, base(own[1].controls), rtol=0, atol=0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_knots_that_are_no_numbers_are_refused(bad):
    mppi = MPPI(settings(), 3)
    knots = torch.zeros(4, 3)
    knots[1, 2] = bad
    with pytest.raises(ValueError, match=f"Expected finite knots, got {bad}"):
        mppi.from_knots(knots)
    with pytest.raises(ValueError, match="Expected finite knots"):
        mppi.plan(ControlPlan(knots, torch.zeros(7, 3)), lambda c: torch.zeros(len(c)), generator=seeded())


def test_a_proposal_better_than_the_plan_is_followed():
    mppi, target = MPPI(settings(noise_variance=1e-6), 2, torch.float64), torch.tensor([0.5, -0.5])
    start = mppi.from_knots(torch.zeros(4, 2))
    near, far = target.expand(4, 2), torch.full((4, 2), -1.0)
    for iterations in (1, 3):
        plan, found = mppi.plan(
            start, quadratic(target), proposals=torch.stack((far, near)), iterations=iterations, generator=seeded()
        )
        torch.testing.assert_close(plan.knots, near.double(), atol=0.01, rtol=0)
        assert len(found.costs) == mppi.settings.samples, "they are evaluated before, and are no samples"
    kept, _ = mppi.plan(start, quadratic(target), proposals=far[None], generator=seeded())
    torch.testing.assert_close(kept.knots, start.knots, atol=0.01, rtol=0)


def test_what_is_sampled_around_is_the_best_proposal_or_the_plan_itself():
    mppi = MPPI(settings(noise_variance=1e-12), 2, torch.float64)
    proposals = torch.stack([torch.full((4, 2), height, dtype=torch.float64) for height in (0.9, 0.4, -0.7)])
    for target, best in ((0.5, proposals[1]), (-0.6, proposals[2]), (0.1, torch.zeros(4, 2))):
        start = mppi.from_knots(torch.zeros(4, 2))
        _, found = mppi.plan(start, quadratic(target), proposals=proposals, generator=seeded())
        torch.testing.assert_close(found.controls[0], mppi.controls(best.double()), atol=1e-4, rtol=0)


def test_a_proposal_without_a_finite_cost_is_not_followed():
    mppi = MPPI(settings(noise_variance=1e-12), 2)
    start, worst = mppi.from_knots(torch.zeros(4, 2)), torch.ones(1, 4, 2)

    def objective(controls):
        costs = controls.square().sum((1, 2))
        return torch.where(controls.mean((1, 2)) > 0.9, torch.nan, costs)

    _, found = mppi.plan(start, objective, proposals=worst, generator=seeded())
    assert float(found.controls[0].abs().max()) < 1e-3


@pytest.mark.parametrize(
    "proposals",
    [torch.zeros(1, 5, 2), torch.full((1, 4, 2), torch.nan)],
    ids=["shape", "nan"],
)
def test_proposals_of_another_shape_or_not_finite_are_refused(proposals):
    mppi = MPPI(settings(), 2)
    with pytest.raises(ValueError, match="Expected"):
        mppi.plan(mppi.initial(generator=seeded()), quadratic(0.0), proposals=proposals, generator=seeded())
