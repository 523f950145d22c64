"""Settings as JSON: any dataclass of settings from plain values, checked and with clear messages.

`rumi.runs.plain.plain` is the way there.
"""

import difflib
import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import numpy as np

from rumi.errors import UsageError

_T = TypeVar("_T")
_hints: Callable[[Any], dict[str, Any]] = cache(typing.get_type_hints)

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
    hints, former = _hints(kind), FORMER_KEYS.get(kind.__name__, {})
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


def changed(settings: _T, changes: Mapping[str, Any]) -> _T:
    """Settings with other values, by names as the command line has them: "seed", "planner.mppi.samples".

    Args:
        settings: a dataclass, nested as its fields are.
        changes: values by name; of a group of settings also a mapping by name, or the group as a dataclass.

    Raises:
        UsageError: a name that is no setting (the message has the nearest), or a value that is none.
    """
    for name, value in changes.items():
        settings = _changed(settings, name, value, "")
    return settings


def _changed(settings: _T, name: str, value: Any, at: str) -> _T:  # noqa: ANN401  (of the setting's type)
    first, _, rest = name.partition(".")
    hints = _hints(type(settings))
    for field, called, group in _groups(type(settings)):
        current = getattr(settings, field)
        if first not in (called, field) or (rest and not group):
            if called or name not in setting_names(type(current)):
                continue
            new = _changed(current, name, value, at)  # of a group without a name
        elif rest:
            new = _changed(current, rest, value, f"{at}{first}.")
        elif group and isinstance(value, Mapping):
            new = current
            for key, one in value.items():
                new = _changed(new, key, one, f"{at}{first}.")
        elif group:
            if not isinstance(value, type(current)):
                kind = type(current).__name__
                raise UsageError(f"Expected {at}{first} to be a dict of its settings or {kind}, got {value!r}")
            new = value
        else:
            new = _value(hints[field], value.item() if isinstance(value, np.generic) else value, f"{at}{first}")
        return replace(settings, **{field: new})  # type: ignore[type-var]
    known = setting_names(type(settings))
    groups = [called for _, called, group in _groups(type(settings)) if group and called]
    near = [one for one in known if one.endswith(f".{name}")] or difflib.get_close_matches(name, [*groups, *known], 2)
    meant = " or ".join(at + one for one in near) if near else ", ".join(at + one for one in known)
    raise UsageError(f"There is no setting {at}{name}; " + (f"did you mean {meant}?" if near else f"there are {meant}"))


def setting_names(kind: type, prefix: str = "") -> list[str]:
    """Names of all settings as flags, nested ones with dots."""
    names: list[str] = []
    for _, called, group in _groups(kind):
        names += setting_names(group, f"{prefix}{called}." if called else prefix) if group else [prefix + called]
    return names


def _groups(kind: type) -> Iterator[tuple[str, str, type | None]]:
    """Fields of a settings class: name, name as a flag, and the dataclass where it is a group of settings."""
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        # a flag may go by another name than the setting, and a group by none
        inner, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        given = [extra.name for extra in extras if getattr(extra, "name", None) is not None]
        group = inner if is_dataclass(inner) and isinstance(inner, type) else None
        yield name, given[0] if given else name, group


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
