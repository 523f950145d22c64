"""The peg task drawn: where the block was touched, and how the time went, reasoning against motion."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from rumi.information.contact_gain import ContactKind
from rumi.tasks.peg.records import PegRun
from rumi.tasks.peg.selection import Thought
from rumi.viz import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SEARCH = style.FREE
_THINK = style.EXPECTED
_MOVE = style.SURFACE
_TOGETHER_M = 0.02  # touches of a cluster, which are on the same side too


def draw_run(run: PegRun, folder: Path) -> list[Path]:
    """Contacts and time-line of a run, as files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / "contacts.png", folder / "timeline.png"]
    with style.figure(9.0, 4.0) as figure:
        whole, close = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
        draw_contacts(run, whole)
        draw_contacts(run, close, around_m=0.18)
        figure.legend(*_legend(), loc="outside lower center", ncols=4)
        style.save(figure, written[0])
    with style.figure(9.0, 2.8) as figure:
        one, two = figure.subplots(1, 2)
        draw_timeline(run, one)
        if run.thoughts:
            draw_decision(run.thoughts[0], two).set_title("the first decision")
        style.save(figure, written[1])
    return written


def draw_contacts(run: PegRun, ax: "Axes", *, around_m: float | None = None) -> "Axes":
    """The table from above: the ball's way, what it touched in order, and where the holes were thought to be.

    Args:
        run: what was done.
        ax: where to draw.
        around_m: half of the width of a close-up of the block; None for the whole table.
    """
    from matplotlib.patches import Circle, Polygon, Rectangle

    own = run.settings
    width, height = own.table_m
    ax.add_patch(Rectangle((-0.5 * width, -0.5 * height), width, height, fc="none", ec=style.QUIET, lw=0.8, ls=":"))
    for number, felt in enumerate((*run.searched, *run.felt)):
        searching = number < len(run.searched)
        x, y = felt.path[:, 0].tolist(), felt.path[:, 1].tolist()
        ax.plot(x, y, color=_SEARCH if searching else style.TOOL, lw=1.6 if searching else 0.7, alpha=0.9, zorder=1)
    half = own.block.half()
    corners = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64) * half
    x, y, yaw = run.truth.tolist()
    turn = torch.tensor([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]], dtype=torch.float64)
    outline = corners @ turn.mT + run.truth[:2]
    ax.add_patch(Polygon(outline.numpy(), fc=style.FAINT, ec=style.TRUTH, lw=1.2, alpha=0.8, zorder=2))
    for hole in own.block.holes(run.truth).tolist():
        ax.add_patch(Circle(hole, 0.015, fc="white", ec=style.TRUTH, lw=0.8, zorder=3))
    for guess in [] if run.aim is None else run.aim.points.tolist():
        ax.plot(*guess, marker="+", color=style.CONTACT, ms=7, zorder=5)
    touches: list[tuple[np.ndarray, np.ndarray]] = []
    for felt in (*run.searched, *run.felt):
        if felt.kind == ContactKind.NOTHING:
            ax.plot(*felt.tip[:2].tolist(), marker="x", color=style.QUIET, ms=4, zorder=4)
            continue
        px, py = felt.point.tolist()
        ax.plot(px, py, marker="o" if felt.kind == ContactKind.TOUCH else "s", color=style.CONTACT, ms=3.5, zorder=4)
        if felt.kind == ContactKind.TOUCH:
            nx, ny = (0.02 * felt.normal).tolist()
            ax.plot([px, px + nx], [py, py + ny], color=style.CONTACT, lw=1.0, zorder=4)
            touches.append((felt.point.numpy(), felt.normal.numpy()))
    for words, place, normal in clusters(touches) if around_m is not None else ():
        x, y = (place + 0.026 * normal).tolist()
        aligned = ("left", "center", "right")[1 - round(float(normal[0]))]
        ax.annotate(words, (x, y), ha=aligned, va="center", fontsize=7, zorder=6, clip_on=True,
                    bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 0.6})  # fmt: skip
    if run.inserted is not None:
        ax.plot(*run.inserted.at.tolist(), marker="*", color=style.NLL, ms=9, zorder=6)
    ax.set_aspect("equal")
    if around_m is not None:
        x, y = run.truth[:2].tolist()
        ax.set_xlim(x - around_m, x + around_m)
        ax.set_ylim(y - around_m, y + around_m)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return ax


def clusters(touches: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Numbers of touches that lie close together, such as "4, 7-9", with their middle and the normal of the first.

    Args:
        touches: points (2) and outward normals (2), in the order in which they were touched.
    """
    found: list[list[int]] = []
    for index, (point, normal) in enumerate(touches):
        for members in found:
            first, outward = touches[members[0]]
            if float(np.hypot(*(point - first))) < _TOGETHER_M and float(outward @ normal) > 0.5:
                members.append(index)
                break
        else:
            found.append([index])
    named = []
    for members in found:
        runs: list[list[int]] = []
        for number in members:
            if runs and number == runs[-1][-1] + 1:
                runs[-1].append(number)
            else:
                runs.append([number])
        words = ", ".join(f"{run[0] + 1}" + (f"–{run[-1] + 1}" if len(run) > 1 else "") for run in runs)
        named.append((words, np.mean([touches[member][0] for member in members], 0), touches[members[0]][1]))
    return named


def _legend() -> tuple[list[Any], list[str]]:
    """What is drawn in which way."""
    from matplotlib.lines import Line2D

    dot = {"lw": 0.0, "marker": "o"}
    kinds: dict[str, dict[str, Any]] = {
        "search": {"color": _SEARCH, "lw": 1.6},
        "motion": {"color": style.TOOL, "lw": 0.7},
        "touch from aside, in order, with its normal": dot | {"color": style.CONTACT, "ms": 3.5},
        "touch from above": dot | {"marker": "s", "color": style.CONTACT, "ms": 3.5},
        "nothing there": dot | {"marker": "x", "color": style.QUIET, "ms": 4},
        "hole, as believed at the end": dot | {"marker": "+", "color": style.CONTACT, "ms": 7},
        "peg inserted": dot | {"marker": "*", "color": style.NLL, "ms": 8},
        "block and holes": {"color": style.TRUTH, "lw": 1.2},
    }
    return [Line2D([], [], **kind) for kind in kinds.values()], list(kinds)


def draw_timeline(run: PegRun, ax: "Axes") -> "Axes":
    """The whole run: searching, then by turns reasoning and motion, touches as marks, in the order of time."""
    for felt in run.searched:
        _bar(ax, 0, felt.begun_s, felt.ended_s, _SEARCH)
    moved = 0.0
    for thought in run.thoughts:
        _bar(ax, 1, thought.begun_s, thought.ended_s, _THINK)
    for felt in run.felt:
        _bar(ax, 2, felt.begun_s, felt.ended_s, _MOVE)
        moved += felt.ended_s - felt.begun_s
    for felt in (*run.searched, *run.felt):
        if felt.kind != ContactKind.NOTHING:
            shape = "o" if felt.kind == ContactKind.TOUCH else "s"
            row = 0 if felt.ended_s <= run.search_s else 2
            ax.plot(felt.ended_s, row, marker=shape, color=style.CONTACT, ms=4, zorder=3)
    _bar(ax, 3, run.felt[-1].ended_s if run.felt else run.search_s, run.total_s, style.NLL)
    thinking = sum(thought.ended_s - thought.begun_s for thought in run.thoughts)
    rows = [f"search {run.search_s:.0f} s", f"reasoning {thinking:.0f} s", f"motion {moved:.0f} s", "peg"]
    ax.set_yticks(range(4), rows)
    ax.invert_yaxis()
    ax.set_xlim(0, 1.02 * run.total_s or 1.0)
    ax.set_xlabel("time [s]")
    ax.set_axisbelow(True)
    ax.grid(axis="x", color=style.FAINT, lw=0.6)
    return ax


def draw_decision(thought: Thought, ax: "Axes") -> "Axes":
    """One decision as in the paper's Figure 1: the time that is left against what the best action so far takes."""
    selection = thought.selection
    end, limit = selection.thinking_s, selection.t_max_s
    ax.plot([0.0, limit], [limit, 0.0], color=style.QUIET, lw=1.0, label="time left")
    best = [(0.0, 0.0)]
    for row in selection.history:
        if row.taken:
            best.append((row.ended_s, row.execution_s))
        ax.plot(row.ended_s, row.execution_s, marker="o", ms=6 if row.taken else 3.5,
                color=style.CONTACT if row.taken else style.FREE, zorder=3)  # fmt: skip
        ax.annotate(f"{row.gain:.2f}", (row.ended_s, row.execution_s), textcoords="offset points", xytext=(0, 6),
                    ha="center", fontsize=6.5)  # fmt: skip
    best.append((end, best[-1][1]))
    ax.step(*zip(*best, strict=True), where="post", color=_THINK, lw=1.6, label="motion of the best so far")
    if selection.candidate is not None:
        ax.plot([end, end + selection.candidate.execution_s], [0.0, 0.0], color=_MOVE, lw=5, solid_capstyle="butt")
        ax.axvline(end, color=style.INK, lw=0.8, ls=":")
    ax.set_xlim(0, limit)
    ax.set_ylim(bottom=-0.02 * limit)
    ax.set_xlabel("since the decision began [s]")
    ax.set_ylabel("seconds of motion")
    ax.legend(loc="upper right")
    return ax


def _bar(ax: "Axes", row: int, begun: float, ended: float, colour: str) -> None:
    ax.barh(row, ended - begun, left=begun, height=0.7, color=colour, lw=0)
