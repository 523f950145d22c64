"""Figures of touch alone: beliefs, chosen and rejected pokes, the grasp."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.sliding import rotated
from rumi.resampling import systematic
from rumi.tasks.touch_box.records import TouchRun, TouchStep
from rumi.tasks.touch_box.scene import TouchTask
from rumi.viz import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BOXES = 80  # particles that are drawn
_PANELS, _COLUMNS = 8, 5


def draw_run(run: TouchRun, task: TouchTask, threshold: float, folder: Path) -> list[Path]:
    """Beliefs with pokes and the grasp (pokes.png), and how sure the belief was (sure.png)."""
    shown = _shown(len(run.steps))
    columns = min(_COLUMNS, len(shown) + 2)
    rows = math.ceil((len(shown) + 2) / columns)
    limits = _limits(run, task)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "pokes.png", folder / "sure.png"]
    width = 2.0 * columns
    tall = width / columns * (limits[3] - limits[2]) / (limits[1] - limits[0]) + 0.35
    with style.figure(width + 0.6, rows * tall + 0.9) as figure:
        axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
        for ax in axes[len(shown) + 2 :]:
            ax.set_axis_off()
        panel(axes[0], run.first.belief, task, limits, f"prior: {len(run.first.belief[0])} particles")
        draw_box(axes[0], run.first.truth, task, color=style.TRUTH, linewidth=1.2)
        for ax, index in zip(axes[1:], shown, strict=False):
            step = run.steps[index]
            panel(ax, step.belief, task, limits, f"poke {index + 1}: P(lift) {step.grasp.probability:.2f}")
            draw_pokes(ax, step)
            draw_box(ax, step.truth, task, color=style.TRUTH, linewidth=1.2)
        last = axes[len(shown) + 1]
        panel(last, run.end.belief, task, limits, "grasp: " + ("lifted" if run.lifted else "not lifted"))
        draw_box(last, run.end.truth, task, color=style.TRUTH, linewidth=1.2)
        draw_grasp(last, run.end.grasp.pose, task)
        _axes(axes, columns, limits, len(shown) + 2)
        figure.legend(*_legend(), loc="outside lower center", ncols=4)
        style.save(figure, paths[0])
    with style.figure(4.2, 2.6) as figure:
        ax = figure.subplots()
        chance = [step.grasp.probability for step in run.steps]
        ax.plot(range(1, len(chance) + 1), chance, color=style.NLL, marker="o", markersize=3)
        ax.axhline(threshold, color=style.QUIET, linewidth=0.8, linestyle="--")
        ax.set(xlabel="pokes", ylabel="believed chance of lifting", ylim=(0.0, 1.02), title="How sure the belief is")
        style.save(figure, paths[1])
    return paths


def panel(
    ax: "Axes",
    belief: tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]],
    task: TouchTask,
    limits: tuple[float, float, float, float],
    title: str,
) -> None:
    """A belief from above: boxes of equal shares of it, over one another."""
    poses, log_weights = belief
    for pose in poses[systematic(log_weights, 0.5, _BOXES)]:
        draw_box(ax, pose, task, color=style.EXPECTED, linewidth=0.5, alpha=0.25)
    ax.set_title(title)
    ax.set_aspect("equal")
    ax.set(xlim=limits[:2], ylim=limits[2:])


def _axes(axes: "list[Axes]", columns: int, limits: tuple[float, float, float, float], count: int) -> None:
    """Metres at the outer panels alone, and a bar of a decimetre in the first one."""
    for index, ax in enumerate(axes[:count]):
        left, below = index % columns == 0, index + columns >= count
        ax.locator_params(nbins=4)
        ax.tick_params(labelleft=left, labelbottom=below)
        ax.set(xlabel="x [m]" if below else "", ylabel="y [m]" if left else "")
    x, y = limits[0] + 0.05 * (limits[1] - limits[0]), limits[2] + 0.03 * (limits[3] - limits[2])
    axes[0].plot([x, x + 0.1], [y, y], color=style.INK, linewidth=2.0, solid_capstyle="butt")
    axes[0].annotate("100 mm", (x + 0.05, y), xytext=(0, 3), textcoords="offset points", ha="center", fontsize=7)


def _legend() -> tuple[list[Any], list[str]]:
    """What is drawn in which way."""
    from matplotlib.lines import Line2D

    kinds: dict[str, dict[str, Any]] = {
        f"belief: {_BOXES} boxes of equal weight": {"color": style.EXPECTED, "linewidth": 1.0},
        "true box": {"color": style.TRUTH, "linewidth": 1.2},
        "poke weighed, not chosen": {"color": style.QUIET, "linewidth": 0.8},
        "poke chosen": {"color": style.PATH, "linewidth": 1.0, "linestyle": ":"},
        "poke carried out": {"color": style.PATH, "linewidth": 1.8},
        "felt a contact": {"color": style.CONTACT, "marker": "o", "markersize": 4, "linewidth": 0},
        "grasp: where the box is taken to be": {"color": style.TOOL, "linewidth": 1.2, "linestyle": "--"},
        "grasp: fingers": {"color": style.TOOL, "marker": "o", "markersize": 5, "linewidth": 0},
    }
    return [Line2D([], [], **kind) for kind in kinds.values()], list(kinds)


def draw_box(ax: "Axes", pose: Float[Tensor, "3"], task: TouchTask, **kind: Any) -> None:  # noqa: ANN401
    """Outline of the box at a pose."""
    signs = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]], dtype=pose.dtype)
    corners = pose[:2] + rotated(signs * pose.new_tensor(task.half), pose[2])
    ax.plot(*corners.T.tolist(), **kind)


def draw_pokes(ax: "Axes", step: TouchStep) -> None:
    """Rejected pokes, the chosen one, what was carried out of it, and its contact signals."""
    if step.candidates is not None and step.choice is not None:
        for index, path in enumerate(step.candidates):
            if index != step.choice.best:
                ax.plot(*path[:, :2].T.tolist(), color=style.QUIET, linewidth=0.5, alpha=0.6)
        ax.plot(*step.candidates[step.choice.best, :, :2].T.tolist(), color=style.PATH, linewidth=1.0, linestyle=":")
    assert step.touched is not None
    done = step.touched.path
    ax.plot(*done[:, :2].T.tolist(), color=style.PATH, linewidth=1.8)
    if len(step.touched.contact):
        felt = done[1:][step.touched.contact]
        ax.scatter(*felt[:, :2].T.tolist(), s=9, color=style.CONTACT, zorder=5)


def draw_grasp(ax: "Axes", pose: Float[Tensor, "3"], task: TouchTask) -> None:
    """Both fingers, open, and the box that they take to be there."""
    draw_box(ax, pose, task, color=style.TOOL, linewidth=1.2, linestyle="--")
    aside = 0.5 * task.opening_m + task.finger_m
    turn = np.linspace(0.0, 2.0 * math.pi, 25)
    for sign in (1.0, -1.0):
        x, y = (pose[:2] + rotated(pose.new_tensor([sign * aside, 0.0]), pose[2])).tolist()
        ax.fill(x + task.finger_m * np.cos(turn), y + task.finger_m * np.sin(turn), color=style.TOOL, alpha=0.8)


def _shown(count: int) -> list[int]:
    """Pokes that have a panel: the first, the last, and those between in even steps."""
    if count <= _PANELS:
        return list(range(count))
    return sorted({round(x) for x in np.linspace(0, count - 1, _PANELS).tolist()})


def _limits(run: TouchRun, task: TouchTask) -> tuple[float, float, float, float]:
    paths = [step.touched.path[:, :2] for step in run.steps if step.touched is not None]
    points = torch.cat([run.first.belief[0][:, :2], run.end.truth[None, :2], *paths])
    margin = max(task.half)
    low, high = points.quantile(0.005, 0) - margin, points.quantile(0.995, 0) + margin
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])
