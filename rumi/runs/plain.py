"""Plain values, ready for JSON, of whatever settings and results hold."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import torch


def plain(value: Any) -> Any:  # noqa: ANN401  (that is its purpose)
    """Dataclasses become dicts, tuples lists, tensors lists or numbers, and numbers that are not finite None.

    Raises:
        TypeError: a value that JSON has no form for.

    >>> plain({"spread": float("inf"), "size": (1, 2)})
    {'spread': None, 'size': [1, 2]}
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, torch.Tensor):
        return plain(value.tolist())
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, Path | torch.device | torch.dtype):
        return str(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    raise TypeError(f"Expected a value that JSON can hold, got {type(value).__name__}")
