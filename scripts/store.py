"""Results as JSON lines, one a measurement, so that what was measured is not measured again."""

import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import torch

from rumi.runs.jsonlines import append_line, read_lines
from rumi.runs.plain import plain
from scripts.reproduce.code import present_code
from sdf.processor import processor

Settings = Mapping[str, Any]
Figures = dict[str, Any]
Line = dict[str, Any]


class Store:
    """A file with one JSON line a measurement, read as it grows.

    A line has `settings`, which are all that tells a measurement from others, `figures`, `commit` and `machine`; older
    files have all in one object. Where `code` is among the settings, results of code that is on record as the same
    (`scripts.reproduce.code`) count. A last line that was cut off is left out.

    Args:
        path: of the file; made with its folder at the first line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines: list[Line] = []
        self._read = 0
        self._done: dict[tuple[str, ...], set[str]] = {}
        self.refresh()

    def refresh(self) -> None:
        """Read what was added since."""
        for line, end in read_lines(self.path, self._read):
            self._read = end
            own = line["settings"] if _nested(line) else line
            if isinstance(own.get("code"), str):
                own["code"] = present_code(own["code"])
            self.take(line)
        self._done.clear()

    def take(self, line: Line) -> None:
        """Take in a line that was read."""
        self.lines.append(line)

    def flat(self) -> list[Line]:
        """Settings and figures together, with commit and machine."""
        return [_made_by(line) | line["settings"] | line["figures"] if _nested(line) else line for line in self.lines]

    def of(self, part: str) -> list[Line]:
        """Settings and figures together, of the lines of one part."""
        return [line for line in self.flat() if line.get("part") == part]

    def has(self, settings: Settings) -> bool:
        """Whether there is a line of these settings."""
        names = tuple(sorted(settings))
        if names not in self._done:
            self._done[names] = {
                _key(line["settings"] if _nested(line) else {name: line[name] for name in names})
                for line in self.lines
                if (tuple(sorted(line["settings"])) == names if _nested(line) else line.keys() >= set(names))
            }
        return _key(settings) in self._done[names]

    def add(self, settings: Settings, figures: Figures) -> None:
        """Write a measurement down."""
        append_line(
            self.path,
            {"settings": plain(settings), "figures": plain(figures), "commit": commit(), "machine": machine()},
        )
        self.refresh()

    def measure(self, settings: Settings, work: Callable[[], Figures]) -> bool:
        """Do a measurement and write it down, unless it is there.

        Args:
            settings: all that tells it from others.
            work: gives the figures.

        Returns:
            whether it was done now.
        """
        settings = dict(plain(settings))
        if self.has(settings):
            return False
        self.add(settings, work())
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


def _nested(line: Line) -> bool:
    return isinstance(line.get("settings"), dict)


def _made_by(line: Line) -> Line:
    return {name: line[name] for name in ("commit", "machine") if name in line}


def _key(settings: Settings) -> str:
    return json.dumps(settings, sort_keys=True)
