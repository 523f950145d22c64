"""Pauses of Python's garbage collector, and how a loop that must answer in time avoids them."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def set_aside() -> Iterator[None]:
    """Within the block the collector leaves alone what there was before.

    Libraries are a million objects, to look through which takes some 150 ms, at an instant that nobody chooses.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
