"""Batch axes that broadcast."""

from collections.abc import Sequence
from itertools import zip_longest

import torch


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """The shape that some shapes broadcast to.

    `torch.broadcast_shapes` loads a library for symbols when it is first called: half a second and 34 MB.

    Raises:
        RuntimeError: they do not broadcast.
    """
    found: list[int] = []
    for sizes in zip_longest(*(tuple(shape)[::-1] for shape in shapes), fillvalue=1):
        wide = {size for size in sizes if size != 1} or {1}
        if len(wide) > 1:
            raise RuntimeError(
                f"Expected shapes that broadcast, got {', '.join(str(tuple(shape)) for shape in shapes)}"
            )
        found += wide
    return torch.Size(found[::-1])
