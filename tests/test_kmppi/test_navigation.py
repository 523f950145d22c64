"""Toy navigation in the plane: plans work in closed loop, and KMPPI's are the smoother ones."""

import pytest
import torch

from kmppi import MPPI, MPPISettings, rollout_objective

GOAL = torch.tensor([1.5, 1.0], dtype=torch.float64)
HILL = torch.tensor([0.7, 0.3], dtype=torch.float64)
RADIUS = 0.3


def glide(state, control, _):
    """A point with a speed: state (x, y, vx, vy), control an acceleration."""
    speed = state[..., 2:] + 0.2 * control
    return torch.cat((state[..., :2] + 0.2 * speed, speed), -1)


def hilly(state, control, _):
    away = (state[..., :2] - GOAL).square().sum(-1)
    hill = 20.0 * ((state[..., :2] - HILL).norm(dim=-1) < RADIUS)
    return away + hill + 0.05 * state[..., 2:].square().sum(-1) + 0.01 * control.square().sum(-1)


@pytest.mark.parametrize(
    "how",
    [
        {"knots": None},
        {"knots": 6},
        {"knots": None, "changes": True, "noise_variance": 0.1, "change_cost": 0.1, "perturbation_cost": False},
    ],
)
def test_reaches_the_goal_around_the_hill(how):
    settings = MPPISettings(
        **{"horizon": 15, "samples": 200, "noise_variance": 0.5, "temperature": 0.1, "cost_scale": "std"} | how
    )
    mppi = MPPI(settings, 2, torch.float64)
    generator = torch.Generator().manual_seed(3)
    state = torch.zeros(4, dtype=torch.float64)
    plan = mppi.initial(generator=generator)
    path = [state]
    iterations = settings.warmup_iterations
    for _ in range(40):
        objective = rollout_objective(glide, hilly, state=state)
        plan, _ = mppi.plan(plan, objective, iterations=iterations, generator=generator)
        state = glide(state, plan.controls[0], None)
        path.append(state)
        plan, iterations = mppi.shift(plan, 1), settings.iterations
    walked = torch.stack(path)[:, :2]
    assert (walked - HILL).norm(dim=-1).min() > RADIUS
    assert (walked[-5:] - GOAL).norm(dim=-1).max() < 0.15


def jerk(controls):
    return controls.diff(n=2, dim=0).square().sum().item()


@pytest.mark.parametrize("seed", range(5))
def test_knots_make_smoother_plans(seed):
    """RUMI, Fig 8: a linear integrator over a cost map, horizon 20, 5 knots, kernel scale 2."""

    def run(knots):
        settings = MPPISettings(
            horizon=20,
            knots=knots,
            kernel_scale=2.0,
            samples=300,
            noise_variance=1.0,
            temperature=0.1,
            cost_scale="std",
        )
        mppi = MPPI(settings, 2, torch.float64)
        generator = torch.Generator().manual_seed(seed)

        def cost(state, control, _):
            hill = 5.0 * torch.exp(-(state - HILL).square().sum(-1) / 0.1)
            return (state - GOAL).square().sum(-1) + hill + 0.1 * control.square().sum(-1)

        objective = rollout_objective(lambda x, u, _: x + 0.15 * u, cost, state=torch.zeros(2, dtype=torch.float64))
        start = mppi.initial(generator=generator)
        plan, _ = mppi.plan(start, objective, iterations=20, generator=generator)
        return plan.controls, objective(torch.stack((start.controls, plan.controls)))

    rough, rough_costs = run(None)
    smooth, smooth_costs = run(5)
    assert rough_costs[1] < 0.8 * rough_costs[0] and smooth_costs[1] < 0.8 * smooth_costs[0]
    assert jerk(smooth) < 0.5 * jerk(rough)
    # and not for being worse
    assert smooth_costs[1] < 1.1 * rough_costs[1]
