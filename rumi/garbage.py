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


def give_back() -> None:
    """Collect garbage, and hand memory that is free back to the system, where the C library can (glibc)."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
