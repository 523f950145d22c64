"""Tables II and VII, the ablations and Figure 8 in figures, beside the paper's."""

import math
import statistics
from collections.abc import Sequence

from scripts.reproduce import paper
from scripts.reproduce.cells import NOTHING, flags, middle, numbers, rate, table
from scripts.reproduce.correlation import run_correlation
from scripts.reproduce.records import Record, by_column
from scripts.reproduce.tables import of_task

PROCESSES = (
    ("cache", "p(S), information field", ("fields", "push_model")),
    ("dynamics", "dynamics", ("dynamics",)),
    ("cost", "cost look-up", ("costs",)),
    ("gp_fit", "GP fit", ("gp_fit",)),
    ("gp_cost", "GP cost look-up", ("costs",)),
    ("", "sampling and weighing", ("planner",)),
)
"""Rows of Table VII: the paper's row by our name, what it says, and the stages of a plan that it sums."""


def correlation(records: Sequence[Record]) -> str:
    """Table II: linear correlation of nll and APC over the steps of all methods' runs, by preset and task."""
    tasks = list(dict.fromkeys(record.task for record in records))
    rows = []
    for preset in dict.fromkeys(record.label for record in records):
        own = [record for record in records if record.label == preset]
        methods = ", ".join(dict.fromkeys(record.method for record in own))
        for name, against in (("APC", "apc"), ("expected nll", "expected_nll")):
            cells = [_correlated(of_task(own, task), against) for task in tasks]
            if any(cell != NOTHING for cell in cells):
                rows.append([f"nll and {name}, {preset} ({methods})", *cells])
        if all(of_task(own, task) for task in tasks):
            spread = [_apc_range(of_task(own, task)) for task in tasks]
            if any(cell != NOTHING for cell in spread):
                rows.append([f"APC over the diagonal, {preset}: middle 90 % of the steps", *spread])
    printed = [f"{paper.CORRELATION[task]:.2f}" if task in paper.CORRELATION else NOTHING for task in tasks]
    return table(["", *tasks], [*rows, ["nll and APC, the paper", *printed]] if rows else [])


def seconds(records: Sequence[Record]) -> str:
    """Table VII: seconds of a planning pass by process, mean over the runs with the standard deviation between them."""
    columns = [(column, runs) for column, runs in by_column(records) if any(map(_planning, runs))]
    tasks = list(dict.fromkeys(record.task for record in records))
    heads, sides = ["process"], []
    for task in tasks:
        for column, runs in columns:
            here = [record for record in of_task(runs, task) if _planning(record)]
            if here:
                heads.append(f"{task} {column}")
                sides.append((task, here))
        heads.append(f"the paper, {paper.family(task)}")
        sides.append((task, []))
    rows = []
    for row, title, stages in PROCESSES:
        cells = []
        for task, runs in sides:
            known = paper.SECONDS.get(row, {}).get(paper.family(task))
            if runs:
                gp = runs[0].method.startswith("gpvr")
                cells.append(
                    NOTHING
                    if gp != row.startswith("gp") and row in ("cost", "gp_cost", "gp_fit")
                    else _mean(runs, stages)
                )
            else:
                cells.append(f"{known[0]:.3f} ({known[1]:.3f})" if known else NOTHING)
        if any(cell != NOTHING for cell in cells):
            rows.append([title, *cells])
    # methods that plan without these processes, and what the paper did not time
    kept = [k for k in range(len(heads)) if k == 0 or any(row[k] != NOTHING for row in rows)]
    return table([heads[k] for k in kept], [[row[k] for k in kept] for row in rows] if columns else [])


def ablation(records: Sequence[Record]) -> str:
    """How runs end by a setting."""
    tasks = list(dict.fromkeys(record.task for record in records))
    heads = ["method/preset, setting", *tasks, "right", "nll below the threshold at any step"]
    heads += ["actions", "cumulative nll", "s a run"]
    rows = []
    for column, runs in by_column(records):
        by_task = (of_task(runs, task) for task in tasks)
        rows.append(
            [
                column,
                *(f"{sum(flags(at, 'right'))} of {len(at)}" if at else NOTHING for at in by_task),
                rate(flags(runs, "right")),
                rate(flags(runs, "paper_success")),
                middle(numbers(runs, "steps"), 0),
                middle(numbers(runs, "cumulative_nll"), 0),
                f"{statistics.median(record.timings['wall_s'] for record in runs):.1f}",
            ]
        )
    return table(heads, rows)


def toy(records: Sequence[Record]) -> str:
    """Figure 8 in figures: cost and smoothness of each method over the seeds."""
    heads = ["method", "seeds", "cost met", "change of the controls", "jerk", "distance to the goal at the end"]
    heads += ["cost of the first plan", "its change", "its jerk"]
    rows = []
    for column, runs in by_column(records):
        names = ("cost", "change", "jerk", "end_distance", "plan_cost", "plan_change", "plan_jerk")
        cells = [middle(numbers(runs, name), 0 if name in ("cost", "plan_cost") else 1) for name in names]
        rows.append([column, str(len(runs)), *cells])
    return table(heads, rows)


def _correlated(records: Sequence[Record], against: str) -> str:
    runs = []
    for record in records:
        pairs = [
            (x, y)
            for x, y in zip(record.curves.get("nll", ()), record.curves.get(against, ()), strict=False)
            if x is not None and y is not None and math.isfinite(x) and math.isfinite(y)
        ]
        if pairs:
            runs.append(([x for x, _ in pairs], [y for _, y in pairs]))
    if not runs:
        return NOTHING
    centre, low, high = run_correlation(runs)
    return f"{centre:.2f} [{low:.2f}, {high:.2f}]" if math.isfinite(centre) else NOTHING


def _apc_range(records: Sequence[Record]) -> str:
    shares = sorted(
        100.0 * value / record.figures["diagonal"]
        for record in records
        if record.figures.get("diagonal")
        for value in record.curves.get("apc", ())
        if value is not None
    )
    if not shares:
        return NOTHING
    return f"{shares[len(shares) // 20]:.1f} to {shares[-1 - len(shares) // 20]:.1f} %"


def _planning(record: Record) -> bool:
    return bool(record.timings.get("plans"))


def _mean(runs: Sequence[Record], stages: Sequence[str]) -> str:
    values = [
        sum(record.timings["planning_s"].get(stage, 0.0) for stage in stages) / record.timings["plans"]
        for record in runs
        if any(stage in record.timings["planning_s"] for stage in stages)
    ]
    if not values:
        return NOTHING
    return f"{statistics.mean(values):.4f} ({statistics.stdev(values) if len(values) > 1 else 0.0:.4f})"
