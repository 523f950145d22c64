"""Are deadlines kept, and what is more time worth: decisions on simulated and on real clocks; resumable.

    python -m scripts.deadlines simulate                       # 10^4 decisions a kind, under two minutes
    python -m scripts.deadlines real --pieces 20               # 1000 decisions a planner and budget, on the wall clock
    python -m scripts.deadlines real --clock cpu --pieces 4    # the processor's clock, where others share the machine
    python -m scripts.deadlines value --seeds 4                # what first plans are worth by budget
    python -m scripts.deadlines show                           # Markdown
    python -m scripts.deadlines draw                           # figures into scripts/docs/figures

Lines go to scripts/results/deadlines.jsonl. The wall clock tells about planners only on a machine with nothing else
to do; 20 pieces of all planners take about three quarters of an hour there, most of it waiting for none.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro

from rumi.cli import script
from scripts.bench.deadline_report import draw, tables
from scripts.bench.deadline_simulation import measure_simulated
from scripts.bench.deadlines import PLANNERS, measure_real, measure_value
from scripts.experiment import FIGURES, RESULTS
from scripts.store import Store


@dataclass(frozen=True)
class Options:
    """What is done.

    Attributes:
        what: decisions on a simulated clock or on a real one, what first plans are worth by budget on the processor's
            clock, the tables, or the figures.
        results: where the lines are.
        seconds: stop before the next measurement after so long.
        threads: of torch and of the kernels.
        decisions: of each kind of evaluation time and level, to simulate.
        clock: of real decisions: "wall", or "cpu" for the seconds that the processor spent.
        pieces: of 50 real decisions, of each planner and budget.
        planners: which; by default all, of values touch, rumi and gpvr.
        task: whose situations.
        seeds: how many, of values.
        folder: of the pictures.
    """

    what: tyro.conf.Positional[Literal["simulate", "real", "value", "show", "draw"]]
    results: Path = RESULTS / "deadlines.jsonl"
    seconds: float = float("inf")
    threads: int = 1
    decisions: int = 10_000
    clock: Literal["wall", "cpu"] = "wall"
    pieces: int = 20
    planners: tuple[str, ...] = ()
    task: str = "mug-1"
    seeds: int = 4
    folder: Path = FIGURES


def main(options: Options) -> None:
    """Do what is asked for."""
    torch.set_num_threads(options.threads)
    store = Store(options.results)
    if options.what == "draw":
        sys.stdout.write("".join(f"{path}\n" for path in draw(store, options.folder, options.clock)))
    elif options.what == "show":
        sys.stdout.write(tables(store))
    else:
        carry_on(work(store, options), options.seconds)


def work(store: Store, options: Options) -> Iterator[bool]:
    """Measure what is missing."""
    if options.what == "simulate":
        return measure_simulated(store, decisions=options.decisions)
    if options.what == "real":
        planners = options.planners or PLANNERS
        return measure_real(store, clock=options.clock, pieces=options.pieces, planners=planners, task=options.task)
    planners = options.planners or ("touch", "rumi", "gpvr")
    return measure_value(store, seeds=range(1000, 1000 + options.seeds), planners=planners, task=options.task)


def carry_on(work: Iterator[bool], seconds: float) -> None:
    """Measure until all is done or the time is over."""
    end, done = time.monotonic() + seconds, 0
    for measured in work:
        done += measured
        if time.monotonic() > end:
            sys.stderr.write(f"{done} measurements; there may be more to do\n")
            return
    sys.stderr.write(f"{done} measurements; all done\n")


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options, description=__doc__)))
