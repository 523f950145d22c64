"""Figures 5 and 15: the fields that are planned over at the first view, drawn side by side."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.assemble import build
from rumi.config import METHODS, preset
from rumi.fields.information import information_field
from rumi.loop import first_belief
from rumi.metrics.correlation import pearson
from rumi.planning.types import Scene
from rumi.reproduce.cells import table
from rumi.reproduce.experiments import PARTICLES
from rumi.seeding import split
from rumi.viz import style

FIELDS = (("rumi", "information"), ("gpvr", "variance"))
"""Methods of Figure 15 with the name of the map that each plans over, in `Plan.fields`."""


@dataclass(frozen=True)
class Field:
    """A map over the workspace, seen from above.

    Attributes:
        title: what it is.
        values: (X, Y), over the largest of them.
        bounds: left, right, bottom and top, metres.
        seconds: that it took.
    """

    title: str
    values: Float[Tensor, "X Y"]
    bounds: tuple[float, float, float, float]
    seconds: float


def information_by_particles(task: str, seed: int, cache_dir: Path) -> list[Field]:
    """Figure 5: the information field of the first belief with different numbers of particles."""
    fields = []
    for particles in PARTICLES:
        settings = preset("default", task=task, seed=seed)
        settings = replace(settings, initialise=replace(settings.initialise, particles=particles))
        robot, rummager = build(settings, cache_dir=cache_dir)
        try:
            reading = robot.reset(seed).reading
        finally:
            robot.close()
        belief, _ = first_belief(rummager, reading, generator=split(seed, "initialise"))
        points, information = rummager.workspace.points, settings.planner.information
        with torch.no_grad():
            begun = time.perf_counter()
            found = information_field(
                rummager.model.sdf, belief.world_T_object, belief.log_weights, points, information
            )
            seconds = time.perf_counter() - begun
        fields.append(_field(f"P = {particles}", found.information, rummager.workspace.points, seconds))
    return fields


def planned_over(task: str, seed: int, cache_dir: Path) -> list[Field]:
    """Figure 15: what each method plans over at the first view; methods that are not there are left out."""
    fields = []
    for method, name in FIELDS:
        if method not in METHODS:
            continue
        robot, rummager = build(preset("default", task=task, seed=seed, method=method), cache_dir=cache_dir)
        try:
            reading = robot.reset(seed).reading
        finally:
            robot.close()
        belief, _ = first_belief(rummager, reading, generator=split(seed, "initialise"))
        scene = Scene(rummager.model, rummager.workspace, rummager.tool, reading.configuration)
        begun = time.perf_counter()
        plan = rummager.policy.act(belief, scene, None, executed=0, budget_s=None, generator=split(seed, "plan"))
        seconds = time.perf_counter() - begun
        if name in plan.fields:
            fields.append(_field(f"{method}: {name}", plan.fields[name], rummager.workspace.points, seconds))
    return fields


def draw_fields(fields: list[Field], path: Path) -> list[Path]:
    """Draw maps side by side; what is below 2 % of the largest value is left blank, as in the paper."""
    if not fields:
        return []
    with style.figure(3.3 * len(fields) + 0.5, 3.3) as figure:
        panels = figure.subplots(1, len(fields), squeeze=False, sharey=True)[0]
        for ax, field in zip(panels, fields, strict=True):
            shown = torch.where(field.values > 0.02, field.values, torch.nan)
            image = ax.imshow(
                shown.T.numpy(), origin="lower", extent=field.bounds, cmap=style.information_map(), vmin=0, vmax=1
            )
            ax.set_title(field.title)
            ax.set_xlabel("x [m]")
        panels[0].set_ylabel("y [m]")
        figure.colorbar(image, ax=list(panels), shrink=0.8).set_label("over its largest value")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Software": "rumi"})
    return [path]


def field_table(fields: list[Field]) -> str:
    """How alike the fields are, each held against the last one."""
    rows = [
        [
            field.title,
            f"{pearson(field.values.flatten().tolist(), fields[-1].values.flatten().tolist()):.3f}",
            f"{100.0 * float((field.values > 0.02).float().mean()):.1f} %",
            f"{1e3 * field.seconds:.0f}",
        ]
        for field in fields
    ]
    heads = ["field", f"correlation with {fields[-1].title}" if fields else "", "of the workspace above 2 %", "ms"]
    return table(heads, rows)


def _field(title: str, values: Float[Tensor, "V"], points: Float[Tensor, "V 3"], seconds: float) -> Field:
    """Seen from above: the largest value over the height."""
    x, y = (points[:, k].unique() for k in (0, 1))
    places = torch.searchsorted(x, points[:, 0].contiguous()) * len(y) + torch.searchsorted(
        y, points[:, 1].contiguous()
    )
    seen = torch.zeros(len(x) * len(y), dtype=values.dtype)
    seen = seen.scatter_reduce(0, places, values.detach().cpu(), "amax", include_self=False).view(len(x), len(y))
    bounds = (float(x[0]), float(x[-1]), float(y[0]), float(y[-1]))
    return Field(title, seen / seen.max().clamp_min(1e-12), bounds, seconds)
