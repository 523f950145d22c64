"""The toy of Figure 8: a point in the plane goes round a hill, planned by MPPI, SMPPI and KMPPI."""

import time
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, MPPISettings, rollout_objective
from rumi.seeding import split

START, GOAL = (-3.0, -2.0), (2.0, 2.0)
HILL, HILL_HEIGHT = (-0.5, -1.0), 200.0
EXTENT = (-5.0, 5.0)
STEPS = 20
"""Controls that are carried out; one is planned for each, from the plan before."""

# The figure's caption gives the horizon, the knots, the kernel and the action penalty; all else is that of the
# authors' public library (pytorch_mppi, tests/smooth_mppi.py): start, goal, hill, dynamics, limits, 500 samples,
# variance 1, temperature 1, terminal cost 10 times the running one, SMPPI's action cost of 5.
_PENALTY, _TERMINAL = 0.1, 10.0
_COMMON: dict[str, Any] = {"horizon": 20, "samples": 500, "noise_variance": 1.0, "temperature": 1.0, "iterations": 1}
SETTINGS = {
    "MPPI": MPPISettings(knots=None, **_COMMON),
    "SMPPI": MPPISettings(knots=None, changes=True, change_cost=5.0, **_COMMON),
    "KMPPI": MPPISettings(knots=5, kernel="rbf", kernel_scale=2.0, **_COMMON),
}


def step(state: Float[Tensor, "*b 2"], control: Float[Tensor, "*b 2"], *_: object) -> Float[Tensor, "*b 2"]:
    """A linear integrator: half the control, the second axis turned round."""
    return state + control * control.new_tensor([0.5, -0.5])


def cost_map(state: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b"]:
    """Cost of being somewhere: squared distance to the goal, and the hill."""
    away = (state - state.new_tensor(GOAL)).square().sum(-1)
    x, y = (state - state.new_tensor(HILL)).unbind(-1)
    return away + HILL_HEIGHT * torch.exp(-0.25 * (x * x + x * y + y * y))


def running_cost(state: Float[Tensor, "*b 2"], control: Float[Tensor, "*b 2"], *_: object) -> Float[Tensor, "*b"]:
    """Cost of a step: where it leads, and the action penalty."""
    return cost_map(state) + _PENALTY * control.square().sum(-1)


def terminal_cost(state: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b"]:
    """Cost of the end of the horizon."""
    return _TERMINAL * cost_map(state)


def carry_out(method: str, seed: int) -> dict[str, Any]:
    """Go from the start to wherever the method leads in `STEPS` controls.

    Args:
        method: of `SETTINGS`.
        seed: of all randomness.

    Returns:
        `figures`: the cost met (the running cost of all steps), how far the controls changed in all (sum of absolute
        differences) and how much the changes changed (sum of squared second differences), the length of the path and
        the distance to the goal at its end; the same of the plan at the start, as it is after 20 iterations, with its
        cost. `curves`: path and plan, x and y by step.
    """
    settings = SETTINGS[method]
    mppi = MPPI(settings, 2, torch.float64)
    generator = split(seed, f"toy {method}")
    begun = time.perf_counter()
    state = torch.tensor(START, dtype=torch.float64)

    def objective(at: Tensor) -> Any:  # noqa: ANN401  (an objective)
        return rollout_objective(step, running_cost, terminal_cost, state=at)

    still = mppi.from_knots(torch.zeros(mppi.parameterization.knots, 2))
    planned, _ = mppi.plan(still, objective(state), iterations=STEPS, generator=generator)
    plan, states, controls = still, [state], []
    for _ in range(STEPS):
        plan, _ = mppi.plan(plan, objective(state), generator=generator)
        controls.append(plan.controls[0])
        state = step(state, plan.controls[0])
        states.append(state)
        plan = mppi.shift(plan, 1)
    path, taken = torch.stack(states), torch.stack(controls)
    rolled = [path[0]]
    for control in planned.controls:
        rolled.append(step(rolled[-1], control))
    foreseen = torch.stack(rolled)
    figures = {
        "cost": float(running_cost(path[1:], taken).sum()),
        "end_distance": float((path[-1] - path.new_tensor(GOAL)).norm()),
        **_smoothness(path, taken),
        "plan_cost": float(objective(path[0])(planned.controls[None])[0]),
        **{f"plan_{name}": value for name, value in _smoothness(foreseen, planned.controls).items()},
    }
    curves = {
        name: [float(f"{value:.5g}") for value in values]
        for name, values in zip(
            ("path_x", "path_y", "plan_x", "plan_y"), (*path.unbind(-1), *foreseen.unbind(-1)), strict=True
        )
    }
    return {"figures": figures, "timings": {"wall_s": time.perf_counter() - begun}, "curves": curves}


def _smoothness(path: Float[Tensor, "T1 2"], controls: Float[Tensor, "T 2"]) -> dict[str, float]:
    return {
        "change": float(controls.diff(dim=0).abs().sum()),
        "jerk": float(controls.diff(n=2, dim=0).square().sum()),
        "length": float(path.diff(dim=0).norm(dim=-1).sum()),
    }
