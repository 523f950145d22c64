"""Viewer recordings in the folders of runs."""

import importlib.util
from pathlib import Path

from rumi.errors import UsageError

RECORDING = "run.rrd"
"""Name of the recording in a run's folder."""


def keep(folder: Path) -> None:
    """Write the recording of a run that has just ended, where the viewer is installed: `rumi view` opens it at once."""
    if not _installed():
        return
    from rumi.runs.progress import say

    try:
        write_recording_of(folder, folder / RECORDING)
    except (UsageError, ImportError, OSError) as error:  # the run itself is whole
        say(f"no recording for `rumi view`: {error}")


def _installed() -> bool:
    try:
        return importlib.util.find_spec("rerun") is not None
    except (ImportError, ValueError):  # hidden by hand
        return False


def write_recording_of(folder: Path, path: Path) -> None:
    """Write the recording of a run's folder to a file.

    Raises:
        UsageError: it is no run's folder, or of a run that knows of no pose yet.
        ModuleNotFoundError: rerun-sdk is not installed.
    """
    from rumi.runs.export import estimates_of
    from rumi.runs.folder import load_run, make_folder
    from rumi.tasks.registry import entry_of
    from rumi.viz.viewer import write_recording

    read = load_run(folder)
    entry = entry_of(read)
    make_folder(path.parent)
    write_recording(read, estimates_of(read, entry.pose).steps, entry.view(read), path)
