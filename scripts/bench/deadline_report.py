"""Deadlines in tables and figures, from the lines of a store."""

import statistics
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rumi.viz import style
from scripts.reproduce.cells import table
from scripts.reproduce.intervals import wilson
from scripts.store import Store

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = dict[str, Any]
_NOISES = ("lognormal", "exponential", "stalls")
_COLOURS = {"touch": style.CONTACT, "rumi": style.NLL, "gpvr": style.APC, "slide": style.QUIET, "reach-only": style.INK}
_OTHER = style.EXPECTED
_HISTOGRAM_KEY = "solid line: the budget\ndotted: late from here on\nheights: logarithmic"


def tolerance_s(budget_s: float) -> float:
    """By how much a decision may be late before it counts as that: 5 ms, or a tenth of its budget."""
    return max(0.005, 0.1 * budget_s)


def tables(store: Store) -> str:
    """Markdown of all that was measured."""
    parts = [_simulated_table(store.of("simulated")), _real_table(store.of("real")), _value_table(store)]
    return "\n".join(part for part in parts if part)


def _simulated_table(rows: list[Row]) -> str:
    kinds = defaultdict(list)
    for row in rows:
        kinds[row["noise"], row["level"]].append(row)
    found = []
    for (noise, level), own in kinds.items():
        count = sum(row["decisions"] * len(row["late"]) for row in own)
        missed = sum(sum(row["late"].values()) for row in own)
        worst = max(0.0, *(share for row in own for share in row["latest"].values()))
        allowed = "none" if noise == "exact" else f"{100 * (1 - level):g} %"
        told = "" if noise == "exact" else f"{level:g}"
        late = f"{missed} ({100 * missed / count:.2f} %)"
        found.append([noise, told, str(count), late, allowed, f"{worst:.2f}"])
    return table(("evaluation times", "level", "decisions", "late", "allowed", "latest, share of the time"), found)


def _real_table(rows: list[Row]) -> str:
    kinds = defaultdict(list)
    for row in rows:
        kinds[row["clock"], row["task"], row["planner"], row["budget_s"], row["threads"]].append(row)
    found = []
    for (clock, task, planner, budget, threads), own in kinds.items():
        took = sorted(s for row in own for s in row["took_s"])
        late = sum(s > budget + tolerance_s(budget) for s in took)
        low, high = (100 * share for share in wilson(late, len(took)))
        done = [count for row in own for count in row["evaluated" if planner == "touch" else "samples"]]
        middle, most = statistics.median(took), took[min(len(took) - 1, int(0.99 * len(took)))]
        times = [f"{1e3 * s:.1f} ms" for s in (middle, most, took[-1])]
        about = [clock, str(threads), task, planner, f"{1e3 * budget:g} ms", str(len(took))]
        found.append([*about, *times, f"{late} [{low:.1f}, {high:.1f}] %", f"{statistics.median(done):g}"])
    heads = (
        "clock",
        "threads",
        "task",
        "planner",
        "budget",
        "decisions",
        "median",
        "99 %",
        "latest",
        "late",
        "samples",
    )
    return table(heads, found)


def _value_table(store: Store) -> str:
    kinds = values_by_budget(store)
    found = []
    for (task, planner), budgets in kinds.items():
        before: dict[Any, float] | None = None
        for budget, values in budgets.items():
            shared = [] if before is None else [values[key] - before[key] for key in values if key in before]
            change = "" if len(shared) < 2 else f"{statistics.mean(shared):+.4f} +- {_error(shared):.4f}"
            name = "none" if budget is None else f"{1e3 * budget:g} ms"
            mean = statistics.mean(values.values())
            found.append([task, planner, name, str(len(values)), f"{mean:.4f}", change])
            before = values
    return table(("task", "planner", "budget", "decisions", "mean value", "against the budget before"), found)


def values_by_budget(store: Store) -> dict[tuple[str, str], dict[float | None, dict[tuple[int, int], float]]]:
    """Values by task and planner, then budget (ascending, none last), then seed and decision."""
    kinds: dict[tuple[str, str], dict[float | None, dict[tuple[int, int], float]]] = {}
    for row in store.of("value"):
        own = kinds.setdefault((row["task"], row["planner"]), {}).setdefault(row["budget_s"], {})
        own |= {(row["seed"], index): value for index, value in enumerate(row["values"])}
    order = {kind: sorted(own, key=lambda b: (b is None, b or 0.0)) for kind, own in kinds.items()}
    return {kind: {budget: own[budget] for budget in order[kind]} for kind, own in kinds.items()}


def draw(store: Store, out: Path, clock: str = "wall") -> list[Path]:
    """Draw what was measured, real decisions of one clock only.

    Returns:
        the files written.
    """
    out.mkdir(parents=True, exist_ok=True)
    real = [row for row in store.of("real") if row["clock"] == clock]
    asked = {row["planner"]: set[float]() for row in real}
    for row in real:
        asked[row["planner"]].add(row["budget_s"])
    # at the bottom those with budgets of their own, so that every column ends in a panel
    planners = sorted(asked, key=lambda planner: len(asked[planner]))
    budgets = sorted({row["budget_s"] for row in real})
    paths = [out / "deadlines.png"]
    with style.figure(11.0, 3.4) as made:
        first, second, third = made.subplots(1, 3)
        _draw_late(store.of("simulated"), first)
        _draw_gains(store.of("simulated"), second)
        _draw_values(store, third)
        made.savefig(paths[0])
    if planners:
        paths.append(out / "deadline_histogram.png")
        with style.figure(2.2 * len(budgets) + 1.0, 1.15 * len(planners) + 0.8) as made:
            panels = made.subplots(len(planners), len(budgets), squeeze=False, sharex="col")
            for planner, row_of in zip(planners, panels, strict=True):
                for budget, axis in zip(budgets, row_of, strict=True):
                    _histogram(real, planner, budget, axis)
            for column in zip(*panels, strict=True):
                lowest = [axis for axis in column if axis.has_data()][-1]
                lowest.tick_params(labelbottom=True)
                lowest.set_xlabel("milliseconds")
            first = panels[0][0]
            if not first.has_data():
                first.text(0.0, 1.0, _HISTOGRAM_KEY, transform=first.transAxes, va="top", fontsize=7)
            made.savefig(paths[1])
    return paths


def _histogram(rows: list[Row], planner: str, budget: float, axis: "Axes") -> None:
    took = [1e3 * s for row in rows if (row["planner"], row["budget_s"]) == (planner, budget) for s in row["took_s"]]
    if not took:
        axis.set_axis_off()
        return
    limit = 1e3 * (budget + tolerance_s(budget))
    late = sum(s > limit for s in took)
    top = 1.3 * limit
    beyond = sum(s > top for s in took)
    axis.hist(
        [min(s, top) for s in took],
        bins=52,
        range=(0.0, top),
        color=_COLOURS.get(planner, _OTHER),
        log=True,
        bottom=0.8,
    )
    axis.axvline(1e3 * budget, color=style.INK, linewidth=0.8)
    axis.axvline(limit, color=style.INK, linewidth=0.8, linestyle=":")
    axis.set_ylim(bottom=0.8)
    axis.set_yticks([])
    axis.minorticks_off()
    # the same for all of a column: budget, and where a decision counts as late
    axis.set_xticks([0.0, 1e3 * budget, limit], ["0", f"{1e3 * budget:g}", f"\n{limit:g}"])
    axis.set_title(f"{planner}, {1e3 * budget:g} ms: {late} of {len(took)} late", fontsize=7.5)
    if beyond:
        # drawn in the last bar
        words = f"{beyond} beyond,\nup to {max(took):.0f}"
        axis.text(0.98, 0.93, words, transform=axis.transAxes, ha="right", va="top", fontsize=6.5)


def _draw_late(rows: list[Row], axis: "Axes") -> None:
    """Share of late decisions by budget, against what the level allows."""
    axis.set_title("Late decisions, simulated clock")
    axis.set_xscale("log")
    axis.set_xlabel("budget, s")
    axis.set_ylabel("late, %")
    for noise, colour in zip(_NOISES, (style.NLL, style.APC, style.CONTACT), strict=True):
        for level, line in ((0.9, "-"), (0.99, "--")):
            own = [row for row in rows if (row["noise"], row["level"]) == (noise, level)]
            if own:
                budgets = list(own[0]["late"])
                count = sum(row["decisions"] for row in own)
                shares = [100 * sum(row["late"][budget] for row in own) / count for budget in budgets]
                axis.plot([float(b) for b in budgets], shares, line, color=colour, label=f"{noise}, {level:g}")
    for allowed in (1.0, 10.0):
        axis.axhline(allowed, color=style.QUIET, linewidth=0.7, linestyle=":")
    if rows:
        axis.legend(fontsize=6.5)


def _draw_gains(rows: list[Row], axis: "Axes") -> None:
    """Mean gain by budget."""
    axis.set_title("What selection finds, simulated clock")
    axis.set_xscale("log")
    axis.set_xlabel("budget, s")
    axis.set_ylabel("mean gain, nats")
    noises = ("exact", *_NOISES)
    for noise, colour in zip(noises, (style.INK, style.NLL, style.APC, style.CONTACT), strict=True):
        own = [row["gain"] for row in rows if (row["noise"], row["level"]) == (noise, 0.9)]
        if own:
            means = [statistics.mean(gain[budget] for gain in own) for budget in own[0]]
            axis.plot([float(b) for b in own[0]], means, "o-", markersize=3, color=colour, label=noise)
    if rows:
        axis.legend(fontsize=6.5)


def _draw_values(store: Store, axis: "Axes") -> None:
    """Value against that without a budget, by budget."""
    axis.set_title("What plans are worth")
    axis.set_xscale("log")
    axis.set_xlabel("budget, s (none at the right)")
    axis.set_ylabel("share of the best mean value")
    for (task, planner), budgets in values_by_budget(store).items():
        means = {budget: statistics.mean(values.values()) for budget, values in budgets.items()}
        errors = {budget: _error(list(values.values())) for budget, values in budgets.items()}
        best = max(means.values())
        if best <= 0:
            continue
        places = [4.0 if budget is None else budget for budget in means]
        shares = [mean / best for mean in means.values()]
        spread = [error / best for error in errors.values()]
        colour = _COLOURS.get(planner, _OTHER)
        axis.errorbar(places, shares, spread, fmt="o-", markersize=3, color=colour, label=f"{planner}, {task}")
    if axis.has_data():
        axis.legend(fontsize=6.5)


def _error(values: list[float]) -> float:
    """Standard error of a mean."""
    return statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else 0.0
