"""What targets have in common: how they are entered, what counts of their results, and the table that they use."""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from rumi.errors import DegenerateBeliefError
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from tests.stress.fuzz.draw import Draw

DOCUMENTED = (ValueError, DegenerateBeliefError)
"""What public functions raise on what they cannot take."""

Target = Callable[[Draw], Iterable[Tensor]]
FUNCTIONS: dict[str, Target] = {}
"""Targets by name: each makes a case of its draw and gives numbers that must be finite, as those that came in were."""


def target(function: Target) -> Target:
    """Decorator that enters a target."""
    FUNCTIONS[function.__name__.strip("_").replace("_", "-")] = function
    return function


def finite(*given: Tensor) -> bool:
    """Whether all numbers are finite and below 10 000."""
    return all(bool(torch.isfinite(one).all()) and bool((one.abs() < 1e4).all()) for one in given)


def out(given: Iterable[Tensor], *results: Tensor) -> tuple[Tensor, ...]:
    """Results to be looked at: those of finite input only."""
    return results if finite(*given) else ()


TABLE = GridSDF.from_sdf(Box((0.03, 0.05, 0.08)), 0.01)


def table(like: Tensor) -> GridSDF:
    """The table in the precision of a tensor."""
    x, y, z = TABLE.origin
    return GridSDF(TABLE.values.to(like), (x, y, z), 0.01, TABLE.bounds.to(like), outer=TABLE.outer)
