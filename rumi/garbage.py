"""Python's garbage collector: how a loop that must answer in time avoids its pauses, and memory given back."""

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def set_aside() -> Iterator[None]:
    """Within the block the collector leaves alone what there was before.

    Libraries are a million objects, to look through which takes some 150 ms, at an instant that nobody chooses. What
    was set aside before, as by a block around this one, stays so after it, and so does what this one added.
    """
    outermost = not gc.get_freeze_count()
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        if outermost:
            gc.unfreeze()


@contextmanager
def put_off() -> Iterator[None]:
    """Within the block nothing is collected, and the collector leaves alone for good what there is at its end.

    Around what loads libraries, in a process that ends with what it does: a quarter of the time to load them goes into
    looking through a million objects, as much at its end, and hardly any is garbage.
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collecting:
            gc.enable()


def give_back() -> None:
    """Collect garbage, and hand memory that is free back to the system, where the C library can (glibc)."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
