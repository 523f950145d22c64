"""What each experiment says of its results: text, tables and figures, for the terminal and for a page."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rumi.planning.registry import POLICIES
from scripts.reproduce import allocation, paper, studies, tables
from scripts.reproduce.cells import NOTHING, flags, rate, table
from scripts.reproduce.experiments import EXPERIMENTS, Selection
from scripts.reproduce.jobs import Job, named
from scripts.reproduce.origins import origin, present, provenance
from scripts.reproduce.records import Record, by_column, key_of


@dataclass(frozen=True)
class Report:
    """What an experiment says.

    Attributes:
        name: of the experiment.
        title: of its section.
        text: Markdown.
        figures: pictures that were drawn.
    """

    name: str
    title: str
    text: str
    figures: tuple[Path, ...] = ()


_COUNTS = """Two counts of each method and task, as `right · paper's`. Right: at its own stop, or at the last action,
nll within the threshold and the best pose within the task's tolerance of the truth, modulo the object's symmetry. The
paper's: nll within the threshold at any step. Rates with Wilson intervals (95 %). `paper as printed` has the paper's
settings to the letter. The paper's own figures are of its simulator, ten runs each."""
_READ = """The rows `paper as printed` have the paper's settings to the letter. The preset `paper` reads two of them
otherwise, by which rumi finds 72 of 110 by the paper's count: [the readings](paper_readings.md)."""
_SUMS = """Medians over the seeds of the nll summed over the steps, and the sum of the medians with its bootstrap
interval. A run that stops adds nothing more, in ours as in the paper's; held to the last step, stopping early and
wrong does not pay."""
_MISPRINT = "The paper prints 4444 as InfoOnly's sum on the mugs; its rows add up to 3872."
_PAIRS = "Run by run of the same task and seed. Differences are sums over the tasks of the medians' differences."
_CORRELATION = """Over all steps of all methods' runs; intervals draw whole runs. The APC (Eq 33) counts all particles
alike and measures their spread alone; the nll (Eq 36) weighs them and is about the truth. The two go together as far
as runs differ in spread at all, and not where a belief is narrow and wrong, or one of many light particles is far off.
How far the APC moves is said below each; the paper stops below 3 % of the diagonal. The expected nll is what
the default's rule to stop looks at."""
_SECONDS = """Seconds of one planning pass with one thread: mean over the runs, and the standard deviation between them.
The paper's are of an RTX 4090."""
_CELL = """A block of 0.2 x 0.1 m anywhere on 0.8 x 0.5 m and at any yaw is searched for by lanes, then pressed on until
four contacts on two sides; then the peg goes to where a hole is thought to be. Medians with bootstrap intervals. The
speeds (0.05 m/s, 0.1 m/s2) and the block's size are ours: the paper does not say."""
_HOLES = """Random poses. In a hole: the peg is lowered within 5 mm of a hole's middle, the paper's tolerance; within
2.5 mm a ball of 25 mm goes into a hole of 30 mm without touching its rim. Believed: the mean of the probability that
both holes are within 5 mm, as the belief has it at its stop."""
_TOTAL = """Random poses; a run stops where both holes are within 5 mm with a probability of 0.95. Means with bootstrap
intervals, the least in bold. Time passes on a simulated clock, on which weighing a candidate takes what is stated, or
choosing what it took on the machine (measured: the median of an evaluation). Where there is nothing to do in t_max it
is doubled for that decision. Runs that end unsure, after the most actions allowed, would have taken longer: where they
are more than one in ten, the total is a bound from below."""
_PARTICLES = """A thousand particles are of 20 000 starts and 10 000 polished poses in place of 2000 and 300, of which
too few are plausible for as many distinct ones."""
_TOY = """A point goes round a hill, with one iteration of 500 samples an action. Change: sum of the controls' absolute
differences; jerk: sum of their squared second differences. The first plan is the one after 20 iterations. Medians with
bootstrap intervals."""


def reports(
    names: Sequence[str], selection: Selection, records: Sequence[Record], figures: Path | None, cache_dir: Path
) -> list[Report]:
    """The reports of some experiments; of several, those without any result are left out.

    Args:
        names: of `scripts.reproduce.experiments.EXPERIMENTS`.
        selection: what was asked for.
        records: results, by one code.
        figures: folder of the pictures; None draws none.
        cache_dir: folder that keeps what takes seconds to work out.
    """
    found = []
    for name in names:
        own = of_experiment(name, selection, records)
        if not own and len(names) > 1 and EXPERIMENTS[name](selection):
            continue  # of all experiments, those that the file holds nothing of
        kind = _REPORTS[name]
        drawn, said = ([], ()) if figures is None else kind.draw(_Asked(name, selection, own, figures, cache_dir))
        text = [so_far(EXPERIMENTS[name](selection), own), origin(own), *kind.text(own), *said]
        found.append(Report(name, kind.title, _text(text), tuple(drawn)))
    return found


def so_far(jobs: Sequence[Job], records: Sequence[Record]) -> str:
    """How much of the work is done where not all of it is, and which columns are begun; empty where all is."""
    done = {record.key for record in records}
    columns: dict[str, list[bool]] = {}
    for job in jobs:
        columns.setdefault(job.column, []).append(key_of(job) in done)
    if all(map(all, columns.values())):
        return ""
    begun = [f"{name} {sum(own)} of {len(own)}" for name, own in columns.items() if any(own) and not all(own)]
    every = [flag for own in columns.values() for flag in own]
    parts = f" (of columns that are begun: {', '.join(begun)})" if begun else ""
    return f"So far {sum(every)} of {len(every)} runs are done{parts}.\n"


def of_experiment(name: str, selection: Selection, records: Sequence[Record]) -> list[Record]:
    """The results that an experiment is about, in the order of its work.

    Of the tables over all runs these are all that do not contradict the selection, whatever presets there are.
    """
    if EXPERIMENTS[name] is not EXPERIMENTS["table5"]:
        by_key = {record.key: record for record in records}
        return [by_key[key] for key in map(key_of, EXPERIMENTS[name](selection)) if key in by_key]
    own = [
        record
        for record in records
        if record.kind == "run"
        and record.task in (selection.tasks or [record.task])
        and record.method in (selection.methods or [record.method])
        and record.preset in (selection.presets or [record.preset])
        and record.seed in selection.seeds
        and named(record.overrides) == named(selection.overrides)
    ]
    order = {method: k for k, method in enumerate(POLICIES)}
    tasks = {task: k for k, task in enumerate(task for family in paper.FAMILIES.values() for task in family)}
    return sorted(
        own,
        key=lambda r: (
            r.preset,
            order.get(r.method, len(order)),
            r.overrides,
            tasks.get(r.task, len(tasks)),
            r.task,
            r.seed,
        ),
    )


def summary(records: Sequence[Record]) -> str:
    """One line a column: right in each object's runs and by the paper's count, beside the paper."""
    groups = tables.families(records)
    heads = ["method/preset", *(f"{name}: right · nll <= threshold at any step" for name in groups), "stopped: right"]
    heads += ["the paper: " + ", ".join(groups)]
    if len(groups) > 1:
        heads.insert(1, "right in all")
    rows = []
    for column, runs in by_column(records):
        cells = []
        for tasks in groups.values():
            own = [record for record in runs if record.task in tasks]
            cells.append(f"{rate(flags(own, 'right'))} · {sum(flags(own, 'paper_success'))}" if own else NOTHING)
        sure = [record for record in runs if record.figures["stopped_by"] == "sure"]
        known = paper.SUCCESSES.get(runs[0].method, {})
        printed = [
            f"{sum(known[task] for task in tasks):g}/{paper.RUNS * len(tasks)}"
            if known.keys() >= set(tasks)
            else NOTHING
            for tasks in groups.values()
        ]
        if len(groups) > 1:
            cells.insert(0, rate(flags(runs, "right")))
        rows.append([column, *cells, f"{len(sure)}: {sum(flags(sure, 'right'))}", ", ".join(printed)])
    return table(heads, rows)


def write_page(path: Path, found: Sequence[Report], records: Sequence[Record]) -> str:
    """Write a page of reports, and give the summary of it."""
    own = of_experiment("table5", Selection(seeds=tuple({record.seed for record in records})), records)
    short = summary(own)
    parts = ["# Results\n", "Written by `rumi reproduce --markdown` from recorded runs.\n", provenance(records)]
    if short:
        parts += ["## Summary\n", origin(own) + "\n", short]
        parts += [_READ + "\n"] if any(record.as_printed for record in own) else []
    for report in found:
        pictures = "\n".join(f"![{report.title}]({os.path.relpath(p, path.parent)})\n" for p in report.figures)
        parts += [f"## {report.title}\n", report.text, pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(part.rstrip("\n") + "\n" for part in parts if part.strip()), encoding="utf-8")
    return short


@dataclass(frozen=True)
class _Asked:
    """Where pictures go, and what they are drawn of.

    Attributes:
        name: of the experiment.
        selection: what was asked for.
        records: results.
        figures: folder of the pictures.
        cache_dir: folder that keeps what takes seconds to work out.
    """

    name: str
    selection: Selection
    records: list[Record]
    figures: Path
    cache_dir: Path


class _Kind(NamedTuple):
    """What a report consists of: its title, its text, and its pictures with what is said about them."""

    title: str
    text: Callable[[list[Record]], Sequence[str]]
    draw: Callable[[_Asked], tuple[list[Path], Sequence[str]]] = lambda asked: ([], ())


def _table5(records: list[Record]) -> list[str]:
    pairs, ends, wrong = tables.paired(records), tables.endings(records), tables.failed(records)
    parts = [_COUNTS, tables.successes(records)]
    parts += ["### Paired\n", _PAIRS, pairs] if pairs else []
    parts += ["### How the runs end\n", ends.replace("### ", "#### ")] if ends else []
    return parts + (["### Runs of rumi that were not right\n", wrong] if wrong else [])


def _table6(records: list[Record]) -> list[str]:
    note = [_MISPRINT] if any(record.method == "info-only" for record in records) else []
    return [_SUMS, tables.cumulative_nll(records), *note]


def _curves(curve: str, title: str) -> _Kind:
    def draw(asked: _Asked) -> tuple[list[Path], Sequence[str]]:
        from scripts.reproduce.curves import draw_curves

        return draw_curves(asked.records, curve, asked.figures / f"{asked.name}.png"), ()

    text = "Median and quartiles over the seeds; a run that stopped is held at its last value."
    return _Kind(title, lambda records: [text], draw)


def _draw_toy(asked: _Asked) -> tuple[list[Path], Sequence[str]]:
    from scripts.reproduce.curves import draw_toy

    return draw_toy(asked.records, asked.figures / "fig8.png"), ()


def _draw_fields(asked: _Asked) -> tuple[list[Path], Sequence[str]]:
    from scripts.reproduce import pictures

    task, seed = (asked.selection.tasks or ("mug-0",))[0], asked.selection.seeds[0]
    by_particles = asked.name == "fig5"
    make = pictures.information_by_particles if by_particles else pictures.planned_over
    fields = make(task, seed, asked.cache_dir)
    what = f"The information field at the first view of {task}, seed {seed} ({present()}):"
    said = what if by_particles else f"At the first view of {task}, seed {seed} ({present()})."
    return pictures.draw_fields(fields, asked.figures / f"{asked.name}.png"), [said, "", pictures.field_table(fields)]


def _draw_illustration(asked: _Asked) -> tuple[list[Path], Sequence[str]]:
    from scripts.reproduce.illustrations import DRAWN

    task, seed = (asked.selection.tasks or ("mug-0",))[0], asked.selection.seeds[0]
    path = asked.figures / f"{asked.name}.png"
    said = DRAWN[asked.name](task, seed, asked.cache_dir, path)
    return [path] if path.is_file() else [], [said]


def _draw_runs(asked: _Asked) -> tuple[list[Path], Sequence[str]]:
    return allocation.draw_runs(asked.records[0].seed, asked.figures) if asked.records else [], ()


def _draw_totals(asked: _Asked) -> tuple[list[Path], Sequence[str]]:
    return allocation.draw_totals(asked.records, asked.figures / f"{asked.name}.png"), ()


def _ablation(title: str, text: str) -> _Kind:
    return _Kind(title, lambda records: [text, studies.ablation(records), tables.paired(records)])


def _text(parts: Sequence[str]) -> str:
    return "\n".join(part.rstrip("\n") + "\n" for part in parts if part)


_ILLUSTRATIONS = {
    "fig2": "Figure 2: sensor model",
    "fig4": "Figure 4: first view, and its information",
    "fig6": "Figure 6: resampling after a touch",
    "fig7": "Figure 7: reachability",
    "fig14": "Figure 14: the Gaussian process at the first view",
}
_REPORTS = {
    "table5": _Kind("Table V: runs that found the object", _table5),
    "table6": _Kind("Table VI: cumulative nll", _table6),
    "table2": _Kind("Table II: nll and APC", lambda records: [_CORRELATION, studies.correlation(records)]),
    "table7": _Kind("Table VII: seconds of a planning pass", lambda records: [_SECONDS, studies.seconds(records)]),
    "fig16": _curves("nll", "Figure 16: nll over the actions"),
    "fig13": _curves("apc", "Figure 13: APC over the actions"),
    "fig8": _Kind(
        "Figure 8: MPPI, SMPPI and KMPPI on the toy", lambda records: [_TOY, studies.toy(records)], _draw_toy
    ),
    "fig5": _Kind(
        "Figure 5: number of particles",
        lambda records: [_PARTICLES, studies.ablation(records), tables.paired(records)],
        _draw_fields,
    ),
    "fig15": _Kind("Figure 15: what RUMI and GPVR plan over", lambda records: [], _draw_fields),
    **{name: _Kind(title, lambda records: [], _draw_illustration) for name, title in _ILLUSTRATIONS.items()},
    "allocation-table1": _Kind(
        "Time allocation, Table I: seconds at each contact",
        lambda records: [_CELL, allocation.times(records), allocation.faster(records)],
        _draw_runs,
    ),
    "allocation-accuracy": _Kind(
        "Time allocation: how exact the task ends", lambda records: [_HOLES, allocation.accuracy(records)]
    ),
    "allocation-time": _Kind(
        "Time allocation: total time to an accuracy",
        lambda records: [_TOTAL, allocation.totals(records)],
        _draw_totals,
    ),
    "horizon": _ablation("Planning horizon", "Every other step is a knot, as with the paper's 8 of 15."),
    "displacement": _ablation(
        "Displacement off", "Information counted where the object is (Eq 28) instead of where it will be (Eq 29)."
    ),
}
