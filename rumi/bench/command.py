"""The command `rumi bench`."""

import importlib
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from rumi.bench import history, peers, table
from rumi.bench.case import CASES, SLOW, Case, Setup
from rumi.bench.machine import BUSY, environment
from rumi.bench.measure import Result, carry_out
from rumi.bench.timing import fitting_clock
from rumi.cache import cache_folder
from rumi.errors import UsageError
from rumi.exit_codes import DONE, INTERRUPTED
from rumi.runs.folder import make_folder
from rumi.runs.progress import say
from sdf.threads import using

QUICK, WHOLE = (1.0, 3), (6.0, 9)
"""Seconds for the rounds of a case, and rounds at least."""

WRONG = 1
"""Exit code where something became worse, or variants that should agree do not."""

_HELP = """Time the work, version against version, against the straightforward way, and against public libraries.

    rumi bench --quick
    rumi bench --only field-mug rollouts --threads 2
    rumi bench --json scripts/results/bench.jsonl
    rumi bench --quick --against scripts/results/bench.jsonl

Ends with exit code 1 if something became worse or variants that should agree do not, and with 2 for bad input."""


@dataclass(frozen=True)
class BenchOptions:
    """Options of `rumi bench`.

    Attributes:
        quick: fewer rounds, and without the whole run; under two minutes in all on two cores.
        only: names of the cases to time; all if none is given.
        threads: of torch and of the fused kernels; by default what torch has, whatever else the machine does.
        device: where this project's variants run; the others' run on the CPU only.
        json: file for the results: a line is appended to a .jsonl, any other is written anew.
        against: earlier results; this project's variants that became slower against the same baseline by over 20 %
            are named.
        markdown: print tables for a page.
        pareto: run time against error instead.
        scaling: time and memory over sizes instead.
        out: folder for what --pareto and --scaling make.
    """

    quick: bool = False
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    threads: int | None = None
    device: Literal["cpu", "cuda"] = "cpu"
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    against: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    markdown: bool = False
    pareto: bool = False
    scaling: bool = False
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/bench")


def bench(arguments: Sequence[str]) -> int:
    """`rumi bench`: 0 if nothing became worse, 1 if something did or variants do not agree, 2 for bad input."""
    options = tyro.cli(
        BenchOptions,
        prog="rumi bench",
        description=_HELP,
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    _check(options)
    with using(options.threads or torch.get_num_threads(), torch_too=True):
        if options.pareto or options.scaling:
            return _studies(options)
        return _cases(options, cache_folder())


def _check(options: BenchOptions) -> None:
    from rumi.bench import cases  # noqa: F401  (enters the cases)

    unknown = [name for name in options.only if name not in CASES]
    if unknown:
        raise UsageError(f"There is no case {unknown[0]!r}; the cases are {', '.join(CASES)}")
    if options.threads is not None and options.threads < 1:
        raise UsageError(f"Expected threads to be 1 or more, got {options.threads}")
    if options.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("There is no CUDA device that this PyTorch can use: leave out --device cuda")
    if (options.pareto or options.scaling) and (options.only or options.against):
        raise UsageError("--only and --against are about the cases: leave them out with --pareto and --scaling")
    if options.json is not None:
        history.check_writable(options.json)
    if options.pareto or options.scaling:
        make_folder(options.out)


def _studies(options: BenchOptions) -> int:
    """The studies with figures, each in a module of its own."""
    # they tell how far they are by the log
    logging.basicConfig(level=logging.INFO, format="rumi: %(message)s")
    lines = options.json if options.json is not None and options.json.suffix == ".jsonl" else None
    for study in [name for name in ("pareto", "scaling") if getattr(options, name)]:
        # loaded only where asked for: they draw figures
        importlib.import_module(f"rumi.bench.{study}").run(quick=options.quick, out=options.out, jsonl=lines)
    return DONE


def _cases(options: BenchOptions, cache_dir: Path | None) -> int:
    before = None if options.against is None else history.read(options.against)
    device = torch.device(options.device)
    setup = Setup(device, quick=options.quick, cache_dir=cache_dir, without_peers=peers.missing())
    machine = environment(device)
    if machine["load"] is not None and machine["load"] > BUSY:
        say(f"the machine is busy (load {machine['load']}): times may be too long")
    if not options.markdown:
        sys.stdout.write(f"{table.about(machine)}\n{table.heading()}\n")
    results: list[Result] = []
    ended = DONE
    try:
        for name in options.only or [name for name in CASES if not (options.quick and name in SLOW)]:
            say(f"timing {name}")
            result = _carry_out(name, setup)
            if result is not None:
                results.append(result)
                if not options.markdown:
                    sys.stdout.write(table.section(result) + "\n")
                    sys.stdout.flush()
    except KeyboardInterrupt:
        say(f"interrupted; kept what was measured: {', '.join(r.name for r in results) or 'nothing'}")
        ended = INTERRUPTED
    if options.markdown:
        sys.stdout.write(table.markdown(results, machine))
    stamp = datetime.now(UTC).isoformat(timespec="seconds")
    run = history.record(results, machine, stamp=stamp, quick=options.quick)
    if options.json is not None and results:
        history.write(options.json, run)
    sys.stdout.write(f"\n{verdicts(results)}\n")
    worse = before is not None and _against(run, before)
    differ = [result.name for result in results if not result.agree]
    if ended != DONE:
        return ended
    return WRONG if worse or differ else DONE


def _carry_out(name: str, setup: Setup) -> Result | None:
    """A case's result; None where what it needs is not installed."""
    try:
        case: Case = CASES[name](setup)
    except ModuleNotFoundError as error:
        say(f"left out {name}: {error}")
        return None
    budget, least = QUICK if setup.quick else WHOLE
    within = setup.device.type == "cpu" and not case.elsewhere
    clock = fitting_clock(torch.get_num_threads()) if within else time.perf_counter
    return carry_out(name, case, budget_s=budget, least=least, device=setup.device, clock=clock)


def verdicts(results: Sequence[Result]) -> str:
    """One line on the targets, and which were missed."""
    promises = [(r.name, v) for r in results for v in r.verdicts if not v.target.goal]
    missed = sorted({f"{name} ({verdict.target.variant})" for name, verdict in promises if not verdict.met})
    met = sum(verdict.met for _, verdict in promises)
    return f"{met} of {len(promises)} targets met" + (f"; missed: {', '.join(missed)}" if missed else "")


def _against(run: dict[str, object], before: Sequence[dict[str, object]]) -> bool:
    changes, remarks = history.compare(run, before)
    worse = [change for change in changes if change.worse]
    for remark in remarks:
        sys.stdout.write(f"not compared: {remark}\n")
    for change in worse:
        sys.stdout.write(f"WORSE {change}\n")
    sys.stdout.write(f"{len(worse)} of {len(changes)} variants became worse by over 20 %\n")
    return bool(worse)
