"""Sampling MPC and its costs under tensors of any value."""

from collections.abc import Iterable

import torch
from torch import Tensor

from kmppi import MPPI, KernelKnots, MPPISettings, kernel_matrix, sample_weights
from kmppi.types import KernelName
from rumi.planning.costs import information_cost
from sdf.voxel_grid import VoxelGrid
from tests.stress.fuzz.draw import Draw, choice, number, sizes, tensor
from tests.stress.fuzz.entered import target


@target
def _sample_weights(draw: Draw) -> Iterable[Tensor]:
    costs = tensor(draw, draw.integer(1, 6), wild=True)
    return (sample_weights(costs, 10.0 ** draw.integer(-6, 6), cost_scale=choice(draw, ("raw", "std"))),)


@target
def _time_kernels(draw: Draw) -> Iterable[Tensor]:
    kernel: KernelName = choice(draw, ("rbf", "matern32", "matern52", "bspline3"))
    horizon = draw.integer(1, 12)
    knots = draw.integer(1, horizon)
    made = KernelKnots(horizon, knots, kernel, 10.0 ** draw.integer(-2, 2))
    times = tensor(draw, 4).abs()
    return made.matrix, made.shift_matrix(draw.integer(0, 15)), kernel_matrix(kernel, times, times, 2.0)


@target
def _planners(draw: Draw) -> Iterable[Tensor]:
    def positive() -> float:
        return 10.0 ** draw.integer(-8, 8) if draw.integer(0, 9) else number(draw, wild=True)

    settings = MPPISettings(
        horizon=draw.integer(0, 9),
        knots=choice(draw, (None, None, 1, 2)),
        changes=draw.integer(0, 5) == 0,
        samples=draw.integer(2, 6),
        noise_variance=positive(),
        temperature=positive(),
        kernel_scale=choice(draw, (0.5, 0.5, 0.5, positive())),
        control_min=choice(draw, (-1.0, -1.0, -1e-9, number(draw, wild=True))),
        change_cost=choice(draw, (0.0, 0.0, positive())),
    )
    planner, generator = MPPI(settings, 2), torch.Generator().manual_seed(draw.integer(0, 99))
    costs = tensor(draw, settings.samples, wild=True).float()
    plan, rollouts = planner.plan(planner.initial(generator=generator), lambda _: costs, generator=generator)
    return plan.controls, planner.shift(plan, draw.integer(0, 6)).controls, rollouts.weights, rollouts.ess


@target
def _path_costs(draw: Draw) -> Iterable[Tensor]:
    values = tensor(draw, draw.integer(1, 4), draw.integer(1, 4), draw.integer(1, 3)).abs().float()
    field = VoxelGrid(values * choice(draw, (0.0, 1.0, 1e-30)), tensor(draw, 3).float(), choice(draw, (0.01, 1.0)))
    rollouts, steps = sizes(draw, 3), draw.integer(1, 3)
    paths, moves = tensor(draw, rollouts, steps, 3).float(), tensor(draw, rollouts, steps, 3).float()
    normalise = draw.integer(0, 1) == 1
    return (information_cost(field, tensor(draw, sizes(draw), 3).float(), paths, moves, normalise=normalise),)
