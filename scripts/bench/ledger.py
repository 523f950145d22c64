"""Results that are kept as JSON lines, so that what was measured is not measured again."""

import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import torch

from rumi.runs.jsonlines import append_line, read_lines
from rumi.runs.plain import plain
from sdf.processor import processor

Settings = dict[str, Any]
Figures = dict[str, Any]


class Ledger:
    """A file with one JSON line a measurement: settings, figures, and where they come from.

    A measurement counts as done when a line has its settings, whatever the code was then: to measure again, write to
    another file. A last line that was cut off is left out.

    Args:
        path: of the file; made with its folder at the first line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._done = {_key(line["settings"]) for line in self.lines()}

    def lines(self) -> Iterator[dict[str, Any]]:
        """All measurements."""
        yield from (line for line, _ in read_lines(self.path))

    def of(self, part: str) -> list[dict[str, Any]]:
        """Settings and figures together, of the lines of one part."""
        return [line["settings"] | line["figures"] for line in self.lines() if line["settings"]["part"] == part]

    def measure(self, settings: Settings, work: Callable[[], Figures]) -> bool:
        """Do a measurement and write it down, unless it is there.

        Args:
            settings: all that tells it from others; `part` among them.
            work: gives the figures.

        Returns:
            whether it was done now.
        """
        settings = dict(plain(settings))
        if _key(settings) in self._done:
            return False
        line = {"settings": settings, "figures": plain(work()), "commit": commit(), "machine": machine()}
        append_line(self.path, line)
        self._done.add(_key(settings))
        return True


def clock() -> float:
    """Seconds of the processor with one thread, on which others that share it tell less; else of the wall clock."""
    return time.process_time() if torch.get_num_threads() == 1 else time.perf_counter()


def median_seconds(work: Callable[[], object], *, repeats: int = 7, budget_s: float = 3.0) -> float:
    """Median time of repeated calls by `clock`, after one that warms up.

    Args:
        work: what to time.
        repeats: calls, fewer where they would take longer than
        budget_s: seconds in all.
    """
    begun = clock()
    work()
    first = clock() - begun
    if first > budget_s:
        return first
    times: list[float] = []
    while len(times) < repeats and (not times or sum(times) + times[-1] < budget_s):
        begun = clock()
        work()
        times.append(clock() - begun)
    return statistics.median(times)


@cache
def commit() -> str:
    """The checkout's commit, with a + where tracked files differ from it; empty outside of a checkout."""
    git = ["git", "-C", str(Path(__file__).parent)]

    def answer(*words: str) -> str:
        try:
            return subprocess.run([*git, *words], capture_output=True, text=True, check=False).stdout.strip()
        except OSError:
            return ""

    dirty = answer("status", "--porcelain", "--untracked-files=no", "--", "*.py")
    return answer("rev-parse", "--short", "HEAD") + ("+" if dirty else "")


def machine() -> str:
    """What the figures were measured on."""
    threads = torch.get_num_threads()
    own = processor()
    kernels = f"torch {torch.__version__} for {own.torch}, numba for {own.numba or 'none'} {own.features}".strip()
    return f"{own.model} {platform.machine()}, {os.cpu_count()} cores, {threads} threads, {kernels}"


def _key(settings: Settings) -> str:
    return json.dumps(settings, sort_keys=True)
