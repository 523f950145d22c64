"""Time and memory of the hot operations over their size, each size in a process of its own with limited memory."""

import ctypes
import logging
import math
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from scripts.bench.scaling_work import SIZES, WORK, Axis, Size
from scripts.store import Figures, Store

_logger = logging.getLogger(__name__)
_CALL_S = 20.0
_SETUP_S = 60.0
_WALL = 10.0  # times the processor time, before a process is given up that gets no processor
_MEMORY_BYTES = 8 * 2**30


def run(*, quick: bool, out: Path, jsonl: Path | None = None) -> None:
    """Measure what is missing and draw the figure.

    Args:
        quick: the smaller sizes of a few operations.
        out: folder of the figure.
        jsonl: file of the results; by default `scaling.jsonl` in the folder.
    """
    store = Store(jsonl or out / "scaling.jsonl")
    for done in measure(store, quick=quick):
        if done:
            _logger.info("%d measurements", len(store.lines))
    from scripts.bench.scaling_figure import draw

    draw(store, out)


def measure(store: Store, *, quick: bool) -> Iterator[bool]:
    """Do what is missing; a series ends at the first size that takes too long or too much memory."""
    for name, (_, axes) in WORK.items():
        for axis in axes[:1] if quick else axes:
            yield from _series(store, name, axis, SIZES[axis][:2] if quick else SIZES[axis])


def _series(store: Store, name: str, axis: Axis, sizes: tuple[int, ...]) -> Iterator[bool]:
    for count in sizes:
        settings = {"part": "scaling", "op": name, "axis": axis, "size": count, "threads": torch.get_num_threads()}
        yield store.measure(settings, partial(measure_apart, name, replace(Size(), **{axis: count})))
        ended = [f["ended"] for f in store.of("scaling") if settings.items() <= f.items()]
        if ended != ["done"]:
            return


def measure_apart(name: str, size: Size, *, call_s: float = _CALL_S, memory_bytes: int = _MEMORY_BYTES) -> Figures:
    """Time and memory of one call in a process of its own.

    Args:
        name: a key of `WORK`.
        size: of the work.
        call_s: seconds of the processor after which the process is ended.
        memory_bytes: that the process may take beside what it starts with.

    Returns:
        `ended`: "done", "time" or "memory"; where done, `seconds`, `processor_s` (of the
        processor, on which others that share it tell less), `peak_bytes` (the most that the call added to the
        process's memory) and `result_bytes` (of these, what it gave back).
    """
    context = get_context("forkserver")
    context.set_forkserver_preload(["scripts.bench.scaling_work"])
    ours, theirs = context.Pipe()
    child = context.Process(target=_child, args=(theirs, name, size, torch.get_num_threads(), call_s, memory_bytes))
    child.start()
    theirs.close()
    try:
        # it reports when it is set up, and when it is done
        for patience in (_WALL * _SETUP_S, _WALL * call_s):
            figures: Figures | None = ours.recv() if ours.poll(patience) else {"ended": "time"}
            if figures is not None:
                return figures
        return {"ended": "time"}
    except EOFError:  # ended by the system
        child.join()
        return {"ended": "time" if child.exitcode == -signal.SIGXCPU else "memory"}
    finally:
        child.kill()
        child.join()


def _child(pipe: Connection, name: str, size: Size, threads: int, call_s: float, memory_bytes: int) -> None:
    import resource

    def allow(seconds: float) -> None:
        limit = math.ceil(time.process_time() + threads * seconds)
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))

    torch.set_num_threads(threads)
    allow(_SETUP_S)
    make = WORK[name][0]
    make(Size(particles=10, samples=10, scenes=min(size.scenes, 2)))()  # compile and fill caches
    resource.setrlimit(resource.RLIMIT_DATA, (_resident()["VmData"] + memory_bytes, resource.RLIM_INFINITY))
    try:
        work = make(size)
        before = _resident(reset=True)["VmRSS"]
        pipe.send(None)
        allow(call_s)
        begun, busy = time.perf_counter(), time.process_time()
        result = work()
        seconds, busy = time.perf_counter() - begun, time.process_time() - busy
        peak = _resident()["VmHWM"] - before
        figures = {"seconds": seconds, "processor_s": busy, "peak_bytes": peak, "result_bytes": _bytes(result)}
        pipe.send({"ended": "done"} | figures)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "memory" not in str(error):
            raise
        pipe.send({"ended": "memory"})


def _resident(*, reset: bool = False) -> dict[str, int]:
    """Memory of this process, bytes by the kernel's names; with `reset` the highest level starts anew."""
    if reset:
        # memory that was freed but is kept for later would hide what is taken from now on
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    rows = (line.split() for line in Path("/proc/self/status").read_text().splitlines() if line.endswith("kB"))
    return {row[0].rstrip(":"): 1024 * int(row[1]) for row in rows}


def _bytes(result: object) -> int:
    """Of all tensors in a result."""
    if isinstance(result, torch.Tensor):
        return result.untyped_storage().nbytes()
    if isinstance(result, tuple | list):
        return sum(map(_bytes, result))
    if hasattr(result, "__dataclass_fields__"):
        return sum(_bytes(getattr(result, name)) for name in result.__dataclass_fields__)
    return 0
