"""Numbers that a fuzz case is made of, drawn by hypothesis, and tensors of them."""

import math
from collections.abc import Sequence
from typing import TypeVar

import torch
from hypothesis import strategies as st
from torch import Tensor

from sdf import se3

_T = TypeVar("_T")

PLAIN = (0.0, 1.0, -1.0, 0.5, 1e-3, -1e-3, 0.1, 1e-7, 2.0, -0.3, 10.0, math.pi, -math.pi)
WILD = (math.nan, math.inf, -math.inf, 1e30, -1e30, 1e-30, 3.4e38, 1e-45, -0.0, 1e9, -1e9)


class Draw:
    """Where a case's choices come from: hypothesis, which makes a failing case small.

    Args:
        data: interactive draws of a test.
    """

    def __init__(self, data: st.DataObject) -> None:
        self._data = data

    def integer(self, low: int, high: int) -> int:
        """A whole number from low to high, both included."""
        return int(self._data.draw(st.integers(low, high)))


def choice(draw: Draw, options: Sequence[_T]) -> _T:
    """One of some."""
    return options[draw.integer(0, len(options) - 1)]


def number(draw: Draw, *, wild: bool = False) -> float:
    """A float: a special one, or any between -2 and 2."""
    if wild and draw.integer(0, 3) == 0:
        return choice(draw, WILD)
    return choice(draw, PLAIN) if draw.integer(0, 2) == 0 else draw.integer(-20000, 20000) * 1e-4


def tensor(draw: Draw, *shape: int, wild: bool = False) -> Tensor:
    """A tensor of such floats, in single or double precision."""
    dtype = choice(draw, (torch.float32, torch.float64))
    count = math.prod(shape)
    # a few numbers drawn, the rest by a seed: else large tensors take long
    random_part = torch.randn(
        count, generator=torch.Generator().manual_seed(draw.integer(0, 10**6)), dtype=torch.float64
    )
    for _ in range(draw.integer(0, min(count, 4))):
        random_part[draw.integer(0, count - 1)] = number(draw, wild=wild)
    return random_part.reshape(shape).to(dtype)


def poses(draw: Draw, *batch: int, wild: bool = False) -> Tensor:
    """Transforms; wild ones need not be any."""
    made = se3.exp(tensor(draw, *batch, 6, wild=wild))
    return made + tensor(draw, *batch, 4, 4, wild=wild).to(made) if wild and draw.integer(0, 3) == 0 else made


def log_weights(draw: Draw, *shape: int, wild: bool = False) -> Tensor:
    """Log-weights, some of them none."""
    made = 10.0 * tensor(draw, *shape, wild=wild)
    if draw.integer(0, 2) == 0 and made.numel():
        made.view(-1)[draw.integer(0, made.numel() - 1)] = -math.inf
    return made


def sizes(draw: Draw, most: int = 6) -> int:
    """A small count, 0 among them."""
    return draw.integer(0, most)
