"""Flags of settings: a number that learning code may give as a tensor is a number on the command line."""

from typing import Any

from torch import Tensor
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

FLAGS = ConstructorRegistry()
"""What `tyro.cli` has to know to read settings."""


@FLAGS.primitive_rule
def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """A float for `float | Tensor`; None for all else."""
    if info.type != float | Tensor:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="FLOAT",
        instance_from_str=lambda words: float(words[0]),
        is_instance=lambda value: isinstance(value, float | int),
        str_from_instance=lambda value: [str(value)],
    )
