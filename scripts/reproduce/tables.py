"""Tables V and VI: how often each method is right and how soon, beside the paper's figures."""

from collections.abc import Sequence

from scripts.reproduce import paper
from scripts.reproduce.cells import NOTHING, cumulative, flags, middle, numbers, plain_median, rate, table
from scripts.reproduce.intervals import bootstrap_total, bootstrap_total_difference, mcnemar
from scripts.reproduce.jobs import column_name
from scripts.reproduce.records import Record, by_column

MANY = 10
"""Failed runs of a column above which they are not listed one by one where most of them failed."""


def families(records: Sequence[Record]) -> dict[str, list[str]]:
    """Tasks of the runs by object."""
    found: dict[str, list[str]] = {}
    for task in dict.fromkeys(record.task for record in records):
        found.setdefault(paper.family(task), []).append(task)
    return {name: sorted(tasks) for name, tasks in found.items()}


def of_task(records: Sequence[Record], task: str) -> list[Record]:
    """The runs of a task."""
    return [record for record in records if record.task == task]


def successes(records: Sequence[Record]) -> str:
    """Table V: by object, how many runs were right at their own stop, and how many by the paper's lenient count."""
    parts = []
    for name, tasks in families(records).items():
        own = [record for record in records if record.task in tasks]
        bounds = sorted({record.figures["nll_threshold"] for record in own})
        heads = ["method/preset", *tasks, "right", f"nll <= {' or '.join(f'{b:g}' for b in bounds)} at any step"]
        heads += ["of these at step 0", "stopped by itself: right", "the paper, of 10"]
        rows = []
        for column, runs in by_column(own):
            cells = [
                f"{sum(flags(at, 'right'))} · {sum(flags(at, 'paper_success'))} of {len(at)}" if at else NOTHING
                for at in (of_task(runs, task) for task in tasks)
            ]
            sure = [record for record in runs if record.figures["stopped_by"] == "sure"]
            rows.append(
                [
                    column,
                    *cells,
                    rate(flags(runs, "right")),
                    rate(flags(runs, "paper_success")),
                    str(sum(flags(runs, "paper_success_at_start"))),
                    f"{len(sure)}: {sum(flags(sure, 'right'))}",
                    _printed(paper.SUCCESSES, runs[0].method, tasks),
                ]
            )
        parts.append(f"### {name}\n\n{table(heads, rows)}")
    return "\n".join(parts)


def cumulative_nll(records: Sequence[Record]) -> str:
    """Table VI: by object, the median cumulative nll of each task and their sum."""
    parts = []
    for name, tasks in families(records).items():
        own = [record for record in records if record.task in tasks]
        heads = ["method/preset", *tasks, "sum", "sum, the last nll held to the last step", "the paper"]
        rows = []
        for column, runs in by_column(own):
            groups = [of_task(runs, task) for task in tasks]
            rows.append(
                [
                    column,
                    *(plain_median(_values(group)) for group in groups),
                    _total(groups),
                    _total(groups, held=True),
                    _printed(paper.CUMULATIVE_NLL, runs[0].method, tasks),
                ]
            )
        parts.append(f"### {name}\n\n{table(heads, rows)}")
    return "\n".join(parts)


def endings(records: Sequence[Record]) -> str:
    """How the runs of each method end, by object."""
    parts = []
    heads = ["method/preset", "actions", "in contact", "position error, mm", "rotation error, deg", "s an action"]
    heads += ["s a run"]
    for name, tasks in families(records).items():
        own = [record for record in records if record.task in tasks]
        rows = []
        for column, runs in by_column(own):
            seconds = sum(record.timings["wall_s"] for record in runs)
            rows.append(
                [
                    column,
                    middle(numbers(runs, "steps"), 0),
                    plain_median(numbers(runs, "contacts")),
                    middle(numbers(runs, "position_error_mm")),
                    middle(numbers(runs, "rotation_error_deg")),
                    f"{seconds / max(1, sum(record.figures['steps'] for record in runs)):.2f}",
                    f"{seconds / len(runs):.1f}",
                ]
            )
        parts.append(f"### {name}\n\n{table(heads, rows)}")
    return "\n".join(parts)


def paired(records: Sequence[Record]) -> str:
    """Each column against rumi, run by run of the same task and seed, by object and in all.

    Held against rumi with the same preset where there is one; rumi with other presets and settings, and all else,
    against the first column of rumi.
    """
    columns = dict(by_column(records))
    first = next((name for name in columns if name.startswith("rumi/")), next(iter(columns), None))
    heads = ["first", "second", "tasks", "pairs", "right: both", "only the first", "only the second"]
    heads += ["McNemar, exact p", "nll below the threshold: p", "cumulative nll, second less first"]
    heads += ["the same, held to the last step"]
    rows = []
    for column, runs in columns.items():
        own = column_name("rumi", runs[0].label)
        other = own if own in columns and own != column else first
        if other is None or other == column:
            continue
        groups = families(runs)
        if len(groups) > 1:
            groups["all"] = [task for tasks in groups.values() for task in tasks]
        for name, tasks in groups.items():
            rows += _pair(columns[other], runs, [other, column, name], tasks)
    return table(heads, rows)


def failed(records: Sequence[Record]) -> str:
    """Every run of rumi that was not right, with what is known of its end; a column of which most were not as one."""
    heads = ["run", "seed", "ended", "actions", "in contact", "refused in part by the reach", "nll at the end (least)"]
    heads += ["off by"]
    rows = []
    for column, runs in by_column(record for record in records if record.method == "rumi"):
        wrong = [record for record in runs if not record.figures["right"]]
        if len(wrong) > MANY and 2 * len(wrong) > len(runs):
            rows.append([f"{column}: {len(wrong)} of {len(runs)} runs", *([NOTHING] * (len(heads) - 1))])
        else:
            rows += map(_ending, wrong)
    return table(heads, rows)


def _ending(record: Record) -> list[str]:
    figures = record.figures
    ended = {"sure": "sure, and wrong", "steps": "out of actions", "degenerate": "belief without weight"}
    nll, least = figures["final_nll"], figures["min_nll"]
    off = (figures["position_error_mm"], figures["rotation_error_deg"])
    return [
        f"{record.task} {record.column}",
        str(record.seed),
        ended[figures["stopped_by"]],
        str(figures["steps"]),
        NOTHING if figures["contacts"] is None else str(figures["contacts"]),
        NOTHING if figures["clipped"] is None else str(figures["clipped"]),
        NOTHING if nll is None else f"{nll:.0f} ({least:.0f})",
        NOTHING if None in off else f"{off[0]:.1f} mm, {off[1]:.0f} deg",
    ]


def _pair(
    first: Sequence[Record], second: Sequence[Record], names: Sequence[str], tasks: Sequence[str]
) -> list[list[str]]:
    """One row, none without pairs."""
    base = {(record.task, record.seed): record for record in first}
    pairs = [(base[(r.task, r.seed)], r) for r in second if r.task in tasks and (r.task, r.seed) in base]
    if not pairs:
        return []
    a, b = ([pair[k] for pair in pairs] for k in (0, 1))
    right = list(zip(flags(a, "right"), flags(b, "right"), strict=True))
    counts = [right.count((True, True)), right.count((True, False)), right.count((False, True))]
    return [
        [
            *names,
            str(len(pairs)),
            *map(str, counts),
            f"{mcnemar(flags(a, 'right'), flags(b, 'right')):.2g}",
            f"{mcnemar(flags(a, 'paper_success'), flags(b, 'paper_success')):.2g}",
            _difference(a, b, tasks, held=False),
            _difference(a, b, tasks, held=True),
        ]
    ]


def _difference(first: Sequence[Record], second: Sequence[Record], tasks: Sequence[str], *, held: bool) -> str:
    """Sum over the tasks of the second's median less the first's, with its interval."""
    groups: list[tuple[list[float], list[float]]] = []
    for task in tasks:
        both = [
            (x, y)
            for a, b in zip(first, second, strict=True)
            if a.task == task
            and (x := cumulative(a, held=held)) is not None
            and (y := cumulative(b, held=held)) is not None
        ]
        if both:
            groups.append(([x for x, _ in both], [y for _, y in both]))
    if not groups:
        return NOTHING
    return _interval(bootstrap_total_difference([y for _, y in groups], [x for x, _ in groups]), "+.0f")


def _values(records: Sequence[Record], *, held: bool = False) -> list[float]:
    return [value for record in records if (value := cumulative(record, held=held)) is not None]


def _total(groups: Sequence[Sequence[Record]], *, held: bool = False) -> str:
    values = [_values(group, held=held) for group in groups]
    return _interval(bootstrap_total(values), ".0f") if values and all(values) else NOTHING


def _interval(found: tuple[float, float, float], form: str) -> str:
    centre, low, high = (format(value, form) for value in found)
    return f"{centre} [{low}, {high}]"


def _printed(figures: dict[str, dict[str, float]], method: str, tasks: Sequence[str]) -> str:
    """The paper's figures of some tasks, with their sum where there are several."""
    known = figures.get(method, {})
    if any(task not in known for task in tasks):
        return NOTHING
    values = [known[task] for task in tasks]
    rows = ", ".join(f"{value:g}" for value in values)
    return f"{rows}: {sum(values):g}" if len(values) > 1 else rows
