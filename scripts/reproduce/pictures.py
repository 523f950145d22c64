"""Figures 5 and 15: the fields that are planned over at the first view, drawn side by side."""

import time
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rumi import loop
from rumi.fields.information import information_field
from rumi.planning.registry import POLICIES
from rumi.records import StepRecord
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import Settings, preset
from rumi.viz import style
from scripts.reproduce.cells import table
from scripts.reproduce.correlation import pearson
from scripts.reproduce.experiments import PARTICLES

FIELDS = (("rumi", "information"), ("gpvr", "variance"))
"""Methods of Figure 15 with the name of the map that each plans over, in `Plan.fields`."""

LEAST, MARGIN_M = 0.02, 0.08


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
    for particles, changes in PARTICLES.items():
        settings = preset("default", task=task, seed=seed, **changes)
        first, rummager = _begin(settings, 0, cache_dir)
        points, belief = rummager.workspace.points, first.belief
        with torch.no_grad():
            for _ in range(2):  # the first call may compile
                begun = time.perf_counter()
                found = information_field(
                    rummager.model.sdf,
                    belief.world_T_object,
                    belief.log_weights,
                    points,
                    settings.planner.information,
                )
                seconds = time.perf_counter() - begun
        distinct = len(belief.world_T_object.flatten(1).unique(dim=0))
        title = f"P = {particles}" + ("" if distinct == particles else f", {distinct} distinct")
        fields.append(_field(title, found.information, points, seconds))
    return fields


def planned_over(task: str, seed: int, cache_dir: Path) -> list[Field]:
    """Figure 15: what each method's first plan rests on; methods that are not there are left out."""
    fields = []
    for method, name in FIELDS:
        if method not in POLICIES:
            continue
        step, rummager = _begin(preset("default", task=task, seed=seed, method=method), 1, cache_dir)
        if step.plan is not None and name in step.plan.fields:
            seconds = sum(step.plan.timings_s.values())
            fields.append(_field(f"{method}: {name}", step.plan.fields[name], rummager.workspace.points, seconds))
    return fields


def _begin(settings: Settings, steps: int, cache_dir: Path) -> tuple[StepRecord, Rummager]:
    """The last of the first steps of a run."""
    parts = build(settings, cache_dir=cache_dir)
    seen: list[StepRecord] = []
    try:
        loop.run_to_end(parts.task, parts.agent, seed=settings.seed, steps=steps, on_step=seen.append)
    finally:
        parts.task.close()
    return seen[-1], parts.agent


def draw_fields(fields: list[Field], path: Path) -> list[Path]:
    """Draw maps side by side, where any of them is; what is below 2 % of the largest value is left blank."""
    if not fields:
        return []
    (left, right), (bottom, top) = _where(fields)
    width = 3.2
    height = width * (top - bottom) / (right - left)
    with style.figure(width * len(fields) + 1.2, height + 1.0) as figure:
        panels = figure.subplots(1, len(fields), squeeze=False, sharey=True)[0]
        for ax, field in zip(panels, fields, strict=True):
            shown = torch.where(field.values > LEAST, field.values, torch.nan)
            image = ax.imshow(
                shown.T.numpy(), origin="lower", extent=field.bounds, cmap=style.information_map(), vmin=0, vmax=1
            )
            ax.set_xlim(left, right)
            ax.set_ylim(bottom, top)
            ax.set_title(field.title)
            ax.set_xlabel("x [m]")
        panels[0].set_ylabel("y [m]")
        figure.colorbar(image, ax=list(panels), shrink=0.8).set_label("over its largest value")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Software": "rumi"})
    return [path]


def _where(fields: list[Field]) -> list[tuple[float, float]]:
    """Range of x and of y that holds all that is drawn, with a margin, within the workspace."""
    ranges = []
    for axis in (0, 1):
        low, high = fields[0].bounds[2 * axis : 2 * axis + 2]
        marks = torch.linspace(low, high, fields[0].values.shape[axis])
        some = torch.stack([(field.values > LEAST).any(1 - axis) for field in fields]).any(0)
        seen = marks[some] if bool(some.any()) else marks
        ranges.append((max(low, float(seen.min()) - MARGIN_M), min(high, float(seen.max()) + MARGIN_M)))
    return ranges


def field_table(fields: list[Field]) -> str:
    """How alike the fields are, each held against the last one."""
    rows = [
        [
            field.title,
            f"{pearson(field.values.flatten().tolist(), fields[-1].values.flatten().tolist()):.3f}",
            f"{100.0 * float((field.values > LEAST).float().mean()):.1f} %",
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
