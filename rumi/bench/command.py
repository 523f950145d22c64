"""The command `rumi bench`."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from rumi.bench import table
from rumi.bench.case import CASES, HOST, SLOW, Case, Setup
from rumi.bench.machine import BUSY, environment
from rumi.bench.measure import Result, carry_out
from rumi.bench.timing import fitting_clock
from rumi.cache import cache_folder
from rumi.errors import UsageError
from rumi.exit_codes import DONE, INTERRUPTED
from rumi.runs.folder import write_json
from rumi.runs.jsonlines import append_line, check_writable
from rumi.runs.plain import plain
from rumi.runs.progress import say
from sdf import gpu
from sdf.extras import remedy
from sdf.threads import using

SCHEMA = 1
QUICK, WHOLE = (1.0, 3), (6.0, 9)
"""Seconds for the rounds of a case, and rounds at least."""

WRONG = 1
"""Exit code where variants that should agree do not."""

_HELP = """Time each part of the work on this machine, version against version.

    rumi bench --quick
    rumi bench --only field-mug rollouts --threads 2

Ends with exit code 1 if versions that should agree do not, and with 2 for bad input. From a checkout,
`python -m scripts.bench` times public libraries and straightforward ways beside it."""


@dataclass(frozen=True)
class BenchOptions:
    """Options of `rumi bench`.

    Attributes:
        quick: fewer rounds, and without the whole run; under two minutes in all on two cores.
        only: names of the cases to time; all if none is given.
        threads: of torch and of the compiled kernels; by default what torch has, whatever else the machine does.
        device: where the work is done.
        json: file for the results: a line is appended to a .jsonl, any other is written anew.
    """

    quick: bool = False
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    threads: int | None = None
    device: Literal["cpu", "cuda"] = "cpu"
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None


def bench(arguments: Sequence[str]) -> int:
    """`rumi bench`: 0, 1 if versions do not agree, 2 for bad input."""
    options = tyro.cli(
        BenchOptions,
        prog="rumi bench",
        description=_HELP,
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    check(options)
    with using(options.threads or torch.get_num_threads(), torch_too=True):
        results, ended = time_cases(options)
        sys.stdout.write("\n")
        return ended or (WRONG if not all(result.agree for result in results) else DONE)


def check(options: BenchOptions) -> None:
    """Say what cannot be, before anything is timed.

    Raises:
        UsageError: something asked for cannot be.
    """
    from rumi.bench import cases  # noqa: F401  (enters the cases)

    unknown = [name for name in options.only if name not in CASES]
    if unknown:
        raise UsageError(f"There is no case {unknown[0]!r}; the cases are {', '.join(CASES)}")
    if options.threads is not None and options.threads < 1:
        raise UsageError(f"Expected threads to be 1 or more, got {options.threads}")
    if options.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("There is no CUDA device that this PyTorch can use: leave out --device cuda")
    if options.device == "cuda" and not gpu.available():
        raise UsageError(f"Timing on a GPU needs warp: {remedy('warp')}, or leave out --device cuda")
    if options.json is not None:
        check_writable(options.json)


def time_cases(
    options: BenchOptions,
    *,
    beside: Callable[[str, Case, Setup], Case] = lambda name, case, setup: case,
    more: Callable[[Result], Mapping[str, Any]] = lambda result: {},
) -> tuple[list[Result], int]:
    """Time what is asked for, print each result as it comes, and write them down.

    Args:
        options: of the command.
        beside: adds other ways to do a case's work.
        more: what else to write down of a result.

    Returns:
        the results, and an exit code that tells an interrupt.
    """
    device = torch.device(options.device)
    setup = Setup(device, quick=options.quick, cache_dir=cache_folder())
    machine = environment(device)
    if machine["load"] is not None and machine["load"] > BUSY:
        say(f"the machine is busy (load {machine['load']}): times may be too long")
    sys.stdout.write(f"{table.about(machine)}\n{table.heading()}\n")
    results: list[Result] = []
    ended = DONE
    try:
        for name in options.only or [name for name in CASES if not (options.quick and name in SLOW)]:
            if name in HOST and device.type != "cpu":
                say(f"left out {name}: its work is done on the CPU")
                continue
            say(f"timing {name}")
            try:
                case = beside(name, CASES[name](setup), setup)
            except ModuleNotFoundError as error:
                say(f"left out {name}: {error}")
                continue
            results.append(_timed(name, case, setup))
            sys.stdout.write(table.section(results[-1]) + "\n")
            sys.stdout.flush()
    except KeyboardInterrupt:
        say(f"interrupted; kept what was measured: {', '.join(r.name for r in results) or 'nothing'}")
        ended = INTERRUPTED
    if options.json is not None and results:
        about = {"schema": SCHEMA, "stamp": datetime.now(UTC).isoformat(timespec="seconds"), "quick": options.quick}
        cases = [{**result.as_dict(), **more(result)} for result in results]
        run = {**about, "machine": plain(machine), "cases": cases}
        (append_line if options.json.suffix == ".jsonl" else write_json)(options.json, run)
    return results, ended


def _timed(name: str, case: Case, setup: Setup) -> Result:
    budget, least = QUICK if setup.quick else WHOLE
    within = setup.device.type == "cpu" and not case.elsewhere
    clock = fitting_clock(torch.get_num_threads()) if within else time.perf_counter
    return carry_out(name, case, budget_s=budget, least=least, device=setup.device, clock=clock)
