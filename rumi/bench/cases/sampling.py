"""What sampling MPC does beside dynamics and costs."""

import torch
from torch import Tensor

from kmppi import MPPI, MPPISettings, rollout_objective
from rumi.bench.case import Case, Setup, Variant, cases
from rumi.seeding import split

_SCALE = 2.0


def still(state: Tensor, control: Tensor, *_: object) -> Tensor:
    """Dynamics that do nothing."""
    return state


def free(state: Tensor, control: Tensor, *_: object) -> Tensor:
    """A cost that costs nothing to work out."""
    return state[:, 0]


def sampling_settings(samples: int, horizon: int, knots: int, temperature: float) -> MPPISettings:
    """KMPPI of a size."""
    return MPPISettings(
        horizon=horizon,
        knots=knots,
        kernel_scale=_SCALE,
        samples=samples,
        noise_variance=1.0,
        temperature=temperature,
    )


@cases({"kmppi-paper": (500, 15, 8, 3), "kmppi-toy": (500, 20, 5, 2)})
def sampling(setup: Setup, samples: int, horizon: int, knots: int, dimensions: int) -> Case:
    """KMPPI of the paper's size, and of that of the peer's own example."""
    settings = sampling_settings(setup.size(samples, 20), horizon, knots, 0.01)
    random = split(0, "bench/sampling")
    mppi = MPPI(settings, dimensions, device=setup.device)
    start = mppi.initial(generator=random)
    state = torch.zeros(dimensions, device=setup.device)
    costs = torch.zeros(settings.samples, device=setup.device)
    by_step = rollout_objective(still, lambda state, control, _: free(state, control), state=state)

    def whole() -> Tensor:
        return mppi.plan(mppi.shift(start, 1), lambda controls: costs, generator=random)[0].controls

    def stepwise() -> Tensor:
        return mppi.plan(mppi.shift(start, 1), by_step, generator=random)[0].controls

    variants: tuple[Variant, ...] = (Variant("torch, step by step", stepwise), Variant("torch, whole sequences", whole))
    return Case(
        f"KMPPI without dynamics and cost: K={settings.samples} T={horizon} knots={knots}, {dimensions} controls",
        variants,
        otherwise="torch, step by step",
    )
