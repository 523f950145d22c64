"""Kills at random moments of what writes files: what was readable stays so, and nothing half-written is believed."""

import itertools
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rumi.runs.folder import RunRecorder, load_run
from rumi.runs.jsonlines import append_line, read_lines
from scripts.reproduce.records import Records
from sdf.cache import load_arrays, load_table, save_arrays, save_table
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from tests.stress.made_run import made_steps

Say = Callable[[int], None]
"""Tells the parent a number that is on the disk for good."""


def _cache(folder: Path, number: int, say: Say) -> None:
    for k in itertools.count():
        save_arrays(folder / f"cache-{k % 3}.npz", {"a": np.full((200, 200), k + 0.5), "b": np.full(7, k + 0.5)})


def _table(folder: Path, number: int, say: Say) -> None:
    tables = [GridSDF.from_sdf(Box((0.02, 0.03, x)), 0.004) for x in (0.01, 0.02)]
    for k in itertools.count():
        save_table(folder / "table.npz", tables[k % 2])


def _lines(folder: Path, number: int, say: Say) -> None:
    for k in itertools.count():
        append_line(folder / "lines.jsonl", {"writer": number, "k": k, "text": "x" * (k % 5000)})
        say(k)


def _run(folder: Path, number: int, say: Say) -> None:
    with RunRecorder(folder / f"run-{number}", {"seed": number}) as recorder:
        for step in made_steps():
            recorder(step)
            say(step.step)


WRITERS: dict[str, Callable[[Path, int, Say], None]] = {
    "cache": _cache,
    "table": _table,
    "lines": _lines,
    "run": _run,
}
"""What the killed processes do, over and over; each writes its own kind of file into the folder that it is given."""


@dataclass
class Killed:
    """What the kills did.

    Attributes:
        kills: how many of each kind.
        wrong: what was lost or believed wrongly, with the kill's number.
    """

    kills: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)


def kill_many(count: int, folder: Path, *, seed: int = 0, said: Callable[[int], None] | None = None) -> Killed:
    """Kills of each kind in turn, all in one folder, so that what one left behind is what the next one finds.

    Two processes write the same cache files and lines at a time; one of them is killed, then the other.
    """
    random, found = np.random.default_rng(seed), Killed()
    folder.mkdir(parents=True, exist_ok=True)
    kinds = list(WRITERS)
    turn = 0
    while sum(found.kills.values()) < count:
        kind = kinds[turn % len(kinds)]
        processes = [_start(kind, folder, 2 * turn + k) for k in range(1 if kind == "run" else 2)]
        time.sleep(float(random.uniform(0.0, 0.3)))
        told = [_kill(process) for process in processes]
        found.kills[kind] = found.kills.get(kind, 0) + len(processes)
        try:
            CHECKS[kind](folder, 2 * turn, told)
        except Exception as error:  # whatever is wrong is what is looked for
            found.wrong.append(f"kill {turn} of {kind}: {type(error).__name__}: {error}")
        turn += 1
        if said is not None:
            said(sum(found.kills.values()))
    return found


class _Process(NamedTuple):
    """A writer, and where it says what it has written."""

    pid: int
    output: int


def _start(kind: str, folder: Path, number: int) -> _Process:
    """A copy of this process that writes until it is killed."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writing)
        return _Process(pid, reading)
    try:
        os.close(reading)
        WRITERS[kind](folder, number, lambda k: _tell(writing, k))
    finally:
        os._exit(1)  # never back into what the parent was doing


def _tell(output: int, number: int) -> None:
    os.write(output, f"{number}\n".encode())


def _kill(process: _Process) -> int:
    """Kill, and the last number that was said to be written for good; -1 if none."""
    os.kill(process.pid, signal.SIGKILL)
    said = b""
    while part := os.read(process.output, 1 << 16):
        said += part
    os.close(process.output)
    _, status = os.waitpid(process.pid, 0)
    if not os.WIFSIGNALED(status):
        raise RuntimeError(f"a writer ended by itself, with status {status}")
    whole = said[: said.rfind(b"\n") + 1].split()
    return int(whole[-1]) if whole else -1


def _check_cache(folder: Path, number: int, told: list[int]) -> None:
    for path in folder.glob("cache-*.npz"):
        arrays = load_arrays(path, ("a", "b"))
        if arrays is None or len({*arrays["a"].ravel().tolist(), *arrays["b"].tolist()}) != 1:
            raise AssertionError(f"{path.name} is not whole")
    _remove_asides(folder)


def _check_table(folder: Path, number: int, told: list[int]) -> None:
    path = folder / "table.npz"
    if path.exists() and load_table(path) is None:
        raise AssertionError("the table is not whole")
    _remove_asides(folder)


def _remove_asides(folder: Path) -> None:
    # what a kill leaves is named so that nobody takes it for the file
    for path in folder.glob("*.tmp"):
        path.unlink()


def _check_lines(folder: Path, number: int, told: list[int]) -> None:
    path = folder / "lines.jsonl"
    lines = [line for line, _ in read_lines(path)]
    Records(path)
    for writer, last in enumerate(told):
        own = [line["k"] for line in lines if line.get("writer") == number + writer]
        if own != list(range(len(own))) or len(own) < last + 1:
            raise AssertionError(f"of {last + 1} lines that were said to be on the disk {len(own)} are")
    if any(len(line["text"]) != line["k"] % 5000 for line in lines):
        raise AssertionError("half a line was believed")


def _check_run(folder: Path, number: int, told: list[int]) -> None:
    run = folder / f"run-{number}"
    if not (run / "settings.json").is_file() or not (run / "trace.npz").is_file():
        if told[0] >= 0:
            raise AssertionError("a run that had steps has no settings or trace")
        return
    read = load_run(run)
    if len(read.steps) < told[0] + 1:
        raise AssertionError(f"of {told[0] + 1} steps {len(read.steps)} are left")


CHECKS: dict[str, Callable[[Path, int, list[int]], None]] = {
    "cache": _check_cache,
    "table": _check_table,
    "lines": _check_lines,
    "run": _check_run,
}
"""What must hold after a kill, by what was killed."""
