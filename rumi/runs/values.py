"""Records of any task in a trace: dataclasses, named tuples and tuples of tensors and plain values, and back."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from rumi.runs.trace import TraceWriter


def record_classes(kind: str) -> dict[str, type]:
    """Classes that records of a kind are made of, by name: the `records` of the task of that name.

    Raises:
        UsageError: there is no such task.
    """
    # tasks stand above: by address, as tables load their members
    entry = import_module("rumi.tasks.registry").TASKS[kind]
    return {one.__name__: one for one in entry.records}


def write_value(trace: TraceWriter, at: str, value: Any) -> Any:  # noqa: ANN401  (a record or a part of one)
    """Write the tensors of a value as arrays; what is left is JSON that says where they are."""
    if isinstance(value, Tensor):
        trace.array(at, value.detach().cpu().numpy())
        return {"array": at}
    if names := _names(value):
        parts = {name: write_value(trace, f"{at}/{name}", getattr(value, name)) for name in names}
        return {"is": type(value).__name__, "with": parts}
    if isinstance(value, Enum):
        return {"is": type(value).__name__, "member": value.value}
    if isinstance(value, tuple | list):
        return [write_value(trace, f"{at}/{place}", item) for place, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        return {"number": str(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"Expected a record of tensors and plain values, got a {type(value).__name__} at {at}")


def read_value(members: Mapping[str, Any], value: Any, kinds: Mapping[str, type]) -> Any:  # noqa: ANN401
    """What `write_value` wrote.

    Args:
        members: what `rumi.runs.trace.read_trace` gave.
        value: the JSON.
        kinds: classes by name.
    """
    if isinstance(value, list):
        return tuple(read_value(members, item, kinds) for item in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return torch.from_numpy(members[value["array"]])
    if "number" in value:
        return float(value["number"])
    if "member" in value:
        return kinds[value["is"]](value["member"])
    parts = {name: read_value(members, part, kinds) for name, part in value["with"].items()}
    return kinds[value["is"]](**parts)


def _names(value: Any) -> tuple[str, ...]:  # noqa: ANN401
    """Fields of a dataclass or a named tuple, without the seconds that differ from one time to the next."""
    if is_dataclass(value):
        return tuple(part.name for part in fields(value) if part.name != "timings_s")
    return getattr(value, "_fields", ())
