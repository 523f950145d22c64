"""Threads: how many a process takes, and how the iterations of a compiled loop are divided over them.

In a library the user decides: loops of kernels run on as many threads as torch does (`torch.set_num_threads`,
OMP_NUM_THREADS), and nothing of the process is changed. A command takes `chosen()` for as long as it runs: torch, whose
sums depend on the number of its threads, gets one; the kernels, whose results do not, as many as there are cores free.

Nobody spins: a thread with nothing to do sleeps, and whichever comes first takes the next part of a loop. A team of
OpenMP's, whose members wait for each other at the end of every loop, stands still where others share the cores.
"""

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from statistics import median_low

import torch

VARIABLE = "RUMI_THREADS"
"""Environment variable: threads of the kernels in commands, in place of as many as there are cores free."""
PARTS = 32
"""Parts of a loop. The first tells how much work there is, so that this also is the share that no helper can take."""
WORTH_S = 4e-4
"""Work for which another thread is woken, in seconds of one thread: several times what waking takes."""

_SAMPLES, _PAUSE_S = 5, 0.002

Part = tuple[int, int, int]
"""Parts from the first to before the second of the third's number of parts; `part_numba.indices` has its iterations."""

_given: int | None = None
_pool: tuple[int, ThreadPoolExecutor] | None = None


def count() -> int:
    """Threads that kernels may use: those of the `using` or `chosen` around, else torch's."""
    return torch.get_num_threads() if _given is None else _given


def free(cores: int, running: float, quota: float = math.inf) -> int:
    """Threads that find a core each: cores less those that others use, 1 at least.

    Args:
        cores: that this process may run on.
        running: others' processes and threads that run or wait for a core.
        quota: cores' worth of time that a control group allows.
    """
    return max(1, math.floor(min(cores - running, quota)))


def team(threads: int, work_s: float) -> int:
    """Threads for some work: no more than `threads`, and one where it is small.

    Args:
        threads: that there may be.
        work_s: seconds that it takes one thread.
    """
    return max(1, min(threads, math.floor(work_s / WORTH_S)))


def cores() -> int:
    """Processors that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def quota(root: Path = Path("/sys/fs/cgroup")) -> float:
    """Cores' worth of time that the control group allows; infinity where it sets no limit.

    Args:
        root: where control groups are mounted.
    """
    try:
        if (root / "cpu.max").is_file():
            most, period = (root / "cpu.max").read_text().split()
        else:
            most, period = ((root / "cpu" / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return float(most) / float(period) if most != "max" and float(most) > 0 else math.inf
    except (OSError, ValueError):
        return math.inf


def running(load: Path = Path("/proc/loadavg")) -> float:
    """Other processes and threads that run or wait for a core: now, or where that is not known, over the last minute.

    Args:
        load: the kernel's listing.
    """
    try:
        found = []
        for sample in range(_SAMPLES):
            time.sleep(_PAUSE_S if sample else 0.0)
            found.append(int(load.read_text().split()[3].split("/")[0]) - 1)  # this one runs, too
        return max(0, median_low(found))
    except (OSError, ValueError, IndexError):
        return round(os.getloadavg()[0]) if hasattr(os, "getloadavg") else 0.0


@contextmanager
def using(threads: int, *, torch_too: bool = False) -> Iterator[None]:
    """Within the block kernels use this many threads, and torch one.

    Args:
        threads: 1 or more.
        torch_too: let torch use as many; its sums over large tensors depend on it in their last bits.

    Raises:
        ValueError: it is less.
    """
    global _given
    if threads < 1:
        raise ValueError(f"Expected 1 thread or more, got {threads}")
    before, ours = _given, torch.get_num_threads()
    try:
        torch.set_num_threads(threads if torch_too else 1)
        _given = threads
        yield
    finally:
        torch.set_num_threads(ours)
        _given = before


@contextmanager
def chosen() -> Iterator[None]:
    """Within the block, threads as a command takes them; one decision, at its start.

    Where RUMI_THREADS is set, kernels use that many and torch one; where the user has set OMP_NUM_THREADS, both use
    what it says; else the kernels use as many as there are cores free, and torch one.

    Raises:
        ValueError: RUMI_THREADS is no number of threads.
    """
    asked = os.environ.get(VARIABLE, "").strip()
    if asked:
        if not (asked.isdecimal() and int(asked) >= 1):
            raise ValueError(f"Expected {VARIABLE} to be 1 or more, got {asked!r}")
        threads = int(asked)
    elif os.environ.get("OMP_NUM_THREADS"):
        yield
        return
    else:
        threads = free(cores(), running(), quota())
    with using(threads):
        yield


def divide(work: Callable[[Part], object], threads: int) -> None:
    """Carry out the parts of some work, each once, by one thread or by several where there is enough to do.

    The calling thread does the first part, and by the time that it took decides how many others are woken. After that
    each takes the next parts, the fewer the less is left; who comes late finds nothing to do and is not waited for.

    Args:
        work: carries out a part; parts may be carried out at the same time, so that it must let go of Python's lock.
        threads: that there may be.
    """
    if threads == 1:
        work((0, 1, 1))
        return
    began = time.thread_time()
    work((0, 1, PARTS))
    helpers = team(threads, (PARTS - 1) * (time.thread_time() - began)) - 1
    if helpers == 0:
        work((1, PARTS, PARTS))
        return
    left = _Left(2 * (helpers + 1))

    def help_out() -> None:
        while (part := left.take()) is not None:
            work(part)

    pool = _helpers()
    woken = [pool.submit(help_out) for _ in range(helpers)]
    try:
        help_out()
    finally:
        left.stop()
        for helper in woken:
            if not helper.cancel():
                helper.result()


class _Left:
    """What is left to do: parts from one on.

    Args:
        shares: into how many of equal size what is left is divided, of which whoever asks gets one.
    """

    def __init__(self, shares: int) -> None:
        self._shares, self._next, self._lock = shares, 1, threading.Lock()

    def take(self) -> Part | None:
        """The next parts, or None where none are left."""
        with self._lock:
            first = self._next
            self._next = min(PARTS, first + max(1, (PARTS - first) // self._shares))
            return (first, self._next, PARTS) if first < PARTS else None

    def stop(self) -> None:
        """Leave nothing to do."""
        with self._lock:
            self._next = PARTS


def _helpers() -> ThreadPoolExecutor:
    """Threads that sleep until they are called, of this process: those of a parent are not there after a fork."""
    global _pool
    if _pool is None or _pool[0] != os.getpid():
        _pool = os.getpid(), ThreadPoolExecutor(cores(), thread_name_prefix="rumi-kernel")
    return _pool[1]
