"""Measure how well deadlines are kept and what more time is worth; what is done is kept.

    python -m scripts.deadlines simulate                    # 10^4 decisions a kind, under two minutes
    python -m scripts.deadlines real --pieces 20            # 1000 decisions a planner and budget, on the wall clock
    python -m scripts.deadlines real --clock cpu --pieces 4 # on the processor's clock, where others share the machine
    python -m scripts.deadlines value --seeds 4             # what first plans are worth by budget
    python -m scripts.deadlines show                        # Markdown
    python -m scripts.deadlines draw                        # figures into scripts/docs

Lines go to scripts/results/deadlines.jsonl. The wall clock tells about planners only on a machine with nothing else
to do; 20 pieces of all planners take about three quarters of an hour there, most of it waiting for none.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from rumi.cli import script
from scripts.bench.deadline_report import draw, tables
from scripts.bench.deadline_simulation import measure_simulated
from scripts.bench.deadlines import PLANNERS, measure_real, measure_value
from scripts.store import Store

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Common:
    """What all commands know.

    Attributes:
        out: where the lines are.
        seconds: stop before the next measurement after so long.
        threads: of torch and of the kernels.
    """

    out: Path = ROOT / "scripts" / "results" / "deadlines.jsonl"
    seconds: float = float("inf")
    threads: int = 1


@dataclass(frozen=True)
class Simulate(Common):
    """Decisions on a simulated clock.

    Attributes:
        decisions: of each kind of evaluation time and level.
    """

    decisions: int = 10_000


@dataclass(frozen=True)
class Real(Common):
    """Decisions on a real clock.

    Attributes:
        clock: "wall", or "cpu" for the seconds that the processor spent.
        pieces: of 50 decisions, of each planner and budget.
        planners: which.
        task: whose situations.
    """

    clock: Literal["wall", "cpu"] = "wall"
    pieces: int = 20
    planners: tuple[str, ...] = PLANNERS
    task: str = "mug-1"


@dataclass(frozen=True)
class Value(Common):
    """What first plans are worth by budget, on the processor's clock.

    Attributes:
        seeds: how many.
        planners: which.
        task: whose situations.
    """

    seeds: int = 4
    planners: tuple[str, ...] = ("touch", "rumi", "gpvr")
    task: str = "mug-1"


@dataclass(frozen=True)
class Show(Common):
    """Print the tables."""


@dataclass(frozen=True)
class Draw(Common):
    """Draw the figures.

    Attributes:
        folder: of the pictures.
        clock: whose real decisions.
    """

    folder: Path = ROOT / "scripts" / "docs"
    clock: Literal["wall", "cpu"] = "wall"


Command = (
    Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Real, tyro.conf.subcommand("real")]
    | Annotated[Value, tyro.conf.subcommand("value")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Draw, tyro.conf.subcommand("draw")]
)


def main(command: Command) -> None:
    """Do what is asked for."""
    torch.set_num_threads(command.threads)
    store = Store(command.out)
    if isinstance(command, Simulate):
        carry_on(measure_simulated(store, decisions=command.decisions), command.seconds)
    elif isinstance(command, Real):
        how = {"clock": command.clock, "pieces": command.pieces, "planners": command.planners, "task": command.task}
        carry_on(measure_real(store, **how), command.seconds)
    elif isinstance(command, Value):
        seeds = range(1000, 1000 + command.seeds)
        carry_on(measure_value(store, seeds=seeds, planners=command.planners, task=command.task), command.seconds)
    elif isinstance(command, Draw):
        for path in draw(store, command.folder, command.clock):
            print(path)
    else:
        print(tables(store), end="")


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
    script(lambda: main(tyro.cli(Command, description=__doc__)))  # type: ignore[arg-type]
