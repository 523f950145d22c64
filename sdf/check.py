"""The only validators of shapes and finite values."""

import torch
from torch import Tensor

FAR = 1.0e6
"""Metres that stand for a coordinate that is not finite: farther than any scene, small enough to square."""


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
    entries = [entry.strip() for entry in text.strip().strip("()").split(",") if entry.strip()]
    named = [entry for entry in entries if not entry.startswith("*")]
    starred = len(named) < len(entries)
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


def check_finite(name: str, tensor: Tensor) -> None:
    """Refuse a tensor with NaN or infinity in it.

    Raises:
        ValueError: with the name, how many values are not finite and where the first is.
    """
    finite = torch.isfinite(tensor)
    if bool(finite.all()):
        return
    bad = (~finite).nonzero()
    first = tuple(bad[0].tolist())
    raise ValueError(
        f"Expected {name} to be finite, got {bad.shape[0]} of {tensor.numel()} values that are not (the first, "
        f"{float(tensor[first])}, at index {first}): remove or mask them"
    )


def keep_within_reach(coordinates: Tensor) -> Tensor:
    """Coordinates moved to within `FAR` metres of 0, NaN to `FAR`: hot paths answer "far outside", never NaN."""
    return torch.nan_to_num(coordinates, nan=FAR).clamp(-FAR, FAR)


def may_look() -> bool:
    """Whether code may branch on what is in its tensors: not while it is compiled or under a `torch.func` transform."""
    # the one way to ask for transforms that torch itself uses
    return not torch.compiler.is_compiling() and not torch._C._are_functorch_transforms_active()
