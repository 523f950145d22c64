"""Environment of the process: variables set for a while, as libraries read them when loaded; and the display."""

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

LIBRARIES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""What numerical libraries take the number of their threads from."""


@contextmanager
def variables(values: Mapping[str, str]) -> Iterator[None]:
    """Within the block, environment variables have these values.

    Args:
        values: by name; the others stay as they are.
    """
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def has_display() -> bool:
    """Whether a window can be opened here."""
    return sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
