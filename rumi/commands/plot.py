"""The command `rumi plot`: the figures of a run, drawn again."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rumi.exit_codes import DONE


@dataclass(frozen=True)
class PlotOptions:
    """Draw the figures of a run again, also of one that goes on or was interrupted.

    Attributes:
        run: folder of the run.
        steps: scenes to draw; by default the first view, the first contact, the middle and the end.
        out: folder of the figures; by default RUN/figures.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    steps: tuple[int, ...] | None = None
    out: Path | None = None


def plot(arguments: Sequence[str]) -> int:
    """`rumi plot`: 0 if the figures were drawn, 2 for bad input."""
    options = tyro.cli(PlotOptions, prog="rumi plot", args=arguments)
    from rumi.runs.folder import load_run, make_folder
    from rumi.tasks.registry import entry_of

    run, out = load_run(options.run), options.out or options.run / "figures"
    make_folder(out)
    for path in entry_of(run).draw(run, out, options.steps):
        sys.stdout.write(f"{path}\n")
    return DONE
