"""The command `rumi reproduce`."""

import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE
from rumi.planning.registry import POLICIES
from rumi.runs.folder import make_folder
from rumi.runs.jsonlines import check_writable
from scripts.reproduce import touch
from scripts.reproduce.executors import on_a_cluster, on_this_machine
from scripts.reproduce.experiments import EXPERIMENTS, Selection, missing, valid_presets, valid_tasks, work_of
from scripts.reproduce.jobs import Job
from scripts.reproduce.live import progress
from scripts.reproduce.records import Record, Records
from scripts.reproduce.reports import Report, reports, write_page
from scripts.reproduce.seeds import seeds_of
from scripts.reproduce.worker import Errand, failures
from sdf.extras import remedy

_TOUCH = ", ".join(touch.EXPERIMENTS)
FAILED = 1
"""Exit code where a run ended in an error."""

_HELP = """Run the paper's experiments on this simulator, and print our figures beside the paper's.

    rumi reproduce table5 --tasks mug-0 mug-1 mug-2 --jobs 2
    rumi reproduce table5 table6 --methods rumi info-only --presets default --seeds 0-4
    rumi reproduce fig8 horizon displacement --out runs/ablations
    rumi reproduce table5 --seeds 1000-1002 --set planner.rollouts=3
    rumi reproduce all --shard 1/4 --executor submitit --jobs 50 --slurm slurm_partition=cpu
    rumi reproduce table5 --show --results scripts/results/mugs.jsonl

Runs are kept, one line each, and done once: give the command again to go on where it was stopped or killed. Several
commands may work on one file at the same time. Experiments: {names}, all;
and by themselves, with options of their own such as --seconds (rumi reproduce touch-table1 --help): {touch}.

Ends with exit code 1 if a run ended in an error, 2 for bad input, and 130 after Ctrl-C."""


@dataclass(frozen=True)
class ReproduceOptions:
    """Options of `rumi reproduce`.

    Attributes:
        experiments: tables and figures of the paper, or all.
        tasks: which; by default what each experiment takes.
        methods: which; by default the paper's five for the tables, rumi for the ablations.
        presets: which; by default "default" and "paper" for the tables, "default" for the ablations.
        seeds: of the runs, such as 0-9 or 0,3,5-7; the record has 0-9, tuning starts from 1000.
        set: settings on top of the presets, such as planner.rollouts=3.
        jobs: processes at once, or jobs of the cluster; each has one thread.
        shard: do part i of n only, as i/n with i from 1; the table is over what there is.
        executor: processes of this machine, or submitit's jobs (SLURM; local processes where there is none).
        slurm: parameters of submitit, as name=value.
        out: folder of results, figures and logs.
        results: file of the results; by default runs.jsonl in the folder.
        show: run nothing; the tables are over what the file holds by its newest code.
        code: with --show, the hash of the code whose runs to show; of several, a later one's runs stand in for those
            of an earlier one.
        markdown: write the page of results to this file, its figures beside it, and print a summary.
        figures: draw figures.
    """

    experiments: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="WHAT ...")]
    tasks: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    presets: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    seeds: str = "0-9"
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SETTING=VALUE ...")] = ()
    jobs: int = 1
    shard: Annotated[str | None, tyro.conf.arg(metavar="I/N")] = None
    executor: Literal["local", "submitit"] = "local"
    slurm: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/reproduce")
    results: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    show: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    code: Annotated[tuple[str, ...], tyro.conf.arg(metavar="HASH ...")] = ()
    markdown: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    figures: bool = True

    @property
    def path(self) -> Path:
        """File of the results."""
        return self.out / "runs.jsonl" if self.results is None else self.results


def reproduce(arguments: Sequence[str], *, cache_dir: Path) -> int:
    """Carry out `rumi reproduce`.

    Args:
        arguments: of the command line.
        cache_dir: folder that keeps what takes seconds to work out.
    """
    options = tyro.cli(
        ReproduceOptions,
        prog="rumi reproduce",
        description=_HELP.format(names=", ".join(EXPERIMENTS), touch=_TOUCH),
        args=arguments,
    )
    names, selection = chosen(options)
    jobs = work_of(names, selection)
    for job in jobs:
        job.id  # noqa: B018  (says what is wrong with its settings before anything runs)
    own, wrong = part(jobs, options.shard), dict[str, str]()
    records = _shown(options, jobs) if options.show else []
    target = _checked(options)
    if not options.show:
        records, wrong = _done(options, own, jobs, cache_dir)
    found = reports(names, selection, records, target if options.figures else None, cache_dir)
    if options.markdown is not None:
        _say(write_page(options.markdown, found, records))
    else:
        _say("\n".join(map(_as_text, found)))
    for identity, message in wrong.items():
        job = next(job for job in jobs if job.id == identity)
        sys.stderr.write(f"rumi: {job.task}, {job.column}, seed {job.seed} failed: {message}\n")
    return FAILED if wrong else DONE


def chosen(options: ReproduceOptions) -> tuple[list[str], Selection]:
    """Experiments and selection that are asked for.

    Raises:
        UsageError: something that there is not; the message says what there is.
    """
    there = f"there are {', '.join(EXPERIMENTS)}, all, and by themselves {_TOUCH}"
    if not options.experiments:
        raise UsageError(f"Which experiment? T{there[1:]}")
    for name in options.experiments:
        if name not in (*EXPERIMENTS, "all"):
            raise UsageError(f"There is no experiment {name!r}; {there}")
    _among("task", options.tasks, valid_tasks())
    _among("method", options.methods, tuple(POLICIES))
    _among("preset", options.presets, valid_presets())
    if options.jobs < 1:
        raise UsageError(f"Expected jobs to be 1 or more, got {options.jobs}")
    if options.code and not options.show:
        raise UsageError("--code says which of the kept runs to show: give --show with it")
    if options.figures and find_spec("matplotlib") is None:
        raise UsageError(f"Figures need matplotlib: {remedy('plot')}, or give --no-figures")
    if options.slurm and options.executor != "submitit":
        raise UsageError("--slurm is about --executor submitit: give both or none")
    parameters_of(options.slurm)  # says what is wrong with them
    every = "all" in options.experiments
    names = [name for name in EXPERIMENTS if every or name in options.experiments]
    for name in list(names):
        reason = missing(name)
        if reason and not every:
            raise UsageError(f"{name} cannot be done: {reason}")
        if reason:
            sys.stderr.write(f"rumi: leaving {name} out: {reason}\n")
            names.remove(name)
    return names, Selection(options.tasks, options.methods, options.presets, seeds_of(options.seeds), options.set)


def part(jobs: Sequence[Job], shard: str | None) -> list[Job]:
    """Part i of n of the work, of "i/n" with i from 1; the parts have no piece in common and none is left out.

    Raises:
        UsageError: there is no such part.
    """
    if shard is None:
        return list(jobs)
    match = re.fullmatch(r"(\d+)/(\d+)", shard)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UsageError(f"Expected shard to be i/n with i from 1 to n, such as 1/4, got {shard!r}")
    return list(jobs[int(match[1]) - 1 :: int(match[2])])


def parameters_of(pairs: Sequence[str]) -> dict[str, Any]:
    """Parameters of submitit; numbers become numbers.

    Raises:
        UsageError: one has no value.
    """
    found: dict[str, Any] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name:
            raise UsageError(f"Expected --slurm name=value, such as slurm_partition=cpu, got {pair!r}")
        found[name] = int(value) if value.isdecimal() else value
    return found


def _checked(options: ReproduceOptions) -> Path:
    """The folder of the figures; all that is to be written is looked at, before hours of runs.

    Raises:
        UsageError: something cannot be written.
    """
    figures, page = options.out / "figures", options.markdown
    if not options.show:
        check_writable(options.path)
    if page is not None:
        check_writable(page)
        figures = page.with_suffix("")
        if options.figures and figures == page:
            raise UsageError(f"Expected --markdown to have an ending, such as page.md, got {page}")
    if options.figures:
        make_folder(figures)
    return figures


def _done(
    options: ReproduceOptions, own: list[Job], jobs: Sequence[Job], cache_dir: Path
) -> tuple[list[Record], dict[str, str]]:
    """The results, after what was missing of one's own part is done; and what failed."""
    parameters = parameters_of(options.slurm)
    records = Records(options.path)
    wrong: dict[str, str] = {}
    if len(records.done(own)) < len(own):
        errand = Errand.of(own, options.path, cache_dir)
        with progress(own, options.path):
            if options.executor == "submitit":
                on_a_cluster(errand, options.jobs, options.out / "submitit", parameters)
            else:
                on_this_machine(errand, min(options.jobs, len(own)))
        wrong = failures(errand)
        records.refresh()
        if not wrong and len(records.done(own)) < len(own):
            raise UsageError("A process that did the work was ended from outside: give the command again to go on")
    return records.done(jobs), wrong


def _shown(options: ReproduceOptions, jobs: Sequence[Job]) -> list[Record]:
    if not options.path.is_file():
        raise UsageError(f"There are no results in {options.path}: leave out --show to run")
    records = Records(options.path).newest(*options.code)
    if jobs and not records:
        raise UsageError(f"{options.path} holds no results: leave out --show to run")
    return records


def _among(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise UsageError(f"There is no {what} {name!r}; there are {', '.join(known)}")


def _as_text(report: Report) -> str:
    files = "".join(f"figure: {os.path.relpath(path)}\n" for path in report.figures)
    return f"## {report.title}\n\n{report.text}\n{files}"


def _say(text: str) -> None:
    sys.stdout.write(text.rstrip("\n") + "\n")
    sys.stdout.flush()
