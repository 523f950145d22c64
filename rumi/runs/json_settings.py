"""Settings as JSON: any dataclass of settings from plain values, checked and with clear messages.

`rumi.runs.plain.plain` is the way there.
"""

import math
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from rumi.errors import UsageError

_T = TypeVar("_T")

FORMER_KEYS: dict[str, dict[str, str]] = {
    "Settings": {"budget_s": "plan_budget_s"},
    "TouchBoxSettings": {"budget_s": "plan_budget_s"},
    "PegSettings": {"t_max_s": "action_budget_s"},
    "HandleSettings": {"budget_s": "run_budget_s"},
}
"""Keys that recorded settings have and that have another name now, by the name of their dataclass."""


def dataclass_of(kind: type[_T], values: Any, at: str = "") -> _T:  # noqa: ANN401  (read from JSON)
    """A dataclass from plain values, nested as its fields are; what is missing has its default.

    Args:
        kind: the dataclass.
        values: a mapping by field, as JSON gives it.
        at: what to name before a field in messages.

    Raises:
        UsageError: a name that is no field (the message lists the valid ones), or a value that is none.
    """
    if not isinstance(values, Mapping):
        raise UsageError(f"Expected {at or 'settings'} to be an object with named values, got {values!r}")
    hints, former = typing.get_type_hints(kind), FORMER_KEYS.get(kind.__name__, {})
    values = {former.get(name, name): value for name, value in values.items()}
    wrong = sorted(set(values) - {f.name for f in fields(kind)})  # type: ignore[arg-type]
    if wrong:
        known = ", ".join(at + name for name in hints)
        raise UsageError(f"There is no setting {at}{wrong[0]}; there are {known}")
    try:
        return kind(**{name: _value(hints[name], value, f"{at}{name}") for name, value in values.items()})
    except UsageError:
        raise
    except (ValueError, TypeError) as error:
        raise UsageError(f"{at.rstrip('.') or 'settings'}: {error}") from error


def setting_names(kind: type, prefix: str = "") -> list[str]:
    """Names of all settings as flags, nested ones with dots."""
    names: list[str] = []
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        # a flag may go by another name than the setting, and a group by none
        given = [extra.name for extra in get_args(hint)[1:] if getattr(extra, "name", None) is not None]
        called, inner = given[0] if given else name, get_args(hint)[0] if get_origin(hint) is Annotated else hint
        if is_dataclass(inner) and isinstance(inner, type):
            names += setting_names(inner, f"{prefix}{called}." if called else prefix)
        else:
            names.append(prefix + called)
    return names


def not_numbers(settings: Any, prefix: str = "") -> Iterator[str]:  # noqa: ANN401  (any settings class)
    """Names of the settings that are NaN, nested ones with dots."""
    for part in fields(settings):
        value, name = getattr(settings, part.name), prefix + part.name
        if is_dataclass(value):
            yield from not_numbers(value, f"{name}.")
        elif isinstance(value, float) and math.isnan(value):
            yield name


def _value(hint: Any, value: Any, at: str) -> Any:  # noqa: ANN401  (read from JSON, of the hint's type)
    if is_dataclass(hint) and isinstance(hint, type):
        return dataclass_of(hint, value, f"{at}.")
    if get_origin(hint) in (types.UnionType, typing.Union):
        options = get_args(hint)
        if value is None and types.NoneType in options:
            return None
        for option in options:
            try:
                return _value(option, value, at)
            except UsageError:
                continue
        raise UsageError(f"Expected {at} to be {hint}, got {value!r}")
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise UsageError(f"Expected {at} to be one of {', '.join(map(str, get_args(hint)))}, got {value!r}")
        return value
    if get_origin(hint) is tuple and isinstance(value, list | tuple):
        inner = get_args(hint)
        each = inner[:1] * len(value) if inner[1:] == (...,) else inner
        if len(each) != len(value):
            raise UsageError(f"Expected {at} to have {len(each)} values, got {value!r}")
        return tuple(_value(one, item, at) for one, item in zip(each, value, strict=True))
    if hint is float:
        if value is None:
            return math.inf  # what JSON has no word for
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    if isinstance(hint, type) and isinstance(value, hint) and isinstance(value, bool) == (hint is bool):
        return value
    name = getattr(hint, "__name__", str(hint))
    raise UsageError(f"Expected {at} to be of type {name}, got {value!r}")
