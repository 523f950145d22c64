"""Sampling MPC and its costs: weights of samples, kernels in time, plans, and the information along a path."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from kmppi import MPPI, KernelKnots, MPPISettings, NonFiniteCostsError, kernel_matrix, sample_weights
from kmppi.types import KernelName
from rumi.fields.workspace import Workspace
from rumi.planning.costs import information_cost
from sdf import backend
from sdf.voxel_grid import VoxelGrid
from tests.stress import exact
from tests.stress.draws import choice, integer, log_uniform, normal, uniform
from tests.stress.measures import of_numbers
from tests.stress.subjects.distances import VERSIONS
from tests.stress.sweep import Inputs, Sweep, register

F64 = torch.float64
KERNELS: tuple[KernelName, ...] = ("rbf", "matern32", "matern52", "bspline3")


# weights of samples


def _draw_costs(generator: torch.Generator) -> Inputs:
    """Costs of up to 1e6, some of them equal, some not finite; temperatures from 1e-6 to 1e6."""
    count = int(choice(generator, (1, 2, 20, 100)))
    size = log_uniform(generator, 1, low=1e-6, high=1e6)
    kinds = [normal(generator, count) * size, uniform(generator, count) + size, torch.full((count,), float(size))]
    costs = kinds[integer(generator, 0, 2)]
    if count > 1 and integer(generator, 0, 1):
        bad = torch.tensor([torch.nan, torch.inf, -torch.inf], dtype=F64)[
            torch.randint(3, (count,), generator=generator)
        ]
        costs = torch.where(uniform(generator, count) < 0.2, bad, costs)
        costs[0] = float(size)
    return {
        "costs": costs.float(),
        "temperature": float(log_uniform(generator, 1, low=1e-6, high=1e6)),
        "scale": ("raw", "std")[integer(generator, 0, 1)],
    }


def _exact_weights(inputs: Inputs) -> Tensor:
    m = exact.mp()
    costs = [m.mpf(x) for x in inputs["costs"].double().tolist()]
    fine = [x for x in costs if m.isfinite(x)]
    unit = m.mpf(1)
    if inputs["scale"] == "std":
        middle = sum(fine) / len(fine)
        unit = m.sqrt(sum((x - middle) ** 2 for x in fine) / len(fine)) or m.mpf(1)
    least = min(fine)
    powers = [m.exp(-(x - least) / unit / m.mpf(inputs["temperature"])) if m.isfinite(x) else m.mpf(0) for x in costs]
    return torch.tensor([[float(x / sum(powers)) for x in powers]], dtype=F64)


def _temperature(inputs: Inputs) -> Tensor:
    return torch.tensor([inputs["temperature"]])


# kernels


def _draw_kernel(generator: torch.Generator) -> Inputs:
    """Knots and horizons of any kind that a kernel's length, 0.1 to 100 steps, can interpolate between."""
    while True:
        horizon = int(choice(generator, (1, 2, 5, 15, 40)))
        knots = 1 if horizon == 1 else integer(generator, 2, horizon)
        kernel = KERNELS[integer(generator, 0, 3)]
        scale = float(log_uniform(generator, 1, low=0.1, high=100.0))
        try:
            condition = float(torch.linalg.cond(KernelKnots(horizon, knots, kernel, scale)._gram))
        except ValueError:
            continue  # said to be too close to singular, as documented
        drawn = {"horizon": horizon, "knots": knots, "kernel": kernel, "scale": scale, "condition": condition}
        return drawn | {"steps": integer(generator, 0, horizon)}


def _curves(inputs: Inputs) -> Tensor:
    made = KernelKnots(inputs["horizon"], inputs["knots"], inputs["kernel"], inputs["scale"])
    return torch.cat((made.matrix, made.shift_matrix(inputs["steps"])))[None]


def _exact_curves(inputs: Inputs) -> Tensor:
    m = exact.mp()
    knots, horizon = inputs["knots"], inputs["horizon"]
    times = [m.mpf(horizon - 1) * k / (knots - 1) if knots > 1 else m.mpf(0) for k in range(knots)]
    asked = [m.mpf(k) for k in range(horizon)] + [time + inputs["steps"] for time in times]

    def between(a: list[Any], b: list[Any]) -> Any:  # noqa: ANN401  (a matrix of mpmath)
        return m.matrix(
            [[_exact_kernel(m, inputs["kernel"], abs(x - y) / m.mpf(inputs["scale"])) for y in b] for x in a]
        )

    solved = m.lu_solve  # one right-hand side at a time
    gram, cross = between(times, times), between(asked, times)
    rows = [solved(gram, cross[i, :].T) for i in range(len(asked))]
    return torch.tensor([[[float(row[j]) for j in range(knots)] for row in rows]], dtype=F64)


def _exact_kernel(m: Any, name: str, r: Any) -> Any:  # noqa: ANN401  (numbers of mpmath)
    if name == "rbf":
        return m.exp(-r * r / 2)
    if name == "matern32":
        return (1 + m.sqrt(3) * r) * m.exp(-m.sqrt(3) * r)
    if name == "matern52":
        return (1 + m.sqrt(5) * r + 5 * r * r / 3) * m.exp(-m.sqrt(5) * r)
    return max(2 - r, 0) ** 3 / m.mpf(4) - max(1 - r, 0) ** 3


def _draw_ratios(generator: torch.Generator) -> Inputs:
    return {
        "rows": uniform(generator, 12, high=40.0).float(),
        "scale": float(log_uniform(generator, 1, low=0.1, high=100.0)),
    }


def _kernels(dtype: torch.dtype, inputs: Inputs) -> Tensor:
    rows = inputs["rows"].to(dtype)
    return torch.stack([kernel_matrix(name, rows, rows, inputs["scale"]) for name in KERNELS])


# plans


def _draw_plan(generator: torch.Generator) -> Inputs:
    """Settings at their ends, and an objective with costs that are huge, equal, not finite here and there."""
    horizon = int(choice(generator, (1, 2, 15)))
    kind = integer(generator, 0, 2)
    knots = None if kind else (1 if horizon == 1 else int(choice(generator, (2, horizon))))
    return {
        "horizon": horizon,
        "knots": knots,
        "changes": kind == 2,
        "kernel": KERNELS[integer(generator, 0, 3)],
        "temperature": float(log_uniform(generator, 1, low=1e-6, high=1e6)),
        "noise": float(log_uniform(generator, 1, low=1e-8, high=1e8)),
        "samples": int(choice(generator, (2, 3, 64))),
        "scale": ("raw", "std")[integer(generator, 0, 1)],
        "size": float(log_uniform(generator, 1, low=1e-6, high=1e12)),
        "broken": choice(generator, (0.0, 0.0, 0.3, 1.0)),
        "seed": integer(generator, 0, 10**6),
    }


def _plan(inputs: Inputs) -> Tensor:
    """What is wrong with a plan: not within limits, not finite, weights that do not sum to 1, a size that cannot be."""
    settings = MPPISettings(
        horizon=inputs["horizon"],
        knots=inputs["knots"],
        changes=inputs["changes"],
        kernel=inputs["kernel"],
        kernel_scale=0.5,
        samples=inputs["samples"],
        noise_variance=inputs["noise"],
        temperature=inputs["temperature"],
        cost_scale=inputs["scale"],
    )
    generator = torch.Generator().manual_seed(inputs["seed"])

    def objective(controls: Tensor) -> Tensor:
        cost = (controls - 0.3).square().sum((1, 2)) * inputs["size"]
        lost = torch.rand(len(cost), generator=generator) < inputs["broken"]
        return torch.where(lost, torch.tensor(torch.nan), cost)

    planner = MPPI(settings, 2)
    plan = planner.initial(generator=generator)
    worst = torch.zeros((), dtype=F64)
    for _ in range(3):
        try:
            plan, rollouts = planner.plan(planner.shift(plan, 1), objective, generator=generator)
        except NonFiniteCostsError:
            continue  # documented: no sample has a finite cost
        beyond = (plan.controls.double().abs() - 1.0).clamp_min(0.0).amax()
        sums = (rollouts.weights.double().sum() - 1.0).abs()
        size = (1.0 - rollouts.ess.double()).clamp_min(0.0) + (rollouts.ess.double() - settings.samples).clamp_min(0.0)
        worst = torch.stack((worst, beyond, sums, size, (plan.knots * 0).double().abs().amax())).amax()
    return worst[None]


# information along a path


def _draw_paths(generator: torch.Generator) -> Inputs:
    """A field with information everywhere, in one cell, nowhere, or of one cell; paths within, across and beyond it."""
    spacing = 0.01
    shape = ((1, 1, 1), (20, 20, 1), (20, 20, 6))[integer(generator, 0, 2)]
    values = uniform(generator, *shape) * log_uniform(generator, 1, low=1e-12, high=1.0)
    kind = integer(generator, 0, 3)
    if kind == 0:
        values = torch.zeros_like(values)
    elif kind == 1:
        values = torch.zeros_like(values)
        values[tuple(integer(generator, 0, n - 1) for n in shape)] = 1.0
    points = uniform(generator, 12, 3, low=-0.03, high=0.03)
    paths = torch.cat((uniform(generator, 16, 5, 2, low=-0.05, high=0.25), normal(generator, 16, 5, 1)), -1)
    return {
        "values": values.float(),
        "spacing": spacing,
        "points": points.float(),
        "paths": paths.float(),
        "moves": uniform(generator, 16, 5, 3, low=-0.02, high=0.02).float(),
        "discount": choice(generator, (1.0, 0.9)),
    }


def _gathered(version: str, inputs: Inputs) -> Tensor:
    origin = torch.zeros(3)
    grid = VoxelGrid(inputs["values"], origin, inputs["spacing"])
    with backend.force(version):
        return -information_cost(grid, inputs["points"], inputs["paths"], inputs["moves"], discount=inputs["discount"])


def _allowed(inputs: Inputs) -> tuple[Tensor, Tensor]:
    """Least and most that each path gathers, in float64: within 1e-3 of a cell's face either cell counts."""
    values, spacing = inputs["values"].double(), inputs["spacing"]
    paths, moves, points = inputs["paths"].double(), inputs["moves"].double(), inputs["points"].double()
    cosine, sine = paths[..., 2].cos()[..., None], paths[..., 2].sin()[..., None]
    x = paths[..., :1] + cosine * points[:, 0] - sine * points[:, 1] - moves[..., :1]
    y = paths[..., 1:2] + sine * points[:, 0] + cosine * points[:, 1] - moves[..., 1:2]
    z = points[:, 2].expand_as(x)
    shape = torch.tensor(values.shape)
    place = torch.stack((x, y, z), -1) / spacing + 0.5
    place = torch.where(shape == 1, 0.5, place)
    found = []
    for sure in (True, False):
        best = torch.zeros(len(paths), *values.shape, dtype=F64)
        for corner in torch.cartesian_prod(*[torch.tensor([-1e-3, 1e-3])] * 3):
            cell = (place + corner).floor()
            same = (place - corner).floor() == cell
            inside = ((cell >= 0) & (cell < shape)).all(-1) & (same.all(-1) if sure else True)
            worth = inputs["discount"] ** torch.arange(paths.shape[1], dtype=F64)[None, :, None].expand_as(x)
            if sure:
                # of points that are in a cell whichever way rounding goes
                corners = torch.cartesian_prod(*[torch.tensor([-1e-3, 1e-3])] * 3)
                inside &= torch.stack([((place + c).floor() == cell).all(-1) for c in corners]).all(0)
            row = torch.arange(len(paths))[:, None, None].expand_as(x)[inside]
            index = cell.long()[inside]
            flat = ((row * shape[0] + index[:, 0]) * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
            best.view(-1).scatter_reduce_(0, flat, worth[inside], "amax")
        found.append((best * values).flatten(1).sum(-1))
    return found[0], found[1]


def _outside(got: Tensor, wanted: tuple[Tensor, Tensor], inputs: Inputs) -> Tensor:
    least, most = wanted
    greatest = most.amax().clamp_min(1e-30)
    return torch.maximum(least - got.double(), got.double() - most).clamp_min(0.0) / greatest


def _worth(inputs: Inputs) -> Tensor:
    return inputs["values"].double().sum()[None]


# workspaces


def _draw_workspace(generator: torch.Generator) -> Inputs:
    """Boxes of one cell to many, whose sides are whole numbers of spacings up to rounding."""
    spacing = choice(generator, (0.0005, 0.001, 0.005, 0.007, 0.02))
    cells = torch.tensor([integer(generator, 0, 60) for _ in range(3)])
    low = uniform(generator, 3, low=-2.0, high=2.0).float()
    high = (low.double() + cells * spacing).float()
    return {"bounds": torch.stack((low, torch.maximum(low, high))), "spacing": spacing, "cells": cells}


def _nodes(inputs: Inputs) -> Tensor:
    made = Workspace.from_bounds(inputs["bounds"], inputs["spacing"])
    return torch.tensor([made.shape], dtype=F64)


def _enter() -> None:
    if exact.available():
        register(Sweep(
            "planning-sample-weights", _draw_costs,
            lambda i: sample_weights(i["costs"], i["temperature"], cost_scale=i["scale"])[None], _exact_weights,
            of_numbers, 1e-9, "1", _temperature, "temperature",
        ))  # fmt: skip
        register(Sweep(
            "planning-knots-to-controls", _draw_kernel, _curves, _exact_curves, of_numbers, 1e-8, "1",
            lambda i: torch.tensor([i["condition"]]), "condition of the kernel's matrix",
        ))  # fmt: skip
    register(Sweep(
        "planning-kernels-float32", _draw_ratios, partial(_kernels, torch.float32), partial(_kernels, F64),
        of_numbers, 1e-5, "1", lambda i: torch.tensor([i["scale"]]), "scale",
    ))  # fmt: skip
    register(Sweep(
        "planning-mppi", _draw_plan, _plan, lambda i: torch.zeros(1, dtype=F64), of_numbers, 1e-5, "1",
        _temperature, "temperature",
    ))  # fmt: skip
    register(Sweep(
        "planning-workspace", _draw_workspace, _nodes, lambda i: (i["cells"] + 1).double()[None], of_numbers, 0.0,
        "nodes", lambda i: torch.tensor([i["spacing"]]), "spacing, m",
    ))  # fmt: skip
    for version in VERSIONS:
        register(Sweep(
            f"planning-information-cost-{version}", _draw_paths, partial(_gathered, version), _allowed, _outside,
            1e-5, "of the greatest", _worth, "information in all, nats",
        ))  # fmt: skip


_enter()
