"""The command `rumi view`: a recorded run in the viewer Rerun."""

import importlib.util
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated

import tyro

from rumi.environment import has_display
from rumi.errors import UsageError
from rumi.exit_codes import DONE

RECORDING = "run.rrd"
"""Name of the recording in a run's folder."""

_WRITERS = [Path(__file__).parents[1] / "viz" / name for name in ("viewer.py", "viewer_layout.py", "reasons.py")]


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
        subprocess.Popen([sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(path)], start_new_session=True)
    return DONE


def keep(folder: Path) -> None:
    """Write the recording of a run that has just ended, where the viewer is installed: `rumi view` opens it at once."""
    if not _installed():
        return
    from rumi.runs.progress import say

    try:
        write(folder, folder / RECORDING)
    except (UsageError, ImportError, OSError) as error:  # the run itself is whole
        say(f"no recording for `rumi view`: {error}")


def _installed() -> bool:
    try:
        return importlib.util.find_spec("rerun") is not None
    except (ImportError, ValueError):  # hidden by hand
        return False


def write(run: Path, path: Path) -> None:
    """Write the recording of a run's folder, or of a log."""
    from rumi.runs.export import estimates_of
    from rumi.runs.folder import load_run, make_folder
    from rumi.tasks.registry import entry_of
    from rumi.viz.viewer import write_recording

    if run.is_file():
        from rumi.commands.replayed import run_folder

        with run_folder(run) as folder:
            read = load_run(folder)
    else:
        read = load_run(run)
    make_folder(path.parent)
    write_recording(read, estimates_of(read, entry_of(read).pose).steps, path)


def is_fresh(path: Path, run: Path) -> bool:
    """Whether a recording is there that is younger than all that it shows and all that writes it."""
    try:
        installed = metadata.version("rerun-sdk")
        before = (*run.glob("*.json*"), run / "trace.npz", *_WRITERS)
        with path.open("rb") as file:
            same = tuple(file.read(8)[4:7]) == tuple(int(part) for part in installed.split(".")[:3])
        return same and all(path.stat().st_mtime > one.stat().st_mtime for one in before)
    except (metadata.PackageNotFoundError, OSError, ValueError):
        return False
