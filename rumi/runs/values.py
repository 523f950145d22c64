"""Records of any task in a trace: dataclasses, named tuples and tuples of tensors and plain values, and back."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import torch
from torch import Tensor

from rumi.registry import Table
from rumi.runs.trace import TraceWriter

PARTS: Table[tuple[type, ...]] = Table("kind of record")
"""Classes that records of a task are made of, by the kind that a record names; the record's own class first."""

PARTS.add("touch-box", "rumi.tasks.touch_box.records:PARTS")
PARTS.add("peg", "rumi.tasks.peg.records:PARTS")


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


def read_value(members: Mapping[str, Any], told: Any, kinds: Mapping[str, type]) -> Any:  # noqa: ANN401
    """What `write_value` wrote.

    Args:
        members: what `rumi.runs.trace.read_trace` gave.
        told: the JSON.
        kinds: classes by name.
    """
    if isinstance(told, list):
        return tuple(read_value(members, item, kinds) for item in told)
    if not isinstance(told, dict):
        return told
    if "array" in told:
        return torch.from_numpy(members[told["array"]])
    if "number" in told:
        return float(told["number"])
    if "member" in told:
        return kinds[told["is"]](told["member"])
    parts = {name: read_value(members, value, kinds) for name, value in told["with"].items()}
    return kinds[told["is"]](**parts)


def _names(value: Any) -> tuple[str, ...]:  # noqa: ANN401
    """Fields of a dataclass or a named tuple, without the seconds that differ from one time to the next."""
    if is_dataclass(value):
        return tuple(part.name for part in fields(value) if part.name != "timings_s")
    return getattr(value, "_fields", ())
