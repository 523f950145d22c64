"""The command `rumi view`: a recorded run in the viewer Rerun."""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated

import tyro

from rumi.commands.recordings import RECORDING, write_recording_of
from rumi.environment import has_display
from rumi.exit_codes import DONE
from rumi.viz.viewer_program import viewer_program

_RUMI = Path(__file__).parents[1]
_WRITERS = [*(_RUMI / "viz").glob("*.py"), *(_RUMI / "tasks").glob("*/view.py")]


@dataclass(frozen=True)
class ViewOptions:
    """Look at a recorded run over time: object, particles, points, plan and contacts in space, beside its curves.

    Attributes:
        run: folder of the run, also of one that goes on or was interrupted; or a log, which is replayed for it.
        out: recording to write, .rrd; by default RUN/run.rrd, of a log beside it.
        headless: write it and open nothing, as where there is no display.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    headless: bool = False


def view(arguments: Sequence[str]) -> int:
    """`rumi view`: 0 where the recording is written, 2 for bad input."""
    options = tyro.cli(ViewOptions, prog="rumi view", args=arguments)
    path = options.out or (options.run.with_suffix(".rrd") if options.run.is_file() else options.run / RECORDING)
    if not is_fresh(path, options.run):
        from sdf.threads import chosen

        with chosen():
            write(options.run, path)
    sys.stdout.write(f"{path}\n")
    if not options.headless and has_display():
        # by itself the viewer would listen to the whole network
        subprocess.Popen([*viewer_program(), "--bind", "127.0.0.1", str(path)], start_new_session=True)
    return DONE


def write(run: Path, path: Path) -> None:
    """Write the recording of a run's folder, or of a log."""
    if not run.is_file():
        write_recording_of(run, path)
        return
    from rumi.commands.replayed import run_folder

    with run_folder(run) as folder:
        write_recording_of(folder, path)


def is_fresh(path: Path, run: Path) -> bool:
    """Whether a recording is there that is younger than all that it shows and all that writes it."""
    try:
        installed = metadata.version("rerun-sdk")
        shown = (*run.glob("*.json*"), run / "trace.npz") if run.is_dir() else (run,)
        before = (*shown, *_WRITERS)
        with path.open("rb") as file:
            same = tuple(file.read(8)[4:7]) == tuple(int(part) for part in installed.split(".")[:3])
        return same and all(path.stat().st_mtime > one.stat().st_mtime for one in before)
    except (metadata.PackageNotFoundError, OSError, ValueError):
        return False
