"""How far the work is: a table that is kept up to date on a terminal, and nothing elsewhere."""

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from rumi.runs.progress import Stream
from scripts.reproduce.jobs import Job
from scripts.reproduce.records import Records

PERIOD_S = 1.0


class LiveTable:
    """Shows the work of a command by column while others do it; use as a context manager.

    Args:
        jobs: all the work.
        path: file of the results.
        stream: where to; nothing is shown unless it is a terminal.
        workers: processes at once, for the time that is left.
    """

    def __init__(self, jobs: Sequence[Job], path: Path, stream: Stream | None = None, workers: int = 1) -> None:
        self._jobs, self._workers = jobs, workers
        self._stream = sys.stderr if stream is None else stream
        self._records = Records(path)
        self._begun, self._before = time.monotonic(), len(self._records.done(jobs))
        self._height = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._keep_up, daemon=True)

    def __enter__(self) -> Self:
        if self._stream.isatty():
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
            self._show()

    def _keep_up(self) -> None:
        while not self._ended.is_set():
            self._show()
            self._ended.wait(PERIOD_S)

    def _show(self) -> None:
        self._records.refresh()
        text = lines(self._jobs, self._records, time.monotonic() - self._begun, self._before, self._workers)
        # up to where the last one began, and away with it
        back = f"\x1b[{self._height}F\x1b[J" if self._height else ""
        self._stream.write(back + "\n".join(text) + "\n")
        self._stream.flush()
        self._height = len(text)


def lines(jobs: Sequence[Job], records: Records, elapsed_s: float, before: int = 0, workers: int = 1) -> list[str]:
    """The table: a line a column with what is done, right and how long a run takes, and a last one in all.

    Args:
        jobs: all the work.
        records: what is done.
        elapsed_s: since the command was given.
        before: pieces that were done then.
        workers: processes at once.
    """
    columns: dict[str, list[Job]] = {}
    for job in jobs:
        columns.setdefault(job.column, []).append(job)
    width = max(map(len, columns), default=0)
    text = []
    for name, own in columns.items():
        done = records.done(own)
        right = [record.figures["right"] for record in done if "right" in record.figures]
        said = f"{len(done):>4} of {len(own):<4}"
        said += f" right {sum(map(bool, right)):>3}" if right else " " * 10
        said += f"  {sum(record.timings['wall_s'] for record in done) / len(done):6.1f} s each" if done else ""
        text.append(f"{name:<{width}}  {said}".rstrip())
    total = len(records.done(jobs))
    left = ""
    if total > before:
        left = f", {_clock((len(jobs) - total) * elapsed_s / (total - before))} left with {workers} at once"
    return [*text, f"{total} of {len(jobs)} done, {_clock(elapsed_s)} so far{left}"]


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
