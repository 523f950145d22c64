"""Validators of shapes and finite values."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

import torch
from torch import Tensor
from torch.autograd import forward_ad

FAR = 1.0e6
"""Metres that stand for a coordinate that is not finite: farther than any scene, small enough to square."""

ROUNDING_M = 1e-5
"""Metres by which rounding may move a place: what poses are held to, a hundredth of a table's spacing of 1 mm."""


_barred: ContextVar[bool] = ContextVar("barred", default=False)


def check_shape(name: str, tensor: Tensor, text: str, last: tuple[int, ...] = ()) -> None:
    """Refuse a tensor of another shape than `text` says.

    Args:
        name: the argument's name, for the message.
        tensor: what came.
        text: the shape in words, such as "(*b, M, 3)": a leading name with a star stands for any number of
            axes, another name for one axis of any size, a number for one axis of that size.
        last: sizes that the trailing axes must have.

    Raises:
        ValueError: with the name, the expected shape and what came.
    """
    if not isinstance(tensor, Tensor):
        raise ValueError(
            f"Expected {name} to be a tensor of shape {text}, got {type(tensor).__name__}: use torch.as_tensor"
        )
    named, starred = _axes(text)
    shape = tuple(tensor.shape)
    fits = len(shape) >= len(named) if starred else len(shape) == len(named)
    if fits and named:
        fits = all(
            not entry.isdigit() or int(entry) == size
            for entry, size in zip(named, shape[len(shape) - len(named) :], strict=True)
        )
    if fits and last:
        fits = shape[-len(last) :] == tuple(last)
    if not fits:
        raise ValueError(f"Expected {name} to have shape {text}, got {shape}")


@cache
def _axes(text: str) -> tuple[tuple[str, ...], bool]:
    """Axes of a shape in words but for the starred one, and whether there is one: read once, met at every reading."""
    entries = [entry.strip() for entry in text.strip().strip("()").split(",") if entry.strip()]
    named = tuple(entry for entry in entries if not entry.startswith("*"))
    return named, len(named) < len(entries)


def check_finite(name: str, tensor: Tensor) -> None:
    """Refuse a tensor with NaN or infinity in it, where code may look (`may_look`).

    Raises:
        ValueError: with the name, how many values are not finite and where the first is.
    """
    if not may_look(tensor):
        return
    if math.isfinite(float(tensor.detach().sum())):  # quicker than a look at each, and what is not finite stays so
        return
    finite = torch.isfinite(tensor)
    if bool(finite.all()):
        return
    bad = (~finite).nonzero()
    first = tuple(bad[0].tolist())
    raise ValueError(
        f"Expected {name} to be finite, got {bad.shape[0]} of {tensor.numel()} values that are not (the first, "
        f"{float(tensor[first])}, at index {first}): remove or mask them"
    )


def check_near(name: str, places: Tensor, dtype: torch.dtype | None = None) -> None:
    """Refuse places so far from the origin that the numbers cannot tell a hundredth of a millimetre.

    The greatest coordinate times the precision's epsilon may be `ROUNDING_M` at most: 84 m in float32, and in float64
    farther than anybody goes. Values that are not finite are somebody else's to refuse.

    Args:
        name: the argument's name, for the message.
        places: coordinates, metres, of any shape.
        dtype: that they are worked with, if not their own.

    Raises:
        ValueError: with the name, how far places may be, how far they are, and what to do.
    """
    if places.numel() == 0 or not may_look(places):
        return
    epsilon = torch.finfo(dtype or places.dtype).eps
    farthest = float(places.detach().abs().amax())
    if ROUNDING_M < epsilon * farthest < float("inf"):
        raise ValueError(
            f"Expected {name} within {ROUNDING_M / epsilon:.3g} m of the origin for {dtype or places.dtype}, got "
            f"{farthest:.6g} m, where its numbers are {1e3 * epsilon * farthest:.1g} mm apart: subtract the middle of "
            "the workspace in float64 first, or work in float64"
        )


def eager_only(name: str, reason: str) -> None:
    """Refuse to be traced.

    Args:
        name: of the operation.
        reason: why it can be neither compiled nor transformed.

    Raises:
        NotImplementedError: under `torch.compile`, `torch.export`, `torch.func` and in forward mode.
    """
    if not is_eager():
        raise NotImplementedError(
            f"Expected {name} to run eagerly, got a call under torch.compile, torch.func or forward mode: {reason}"
        )


def keep_within_reach(coordinates: Tensor) -> Tensor:
    """Coordinates moved to within `FAR` metres of 0, NaN to `FAR`: hot paths answer "far outside", never NaN."""
    return torch.nan_to_num(coordinates, nan=FAR).clamp(-FAR, FAR)


@contextmanager
def no_waits() -> Iterator[None]:
    """Within the block nobody looks into tensors of a GPU, for which the host would have to wait (`may_look`)."""
    token = _barred.set(True)
    try:
        yield
    finally:
        _barred.reset(token)


def may_look(*tensors: Tensor) -> bool:
    """Whether code may branch on the values of tensors: where it `is_eager`, and within `no_waits` not of a GPU's."""
    return is_eager() and not (_barred.get() and any(tensor.device.type == "cuda" for tensor in tensors))


def is_eager() -> bool:
    """Whether code may branch on values, and values are all that tensors carry.

    Not so where `torch.compile` or `torch.export` traces, under a transform of `torch.func`, and in forward mode.
    """
    # the ways to ask that torch itself uses
    return not (
        torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0
    )
