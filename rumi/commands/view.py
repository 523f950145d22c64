"""The command `rumi view`: a recorded run in the viewer Rerun."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE


@dataclass(frozen=True)
class ViewOptions:
    """Look at a recorded run over time: object, particles, points, plan and contacts in space, beside its curves.

    Attributes:
        run: folder of the run, also of one that goes on or was interrupted.
        out: recording to write, .rrd; by default RUN/run.rrd.
        headless: write it and open nothing, as where there is no display.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    headless: bool = False


def view(arguments: Sequence[str]) -> int:
    """`rumi view`: 0 where the recording is written, 2 for bad input."""
    options = tyro.cli(ViewOptions, prog="rumi view", args=arguments)
    if options.run.is_file():
        raise UsageError(
            f"Expected a run's folder, got the file {options.run}: of a log "
            f"`rumi replay {options.run} --out DIR` makes one"
        )
    from rumi.runs.export import estimates_of
    from rumi.runs.folder import load_run, make_folder
    from rumi.tasks.registry import entry_of
    from rumi.viz.viewer import write_recording

    run = load_run(options.run)
    path = options.out or options.run / "run.rrd"
    make_folder(path.parent)
    write_recording(run, estimates_of(run, entry_of(run).pose).steps, path)
    sys.stdout.write(f"{path}\n")
    if not options.headless and has_display():
        # by itself the viewer would listen to the whole network
        subprocess.Popen([sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(path)], start_new_session=True)
    return DONE


def has_display() -> bool:
    """Whether a window can be opened here."""
    return sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
