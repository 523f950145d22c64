"""Figures 8, 13 and 16: curves over the steps with quartiles, and the toy's paths."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rumi.viz import style
from scripts.reproduce import paper
from scripts.reproduce.cells import held
from scripts.reproduce.records import Record, by_column
from scripts.reproduce.tables import families, of_task

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {"rumi": "#0b5fa5", "info-only": "#e08214", "reach-only": "#00707a", "gpvr": "#c2185b", "slide": "#7a4fa3"}
_MORE = ("#8a8f98", "#222222", "#9a6324", "#469990")
_TOY = {"MPPI": "#8a8f98", "SMPPI": "#e08214", "KMPPI": "#0b5fa5"}


def quartiles(courses: Sequence[Sequence[float]]) -> np.ndarray:
    """Lower quartile, median and upper quartile (3, T) of courses of one length, NaN left out."""
    return np.asarray(np.nanquantile(np.asarray(courses, dtype=float), [0.25, 0.5, 0.75], axis=0))


def draw_curves(records: Sequence[Record], name: str, path: Path) -> list[Path]:
    """Figures 16 (nll) and 13 (apc): median and quartiles over the runs, a panel a task, a picture a preset.

    A run that stopped is held at its last value, so that all steps have all runs.

    Args:
        records: of runs.
        name: "nll" or "apc".
        path: of the pictures; the preset's name is added.

    Returns:
        the files written; none without such curves.
    """
    written = []
    for preset in dict.fromkeys(record.preset for record in records):
        own = [record for record in records if record.preset == preset and record.curves.get(name)]
        rows = families(own)
        if not rows:
            continue
        wide = max(map(len, rows.values()))
        with style.figure(3.0 * wide + 0.6, 2.3 * len(rows) + 0.6) as figure:
            panels = figure.subplots(len(rows), wide, squeeze=False, sharex="row")
            for line, tasks in zip(panels, rows.values(), strict=True):
                for ax in line[len(tasks) :]:
                    ax.set_visible(False)
                for ax, task in zip(line, tasks, strict=False):
                    _panel(of_task(own, task), name, ax)
                    ax.set_title(task)
                line[0].set_ylabel("nll [nats]" if name == "nll" else "APC [mm]")
            handles: dict[str, object] = {}
            for ax in panels.flat:
                handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
            figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6)
            target = path.with_name(f"{path.stem}-{preset}.png")
            target.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(target, metadata={"Software": "rumi"})
            written.append(target)
    return written


def draw_toy(records: Sequence[Record], path: Path) -> list[Path]:
    """Figure 8: the plans at the start and the paths taken, over the cost map."""
    import torch

    from scripts.reproduce import toy

    if not records:
        return []
    axis = torch.linspace(*toy.EXTENT, 201, dtype=torch.float64)
    cost = toy.cost_map(torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1)).numpy()
    columns = list(by_column(records))
    with style.figure(2.9 * len(columns), 6.2) as figure:
        panels = figure.subplots(2, len(columns), squeeze=False, sharex=True, sharey=True)
        for row, (what, title) in enumerate((("plan", "plan at the start"), ("path", "path in closed loop"))):
            for ax, (name, runs) in zip(panels[row], columns, strict=True):
                ax.contourf(axis, axis, cost, levels=18, cmap="Greys", alpha=0.55)
                for record in runs:
                    x, y = (np.asarray(record.curves[f"{what}_{c}"], dtype=float) for c in "xy")
                    ax.plot(x, y, color=_TOY.get(name, style.INK), lw=0.9, marker="o", ms=1.6, alpha=0.7)
                ax.plot(*toy.START, marker="o", color=style.INK, ms=5)
                ax.plot(*toy.GOAL, marker="*", color=style.CONTACT, ms=10)
                ax.set_aspect("equal")
                ax.set_title(f"{name}, {title}")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Software": "rumi"})
    return [path]


def _panel(records: Sequence[Record], name: str, ax: "Axes") -> None:
    allowed = max((int(record.figures["allowed"]) for record in records), default=0)
    scale = 1e3 if name == "apc" else 1.0
    more = iter(_MORE * 4)
    for _, runs in by_column(records):
        courses = [held(record.curves[name], allowed)[: allowed + 1] for record in runs]
        low, mid, high = scale * quartiles(courses)
        plain = not runs[0].overrides
        label = " ".join([paper.METHODS.get(runs[0].method, runs[0].method), *runs[0].overrides])
        colour = COLOURS.get(runs[0].method, next(more)) if plain else next(more)
        steps = np.arange(allowed + 1)
        ax.fill_between(steps, low, high, color=colour, alpha=0.15, lw=0)
        ax.plot(steps, mid, color=colour, lw=1.5, label=label)
    if records and name == "nll":
        ax.axhline(records[0].figures["nll_threshold"], color=style.QUIET, lw=0.8, ls=(0, (4, 3)))
    if records and name == "apc" and records[0].figures.get("diagonal"):
        ax.axhline(1e3 * 0.03 * records[0].figures["diagonal"], color=style.QUIET, lw=0.8, ls=(0, (4, 3)))
    ax.set_ylim(bottom=0)
    ax.set_xlabel("actions")
