"""Settings are held to the bounds in their types, and what is refused is said with its name."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import pytest
import torch
from annotated_types import Gt, Interval

from sdf.bounds import ASCENDING, Checked, Count, Finite, OneOf, Positive, TrainedPositive

pytestmark = pytest.mark.usefixtures("no_shape_check")


class RangeError(ValueError):
    """A class's own refusal."""


@dataclass(frozen=True)
class Some(Checked):
    length: Positive = 1.0
    span: Annotated[tuple[Positive, Positive], ASCENDING] = (1.0, 2.0)
    count: Count | None = None
    up: Literal["auto"] | tuple[Finite, Finite, Finite] = "auto"
    floor: Positive | tuple[Positive, ...] = 1.0
    name: Annotated[str, OneOf(("x", "y"))] = "x"
    far: Annotated[float, Gt(0.0)] = math.inf
    trained: TrainedPositive = 1.0


@dataclass(frozen=True)
class Own(Some, refusal=RangeError):
    share: Annotated[float, Interval(ge=0.0, lt=1.0)] = 0.0


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"length": 0.0}, "Expected length above 0 and finite, got 0.0"),
        ({"length": math.nan}, "Expected length above 0 and finite, got nan"),
        ({"length": math.inf}, "Expected length above 0 and finite, got inf"),
        ({"span": (2.0, 1.0)}, r"Expected span as \(low, high\), low <= high, got \(2.0, 1.0\)"),
        ({"span": (0.0, 1.0)}, "Expected span above 0"),
        ({"span": (1.0,)}, "Expected span as 2 values"),
        ({"count": 0}, "Expected count to be 1 or more, got 0"),
        ({"count": 1.5}, "Expected count to be a whole number, got 1.5"),
        ({"up": "down"}, "Expected up to be one of auto, got 'down'"),
        ({"up": (1.0, 2.0, math.nan)}, "Expected up to be finite"),
        ({"floor": (1.0, -1.0)}, "Expected floor above 0"),
        ({"name": "z"}, "Expected name to be one of x, y, got 'z'"),
        ({"far": -1.0}, "Expected far above 0, got -1.0"),
        ({"trained": torch.tensor(-1.0)}, "Expected trained above 0"),
    ],
)
def test_what_is_out_of_bounds_is_refused(values, said):
    with pytest.raises(ValueError, match=said):
        Some(**values)


def test_what_is_within_is_kept():
    trained = torch.tensor(0.5, requires_grad=True)
    made = Some(count=3, up=(0.0, 0.0, 1.0), floor=(1.0, 2.0), trained=trained)
    assert (made.count, made.floor) == (3, (1.0, 2.0)) and made.trained is trained


def test_a_class_that_inherits_has_its_own_refusal_and_all_bounds():
    for values in ({"share": 1.0}, {"length": -1.0}):
        with pytest.raises(RangeError, match=next(iter(values))):
            Own(**values)
    assert Some._refusal is ValueError
