"""Table I of the time-allocation paper, how exact its task ends, and what it takes in all, by the time allowed."""

import json
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from scripts.reproduce.cells import NOTHING, flags, middle, numbers, rate, table
from scripts.reproduce.peg import settings_of
from scripts.reproduce.records import Record

PRINTED = {10.0: (36.9, 53.9, 68.4, 83.5, 98.1), 20.0: (36.2, 57.2, 77.0, 97.4, 110.0)}
"""Table I: seconds at the four contacts and at the end, by t_max; one run each."""

_DRAWS = 2000


def by_settings(records: Sequence[Record]) -> Iterator[tuple[dict[str, object], list[Record]]]:
    """Runs of the same settings, with what is set of them."""
    groups: dict[tuple[str, ...], list[Record]] = {}
    for record in records:
        groups.setdefault(record.overrides, []).append(record)
    for overrides, own in groups.items():
        yield {name: _value(text) for name, _, text in (o.partition("=") for o in overrides)}, own


def _right(records: Sequence[Record]) -> str:
    """What "right" is, by the tolerance that was asked for."""
    asked = {settings_of(record.overrides).tolerance_m for record in records}
    return "both holes in tolerance" if len(asked) > 1 else f"both holes < {1e3 * asked.pop() if asked else 5.0:g} mm"


def times(records: Sequence[Record]) -> str:
    """Table I: when each contact came and the peg was in, by t_max, beside the paper's single runs."""
    heads = ["t_max", "runs", *(f"C{k}" for k in range(1, 5)), "peg in hole, s", "in a hole", _right(records)]
    rows = []
    for settings, own in by_settings(records):
        t_max = float(settings["t_max_s"])  # type: ignore[arg-type]
        touched = [record.curves["contact_s"][:4] for record in own]
        cells = [middle([float(t) for row in touched for t in row[k : k + 1] if t is not None]) for k in range(4)]
        ended = [middle(numbers(own, "total_s")), rate(flags(own, "in_hole")), rate(flags(own, "right"))]
        rows.append([f"{t_max:g} s", str(len(own)), *cells, *ended])
        if t_max in PRINTED:
            printed = [f"{value:g}" for value in PRINTED[t_max]]
            rows.append([f"{t_max:g} s, the paper", "1", *printed, "yes", NOTHING])
    return table(heads, rows)


def faster(records: Sequence[Record]) -> str:
    """A sentence on how many seconds sooner the shorter time ends, pose by pose."""
    ended: dict[float, dict[int, float]] = {}
    for settings, own in by_settings(records):
        ended[float(settings["t_max_s"])] = {r.seed: r.figures["total_s"] for r in own}  # type: ignore[arg-type]
    if not ended.keys() >= {10.0, 20.0}:
        return ""
    apart = [ended[20.0][seed] - ended[10.0][seed] for seed in ended[10.0].keys() & ended[20.0].keys()]
    return f"At 10 s it ends sooner by {middle(apart)} s, pose by pose (median of {len(apart)}); the paper: 11.9 s."


def accuracy(records: Sequence[Record]) -> str:
    """How exact the runs end, by noise and rule to stop."""
    heads = ["noise", "stops", "runs", "touches", _right(records), "believed", "middle < 5 mm", "in a hole"]
    heads += ["< 2.5 mm", "worse hole off, mm", "total, s"]
    rows = []
    for settings, own in by_settings(records):
        noise = settings_of([f"{k}={json.dumps(v)}" for k, v in settings.items()])
        stops = "4 contacts on 2 sides" if noise.stop == "contacts" else f"P >= {noise.probability:g}"
        rows.append(
            [
                f"{1e3 * noise.point_m:g} mm, {noise.normal_deg:g} deg",
                stops,
                str(len(own)),
                middle(numbers(own, "touches")),
                rate(flags(own, "right")),
                f"{statistics.mean(numbers(own, 'probability')):.3f}",
                rate([value < 5.0 for value in numbers(own, "middle_error_mm")]),
                rate(flags(own, "in_hole")),
                rate([value < 2.5 for value in numbers(own, "off_mm")]),
                middle(numbers(own, "hole_error_mm")),
                middle(numbers(own, "total_s"), 0),
            ]
        )
    return table(heads, rows)


def totals(records: Sequence[Record]) -> str:
    """Total time to the accuracy that is asked for, by t_max and evaluation time, the least marked."""
    heads = ["s a candidate", "t_max, s", "runs", "total, s: mean", "median", "search", "reasoning", "touches"]
    heads += ["candidates a decision", "doublings a decision", "sure", "unsure at the most actions"]
    heads += [_right(records), "in a hole"]
    rows = []
    for machine, courses in _machines(records).items():
        least = _least(courses)
        for t_max, own in sorted(courses.items()):
            centre, low, high = _mean(own)
            cells = f"{centre:.0f} [{low:.0f}, {high:.0f}]"
            decisions = sum(numbers(own, "actions"))
            rows.append(
                [
                    _seconds(machine, courses),
                    f"{t_max:g}",
                    str(len(own)),
                    f"**{cells}**" if t_max == least else cells,
                    f"{statistics.median(numbers(own, 'total_s')):.0f}",
                    f"{statistics.mean(numbers(own, 'search_s')):.0f}",
                    f"{statistics.mean(numbers(own, 'thinking_s')):.0f}",
                    f"{statistics.mean(numbers(own, 'touches')):.1f}",
                    f"{sum(numbers(own, 'evaluated')) / max(1.0, decisions):.1f}",
                    f"{sum(numbers(own, 'doublings')) / max(1.0, decisions):.2f}",
                    f"{_sure(own)}/{len(own)}",
                    rate([record.figures["stopped_by"] == "steps" for record in own]),
                    rate(flags(own, "right")),
                    rate(flags(own, "in_hole")),
                ]
            )
    return table(heads, rows)


def draw_totals(records: Sequence[Record], path: Path) -> list[Path]:
    """Total time over t_max for each evaluation time, the least marked, hollow where runs ended unsure.

    A run that ends at the most actions would have taken longer to be sure: its total is a bound from below.
    """
    from rumi.viz import style

    machines = _machines(records)
    if not machines:
        return []
    colours = [style.CONTACT, style.NLL, style.EXPECTED]
    with style.figure(5.6, 3.6) as figure:
        ax = figure.subplots()
        for (machine, courses), colour in zip(machines.items(), colours * len(machines), strict=False):
            t_max = sorted(courses)
            centre, low, high = np.array([_mean(courses[t]) for t in t_max]).T
            least = _least(courses)
            label = f"{_seconds(machine, courses)} s a candidate, {max(map(len, courses.values()))} poses"
            if least is not None:
                best = t_max.index(least)
                # in the legend: beside the star it may lie on another curve
                label += f", {centre[best]:.0f} s at best"
                ax.plot(least, centre[best], marker="*", color=colour, ms=13, mec="white", zorder=4)
            ax.fill_between(t_max, low, high, color=colour, alpha=0.15, lw=0)
            ax.plot(t_max, centre, color=colour, lw=1.6, marker="o", ms=3.5, label=label)
            bounds = [k for k, t in enumerate(t_max) if not _reached(courses[t])]
            ax.plot([t_max[k] for k in bounds], centre[bounds], color=colour, lw=0, marker="o", ms=4.5, mfc="white")
        ax.set_xscale("log")
        ticks = sorted({t for courses in machines.values() for t in courses})
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
        ax.minorticks_off()
        ax.set_ylim(bottom=0)
        ax.set_xlabel("t_max: seconds for a decision and its motion")
        ax.set_ylabel("total time, peg included [s]")
        ax.set_title("until P >= 0.95; hollow: more than 1 in 10 ended unsure, at the most actions", fontsize=8)
        ax.legend(loc="upper left")
        return [_saved(figure, path)]


def draw_runs(seed: int, folder: Path) -> list[Path]:
    """Contacts and time-lines of one pose at t_max 10 and 20 s, and first decisions (the paper's Figures 5-7 and 1)."""
    from rumi import loop
    from rumi.tasks.peg import figures as peg
    from rumi.tasks.peg.agent import build_peg
    from rumi.viz import style

    runs = [loop.run_to_end(*build_peg(settings_of([f"t_max_s={t}", "stop=contacts"])), seed=seed) for t in (10, 20)]
    with style.figure(9.0, 3.4) as figure:
        axes = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
        peg.draw_contacts(runs[0], axes[0]).set_title("t_max 10 s, the table")
        for ax, run in zip(axes[1:], runs, strict=True):
            peg.draw_contacts(run, ax, around_m=0.18).set_title(f"t_max {run.settings.action_budget_s:g} s")
        written = [_saved(figure, folder / "allocation-contacts.png")]
    with style.figure(9.0, 4.2) as figure:
        grid = figure.subplots(2, 2)
        for row, run in zip(grid, runs, strict=True):
            seconds = f"t_max {run.settings.action_budget_s:g} s: {run.total_s:.0f} s in all"
            peg.draw_timeline(run, row[0]).set_title(seconds)
            if run.thoughts:
                peg.draw_decision(run.thoughts[0], row[1]).set_title("the first decision")
        written.append(_saved(figure, folder / "allocation-timeline.png"))
    return written


def _machines(records: Sequence[Record]) -> dict[float | None, dict[float, list[Record]]]:
    """Runs by evaluation time and t_max; None for what was measured."""
    found: dict[float | None, dict[float, list[Record]]] = {}
    for settings, own in by_settings(records):
        machine = settings.get("evaluation_s", 1.0)
        course = found.setdefault(None if machine is None else float(machine), {})  # type: ignore[arg-type]
        course[float(settings["t_max_s"])] = own  # type: ignore[arg-type]
    return found


def _seconds(machine: float | None, courses: dict[float, list[Record]]) -> str:
    """Seconds that a candidate takes: as stated, or the median of what was measured."""
    if machine is not None:
        return f"{machine:g}"
    took = [record.figures["evaluation_s"] for own in courses.values() for record in own]
    return f"measured, {statistics.median([s for s in took if s is not None] or [0.0]):.2g}"


def _sure(records: Sequence[Record]) -> int:
    """Runs that became as sure as was asked for."""
    return sum(record.figures["stopped_by"] == "sure" for record in records)


def _least(courses: dict[float, list[Record]]) -> float | None:
    """The t_max of the least mean total, among those at which nine of ten runs became sure."""
    reached = [t for t, own in courses.items() if _reached(own)]
    return min(reached, key=lambda t: _mean(courses[t])[0], default=None)


def _reached(records: Sequence[Record]) -> bool:
    """Whether nine of ten runs became sure."""
    return _sure(records) >= 0.9 * len(records)


def _mean(records: Sequence[Record]) -> tuple[float, float, float]:
    """Mean of the total time with its bootstrap interval (95 %)."""
    values = np.array(numbers(records, "total_s"))
    drawn = np.random.default_rng(0).choice(values, (_DRAWS, len(values))).mean(1)
    return float(values.mean()), *(float(q) for q in np.quantile(drawn, (0.025, 0.975)))  # type: ignore[return-value]


def _value(text: str) -> object:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def _saved(figure: object, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Software": "rumi"})  # type: ignore[attr-defined]
    return path
