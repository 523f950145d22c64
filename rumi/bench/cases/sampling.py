"""What sampling MPC does beside dynamics and costs, and whether it plans as well as the peer."""

import math
import statistics
from collections.abc import Callable

import torch
from torch import Tensor

from kmppi import MPPI, MPPISettings, rollout_objective
from rumi.bench import peers
from rumi.bench.case import Case, Setup, Target, Variant, case
from rumi.seeding import split

_PEER = "pytorch-mppi"
_SCALE = 2.0
_GOAL, _HILL = (1.5, 1.0), (0.7, 0.3)


def _still(state: Tensor, control: Tensor, *_: object) -> Tensor:
    return state


def _free(state: Tensor, control: Tensor, *_: object) -> Tensor:
    return state[:, 0]


def glide(state: Tensor, control: Tensor, *_: object) -> Tensor:
    """A point with a speed in the plane: state (x, y, vx, vy), control an acceleration."""
    speed = state[..., 2:] + 0.2 * control
    return torch.cat((state[..., :2] + 0.2 * speed, speed), -1)


def hilly(state: Tensor, control: Tensor, *_: object) -> Tensor:
    """Cost of being away from the goal, on the hill before it, quick, or pushed."""
    place = state[..., :2]
    hill = 5.0 * torch.exp(-(place - place.new_tensor(_HILL)).square().sum(-1) / 0.05)
    away = (place - place.new_tensor(_GOAL)).square().sum(-1)
    return away + hill + 0.05 * state[..., 2:].square().sum(-1) + 0.01 * control.square().sum(-1)


def _settings(samples: int, horizon: int, knots: int, temperature: float) -> MPPISettings:
    return MPPISettings(
        horizon=horizon,
        knots=knots,
        kernel_scale=_SCALE,
        samples=samples,
        noise_variance=1.0,
        temperature=temperature,
    )


def _peer(
    step: Callable[..., Tensor],
    cost: Callable[..., Tensor],
    states: int,
    settings: MPPISettings,
    generator: torch.Generator,
    dimensions: int = 2,
) -> Callable[[Tensor], Tensor]:
    assert settings.knots is not None
    planner = peers.make_kmppi(
        step,
        cost,
        states=states,
        variance=torch.ones(dimensions),
        samples=settings.samples,
        horizon=settings.horizon,
        knots=settings.knots,
        scale=settings.kernel_scale,
        temperature=settings.temperature,
        generator=generator,
    )
    command: Callable[[Tensor], Tensor] = planner.command
    return command


def _own(
    step: Callable[..., Tensor], cost: Callable[..., Tensor], settings: MPPISettings, random: torch.Generator
) -> Callable[[Tensor], Tensor]:
    mppi = MPPI(settings, 2)
    plan = mppi.from_knots(torch.zeros(mppi.parameterization.knots, 2))

    def command(state: Tensor) -> Tensor:
        nonlocal plan
        objective = rollout_objective(step, cost, state=state)
        plan, _ = mppi.plan(mppi.shift(plan, 1), objective, generator=random)
        return plan.controls[0]

    return command


def closed_loop(make: Callable[[torch.Generator], Callable[[Tensor], Tensor]], seeds: int, steps: int) -> list[float]:
    """Summed cost of gliding over the hill to the goal, for each seed."""
    totals = []
    for seed in range(seeds):
        command = make(split(seed, "bench/navigation"))
        state, total = torch.zeros(4), 0.0
        for _ in range(steps):
            control = command(state)
            state = glide(state, control)
            total += float(hilly(state, control))
        totals.append(total)
    return totals


def _closed_loop_facts(setup: Setup, settings: MPPISettings) -> dict[str, object]:
    seeds, steps = setup.size(6 if setup.quick else 20, 2), setup.size(25, 3)
    own = closed_loop(lambda g: _own(glide, hilly, settings, g), seeds, steps)
    facts: dict[str, object] = {"closed-loop cost, rumi": _spread(own)}
    if setup.peers:
        theirs = closed_loop(lambda g: _peer(glide, hilly, 4, settings, g), seeds, steps)
        facts["closed-loop cost, pytorch-mppi"] = _spread(theirs)
        error = math.hypot(*(statistics.stdev(costs) / seeds**0.5 for costs in (own, theirs)))
        gap = statistics.mean(own) - statistics.mean(theirs)
        facts["rumi's less pytorch-mppi's, standard errors"] = round(gap / max(error, 1e-12), 2)
    return facts


def _spread(costs: list[float]) -> str:
    return f"{statistics.mean(costs):.3f} +- {statistics.stdev(costs):.3f} ({len(costs)} seeds)"


def _sampling(setup: Setup, samples: int, horizon: int, knots: int, dimensions: int) -> Case:
    settings = _settings(setup.size(samples, 20), horizon, knots, 0.01)
    random = split(0, "bench/sampling")
    mppi = MPPI(settings, dimensions, device=setup.device)
    start = mppi.initial(generator=random)
    state = torch.zeros(dimensions, device=setup.device)
    costs = torch.zeros(settings.samples, device=setup.device)
    by_step = rollout_objective(_still, lambda state, control, _: _free(state, control), state=state)

    def whole() -> Tensor:
        return mppi.plan(mppi.shift(start, 1), lambda controls: costs, generator=random)[0].controls

    def stepwise() -> Tensor:
        return mppi.plan(mppi.shift(start, 1), by_step, generator=random)[0].controls

    variants: tuple[Variant, ...] = (Variant("torch, step by step", stepwise), Variant("torch, whole sequences", whole))
    if setup.peers:
        command = _peer(_still, _free, dimensions, settings, split(0, "bench/peer"), dimensions)
        variants += (Variant(_PEER, lambda: command(state), "peer"),)
    return Case(
        f"KMPPI without dynamics and cost: K={settings.samples} T={horizon} knots={knots}, {dimensions} controls",
        variants,
        (_PEER, "torch, step by step"),
        1,
        "plan",
        (
            Target("torch, step by step", at_most_s=1e-3),
            Target("torch, step by step", at_least=5.0, against=(_PEER,)),
            Target("torch, whole sequences", at_least=5.0, against=(_PEER,)),
        ),
        facts=_closed_loop_facts(setup, _settings(setup.size(samples, 20), horizon, knots, 0.1)),
        left_out=setup.left_out,
    )


@case("kmppi-paper")
def kmppi_paper(setup: Setup) -> Case:
    """The paper's size."""
    return _sampling(setup, 500, 15, 8, 3)


@case("kmppi-toy")
def kmppi_toy(setup: Setup) -> Case:
    """The size of the peer's own example."""
    return _sampling(setup, 500, 20, 5, 2)
