"""Settings checked by the types of their fields: bounds of annotated-types, choices, tuples of these, None."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cache
from numbers import Integral
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Interval, Le, Lt
from torch import Tensor

from sdf.check import is_eager


@dataclass(frozen=True)
class Law:
    """What a value must satisfy besides bounds: in words after "Expected NAME", and as a predicate."""

    text: str
    holds: Callable[[Any], bool]


@dataclass(frozen=True)
class OneOf:
    """Choice among names, such as those of a table; they are listed when a value is checked."""

    names: Collection[str]

    @property
    def text(self) -> str:
        """What is expected."""
        return f"to be one of {', '.join(self.names)}"

    def holds(self, value: str) -> bool:
        """Whether it is one of the names."""
        return value in self.names


Positive = Annotated[float, Gt(0.0), Lt(math.inf)]
NotNegative = Annotated[float, Ge(0.0), Lt(math.inf)]
Finite = Annotated[float, Law("to be finite", math.isfinite)]
Share = Annotated[float, Interval(ge=0.0, le=1.0)]
ShareBelow1 = Annotated[float, Interval(ge=0.0, lt=1.0)]
ShareAbove0 = Annotated[float, Interval(gt=0.0, le=1.0)]
Count = Annotated[int, Ge(1)]
CountOr0 = Annotated[int, Ge(0)]
TrainedPositive = Annotated[float | Tensor, Gt(0.0), Lt(math.inf)]
TrainedNotNegative = Annotated[float | Tensor, Ge(0.0), Lt(math.inf)]
TrainedShareBelow1 = Annotated[float | Tensor, Interval(ge=0.0, lt=1.0)]
ASCENDING = Law("as (low, high), low <= high", lambda pair: pair[0] <= pair[1])


class Checked:
    """Dataclass whose values are held to the bounds in the types of its fields when it is made.

    A type may be `Annotated` with bounds of annotated-types, `OneOf` or `Law`, a `Literal`, a tuple of these, or a
    union, of which a tuple has to meet a member that is a tuple, and another value one that is none.

    >>> @dataclass(frozen=True)
    ... class Push(Checked):
    ...     friction: Positive = 0.5
    >>> Push(-1.0)
    Traceback (most recent call last):
    ValueError: Expected friction above 0 and finite, got -1.0

    Args:
        refusal: the error of a class and of those that inherit from it; ValueError by default.
    """

    _refusal = ValueError

    def __init_subclass__(cls, refusal: type[ValueError] | None = None) -> None:
        super().__init_subclass__()
        if refusal is not None:
            cls._refusal = refusal

    def __post_init__(self) -> None:
        """Refuse values outside their bounds, where code may look at values.

        Raises:
            ValueError: or the class's own; with the name, what was expected and what came.
        """
        kind: Any = type(self)
        if is_eager():
            for name, hint in _bounded(kind).items():
                value = getattr(self, name)
                if expected := _expected(hint, value):
                    raise self._refusal(f"Expected {name} {expected}, got {value!r}")


@cache
def _bounded(kind: Any) -> dict[str, Any]:  # noqa: ANN401  (a class)
    """Types of the fields that have more to say than a class."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hint for name, hint in hints.items() if get_origin(hint) is not None}


def _expected(hint: Any, value: Any) -> str:  # noqa: ANN401  (any type, any value)
    """What a type asks for and a value does not meet; "" where it does."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "" if value in parts else f"to be one of {', '.join(map(str, parts))}"
    if origin is Annotated:
        if parts[0] is int and not isinstance(value, Integral):
            return "to be a whole number"
        return _expected(parts[0], value) or _out_of_bounds(parts[1:], value)
    if origin in (Union, UnionType):
        if value is None and NoneType in parts:
            return ""
        parts = tuple(part for part in parts if part is not NoneType and _is_tuple(part) == isinstance(value, tuple))
        answers = [_expected(part, value) for part in parts]
        return "" if "" in answers else " or ".join(answers)
    if origin is tuple:
        each = parts[:1] * len(value) if parts[1:] == (...,) else parts
        if len(each) != len(value):
            return f"as {len(each)} values"
        return next(filter(None, map(_expected, each, value)), "")
    return ""


def _is_tuple(hint: Any) -> bool:  # noqa: ANN401
    return get_origin(get_args(hint)[0] if get_origin(hint) is Annotated else hint) is tuple


def _out_of_bounds(marks: tuple[Any, ...], value: Any) -> str:  # noqa: ANN401
    """What bounds and laws ask for and a value does not meet; "" where it does."""
    low: Gt | Ge | None = None
    high: Lt | Le | None = None
    inside = True
    for mark in _single(marks):
        if isinstance(mark, Law | OneOf):
            if not mark.holds(value):
                return mark.text
        elif isinstance(mark, Gt):
            low, inside = mark, inside and value > mark.gt
        elif isinstance(mark, Ge):
            low, inside = mark, inside and value >= mark.ge
        elif isinstance(mark, Lt):
            high, inside = mark, inside and value < mark.lt
        elif isinstance(mark, Le):
            high, inside = mark, inside and value <= mark.le
    return "" if inside else _interval(low, high)


@cache
def _single(marks: tuple[Any, ...]) -> tuple[Any, ...]:
    """Marks, with an interval as its two bounds."""
    return tuple(one for mark in marks for one in (mark if isinstance(mark, Interval) else (mark,)))


def _interval(low: Gt | Ge | None, high: Lt | Le | None) -> str:
    """Bounds in words: "above 0 and finite", "to be 1 or more", "in [0, 1)"."""
    finite = high == Lt(math.inf)
    if low is not None and (high is None or finite):
        text = f"above {low.gt:g}" if isinstance(low, Gt) else f"to be {low.ge:g} or more"
        return f"{text} and finite" if finite else text
    start = "(-inf" if low is None else f"({low.gt:g}" if isinstance(low, Gt) else f"[{low.ge:g}"
    end = "inf)" if high is None else f"{high.lt:g})" if isinstance(high, Lt) else f"{high.le:g}]"
    return f"in {start}, {end}"
