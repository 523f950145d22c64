"""Physical numbers of modules, fixed or trained within their range, and settings that may be tensors."""

import math
from dataclasses import fields
from enum import Enum
from typing import Any

import torch
from torch import Tensor, nn

from sdf.check import is_eager


class Range(Enum):
    """Values that a physical number may have, by a free number that stands for it."""

    POSITIVE = "above 0"
    SHARE = "between 0 and 1"

    def of(self, free: Tensor) -> Tensor:
        """The physical number of a free one: finite, and a share neither 0 nor 1 to float32, wherever a step led."""
        return free.clamp(-27.0, 27.0).exp() if self is Range.POSITIVE else free.clamp(-16.0, 16.0).sigmoid()

    def free(self, value: float) -> float:
        """The free number of a physical one; not finite at an end of the range."""
        if value <= 0.0 or (self is Range.SHARE and value >= 1.0):
            return -math.inf
        return math.log(value) if self is Range.POSITIVE else math.log(value) - math.log1p(-value)


class Numbers(nn.Module):
    """Module with physical numbers, had by name: buffers, or trained.

    A trained number is what `raw_NAME`, an nn.Parameter of float32, stands for: its logarithm, of a share the logit.
    So a step of any optimiser leaves it within its range. A number at an end of its range, such as a tolerance of 0,
    has no such parameter and stays fixed.
    """

    _trained: dict[str, Range]

    def enter(self, name: str, value: float | Tensor, trained: Range | None = None) -> None:
        """Enter a number: a buffer, or trained within a range.

        Args:
            name: that it is had by.
            value: where it starts.
            trained: its range; None for a buffer.

        Raises:
            ValueError: it is a tensor that wants a gradient, which would be dropped.
        """
        if isinstance(value, Tensor) and value.requires_grad:
            raise ValueError(
                f"Expected {name} as a number, got a tensor that wants a gradient: ask for trainable=True, or give the "
                "tensor to torch.func.functional_call in the buffer's place"
            )
        free = -math.inf if trained is None else trained.free(float(value))
        if trained is None or not math.isfinite(free):
            self.register_buffer(name, torch.tensor(float(value), dtype=torch.float64))
            return
        self.__dict__.setdefault("_trained", {})[name] = trained
        self.register_parameter(f"raw_{name}", nn.Parameter(torch.tensor(free, dtype=torch.float32)))

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (as nn.Module's)
        trained = self.__dict__.get("_trained")
        if trained is not None and name in trained:
            return trained[name].of(super().__getattr__(f"raw_{name}"))
        return super().__getattr__(name)


def like(value: float | Tensor, tensor: Tensor) -> Tensor:
    """A number as a tensor of another's dtype and device; the slope of one that is a tensor is kept."""
    return value.to(tensor) if isinstance(value, Tensor) else tensor.new_tensor(value)


def log(value: float | Tensor) -> Any:  # noqa: ANN401  (float or Tensor, as what came)
    """Logarithm of a number or a tensor; -inf of 0."""
    if isinstance(value, Tensor):
        return value.log()
    return math.log(value) if value > 0 else -math.inf


def log1p(value: float | Tensor) -> Any:  # noqa: ANN401
    """Logarithm of 1 + a number or a tensor."""
    return value.log1p() if isinstance(value, Tensor) else math.log1p(value)


def refuse_trained(settings: Any, *but: str) -> None:  # noqa: ANN401  (any dataclass)
    """Refuse settings that are tensors and want a gradient, which would be dropped, all but some.

    Args:
        settings: a dataclass.
        *but: names of those whose gradient is kept.

    Raises:
        ValueError: with the name.
    """
    if not is_eager():
        return
    for part in fields(settings):
        value = getattr(settings, part.name)
        values = value if isinstance(value, tuple) else (value,)
        if part.name not in but and any(isinstance(one, Tensor) and one.requires_grad for one in values):
            kept = f"; those of {', '.join(but)} are" if but else ""
            raise ValueError(
                f"Expected {part.name} of {type(settings).__name__} as a number, got a tensor that wants a gradient, "
                f"which is not kept{kept}: give float(...), or detach it"
            )
