"""Curves of a run: its metrics over the steps."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rumi.records import StepRecord
from rumi.viz import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_BEYOND = 10.0  # times what the belief expects at most, up to which the true surface's curve is followed


def nll_curve(
    steps: Sequence[StepRecord], ax: "Axes", *, threshold: float | None = None, last: int | None = None
) -> "Axes":
    """Negative log-likelihood of the true surface, and the one the belief expects, over the actions.

    Args:
        steps: of a run, from the first view on.
        ax: where to draw.
        threshold: line below which the paper counts a success.
        last: right end of the axis, where more steps may come.
    """
    number = [step.step for step in steps]
    known = [(step.step, step.nll) for step in steps if step.nll is not None]
    expected = [step.expected_nll for step in steps]
    if threshold is not None:
        _limit(ax, threshold, f"threshold {threshold:g}", at_left=_farther(expected, threshold))
    ax.plot(
        number, expected, color=style.EXPECTED, lw=1.4, ls=(0, (5, 2)), marker="s", ms=3, label="expected by the belief"
    )
    if known:
        ax.plot(*zip(*known, strict=True), color=style.NLL, lw=1.8, marker="o", ms=3.5, label="of the true surface")
    ax.set_ylim(0, 1.12 * highest_nll(steps, threshold))
    ax.set_ylabel("nll [nats]")
    return _steps(steps, ax, last)


def highest_nll(steps: Sequence[StepRecord], threshold: float | None) -> float:
    """Greatest negative log-likelihood that a curve shows; where the object was taken away its own leaves the axis."""
    own = float(np.nanmax([*(step.expected_nll for step in steps), threshold or 0.0, 1.0]))
    known = [step.nll for step in steps if step.nll is not None]
    return max(own, min(float(np.nanmax([*known, 0.0])), _BEYOND * own))


def apc_curve(
    steps: Sequence[StepRecord], ax: "Axes", *, threshold: float | None = None, last: int | None = None
) -> "Axes":
    """Average pairwise chamfer distance between the particles, over the actions; arguments as of `nll_curve`."""
    apc = [1e3 * step.apc for step in steps]
    ax.plot([step.step for step in steps], apc, color=style.APC, lw=1.8, marker="o", ms=3.5, label="APC")
    top = 1.2 * max(*apc, 0.1)
    if threshold is not None:
        _limit(ax, 1e3 * threshold, f"paper's stop {1e3 * threshold:.1f} mm", at_left=_farther(apc, 1e3 * threshold))
        top = max(top, 1.2e3 * threshold)
    again = [step.step for step in steps if step.resampled]
    if again:
        ax.scatter(
            again, [0.04 * top] * len(again), marker="^", s=22, color=style.INK, lw=0, label="resampled", zorder=4
        )
    ax.set_ylim(0, top)
    ax.set_ylabel("APC [mm]")
    return _steps(steps, ax, last)


def _farther(values: Sequence[float], threshold: float) -> bool:
    """Whether a curve keeps farther from a threshold in its left third than in its right one."""
    along = np.linspace(0.0, 1.0, 200)
    gap = np.abs(np.interp(along, np.linspace(0.0, 1.0, len(values)), values) - threshold)
    return bool(gap[along < 0.33].min() >= gap[along > 0.67].min())


def _limit(ax: "Axes", value: float, text: str, *, at_left: bool) -> None:
    """A dashed line with a word on it, at the end where there is room."""
    ax.axhline(value, color=style.QUIET, lw=0.8, ls=(0, (4, 3)), zorder=1)
    ax.annotate(
        text,
        (0.005 if at_left else 0.995, value),
        xycoords=("axes fraction", "data"),
        xytext=(0, 2),
        textcoords="offset points",
        ha="left" if at_left else "right",
        fontsize=7,
        color=style.QUIET,
    )


def touched(step: StepRecord) -> bool:
    """Whether the action that led to a step touched the object."""
    return step.control is not None and bool(step.reading.in_contact.any())


def _steps(steps: Sequence[StepRecord], ax: "Axes", last: int | None) -> "Axes":
    """The axis of actions, with a band behind those that touched."""
    for step in steps:
        if touched(step):
            ax.axvspan(step.step - 0.5, step.step + 0.5, color=style.CONTACT, alpha=0.10, lw=0, zorder=0)
    end = max(steps[-1].step if last is None else last, 1)
    ax.set_xlim(-0.5, end + 0.5)
    ax.xaxis.get_major_locator().set_params(integer=True)
    ax.grid(axis="y", color=style.FAINT, lw=0.6)
    ax.set_axisbelow(True)
    ax.set_xlabel("actions")
    return ax
