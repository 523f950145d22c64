"""Run folders of recordings: a run's own, or of a log, which holds no beliefs, one that its replay writes."""

import contextlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rumi.commands.replay import replay


@contextlib.contextmanager
def run_folder(path: Path) -> Iterator[Path]:
    """The folder of a run; of a log one for the while, written by its replay.

    Raises:
        UsageError: the file is no log, or nothing can be replayed from it.
    """
    if not path.is_file():
        yield path
        return
    with tempfile.TemporaryDirectory() as aside:
        folder = Path(aside) / path.stem
        with contextlib.redirect_stdout(sys.stderr):  # what a replay says is not what was asked for
            replay([str(path), "--out", str(folder)])
        yield folder
