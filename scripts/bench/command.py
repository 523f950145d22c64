"""`python -m scripts.bench`: what `rumi bench` times, beside others' ways, against targets and earlier results."""

import importlib
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from rumi.bench.command import WRONG, BenchOptions, check, time_cases
from rumi.bench.machine import environment
from rumi.errors import UsageError
from rumi.runs.folder import make_folder
from rumi.runs.plain import plain
from scripts.bench import history, registration  # noqa: F401  (enters its cases)
from scripts.bench.comparisons import beside
from scripts.bench.targets import markdown, verdicts
from sdf.threads import using

_HELP = """Time the work against the straightforward way and public libraries, against targets and earlier results.

    python -m scripts.bench --threads 2 --markdown
    python -m scripts.bench --json scripts/results/bench.jsonl
    python -m scripts.bench --quick --against scripts/results/bench.jsonl
    python -m scripts.bench --pareto --out runs/bench

Ends with exit code 1 if something became worse or variants that should agree do not, and with 2 for bad input."""
_STUDIES = {"pareto": "scripts.bench.pareto", "scaling": "scripts.bench.scaling_study"}


@dataclass(frozen=True)
class Options(BenchOptions):
    """Options of the comparison.

    Attributes:
        quick: fewer rounds, and without the whole run.
        only: names of the cases to time; all if none is given.
        threads: of torch and of the compiled kernels; by default what torch has.
        device: where this project's variants run; the others' run on the CPU only.
        json: file for the results: a line is appended to a .jsonl, any other is written anew.
        against: earlier results; this project's variants that became slower against the same baseline by over 20 %
            are named.
        markdown: print tables for a page as well.
        pareto: run time against error instead.
        scaling: time and memory over sizes instead.
        out: folder for what --pareto and --scaling make.
    """

    against: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    markdown: bool = False
    pareto: bool = False
    scaling: bool = False
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/bench")


def bench(arguments: Sequence[str] | None = None) -> None:
    """Time, compare, and end with an exit code where something is wrong."""
    options = tyro.cli(
        Options, prog="scripts.bench", description=_HELP, args=arguments, config=(tyro.conf.FlagCreatePairsOff,)
    )
    check(options)
    studies = [name for name in _STUDIES if getattr(options, name)]
    if studies and (options.only or options.against):
        raise UsageError("--only and --against are about the cases: leave them out with --pareto and --scaling")
    with using(options.threads or torch.get_num_threads(), torch_too=True):
        if studies:
            make_folder(options.out)
            logging.basicConfig(level=logging.INFO, format="%(message)s")  # they tell how far they are
            lines = options.json if options.json is not None and options.json.suffix == ".jsonl" else None
            for name in studies:
                importlib.import_module(_STUDIES[name]).run(quick=options.quick, out=options.out, jsonl=lines)
            return
        code = _compare(options)
    if code:
        raise SystemExit(code)


def _compare(options: Options) -> int:
    before = None if options.against is None else history.read(options.against)
    results, ended = time_cases(options, beside=beside, more=lambda result: {"targets": plain(verdicts(result))})
    machine = environment(torch.device(options.device))
    if options.markdown:
        sys.stdout.write(markdown(results, machine))
    promises = [(r.name, verdict) for r in results for verdict in verdicts(r) if not verdict["goal"]]
    missed = sorted({f"{name} ({verdict['variant']})" for name, verdict in promises if not verdict["met"]})
    met = len(promises) - sum(not verdict["met"] for _, verdict in promises)
    tail = f"; missed: {', '.join(missed)}" if missed else ""
    sys.stdout.write(f"\n{met} of {len(promises)} targets met{tail}\n")
    worse = False
    if before is not None:
        run = {"machine": plain(machine), "cases": [result.as_dict() for result in results]}
        changes, remarks = history.compare(run, before)
        bad = [change for change in changes if change.worse]
        sys.stdout.write("".join(f"not compared: {remark}\n" for remark in remarks))
        sys.stdout.write("".join(f"WORSE {change}\n" for change in bad))
        sys.stdout.write(f"{len(bad)} of {len(changes)} variants became worse by over 20 %\n")
        worse = bool(bad)
    return ended or (WRONG if worse or not all(result.agree for result in results) else 0)
