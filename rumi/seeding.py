"""Random streams: one seed, independent named generators, draws that do not depend on batch mates."""

import hashlib
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from rumi.errors import UsageError

Generators = torch.Generator | Sequence[torch.Generator]
"""One generator for a whole batch, or one for each row of its first axis."""


def check_seed(seed: int, name: str = "seed") -> None:
    """Refuse a seed that is none.

    Args:
        seed: of randomness.
        name: to call it by.

    Raises:
        UsageError: it is no whole number, below 0, or of more bits than generators take.
    """
    if not _is_whole(seed) or not 0 <= seed < 2**63:
        raise UsageError(f"Expected {name} to be 0 or more, below 2**63, got {seed!r}")


def check_steps(steps: int | None) -> None:
    """Refuse a greatest number of actions that is none.

    Raises:
        UsageError: it is neither None nor a whole number of 0 or more.
    """
    if steps is not None and (not _is_whole(steps) or steps < 0):
        raise UsageError(f"Expected steps to be 0 or more, or None, got {steps!r}")


def _is_whole(value: object) -> bool:
    """Whether a value is an integer of Python, or of a library that can stand for one."""
    return hasattr(type(value), "__index__")


def generator(seed: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator on `device` that starts from `seed`."""
    return torch.Generator(device=device).manual_seed(seed)


def lone(source: Generators) -> torch.Generator:
    """The generator of one scene, where there is no batch.

    Raises:
        TypeError: there are several.
    """
    if not isinstance(source, torch.Generator):
        raise TypeError("Expected the generator of one scene, got those of several")
    return source


def split(source: int | torch.Generator, name: str, device: torch.device | str | None = None) -> torch.Generator:
    """An independent stream for one purpose, told apart by name.

    The stream depends on the seed and the name alone: how many numbers others drew, or in which order the
    streams were made, changes nothing. Of a generator the seed that it started from counts, not its state.

    Args:
        source: seed, or a generator with one.
        name: what the stream is for.
        device: of the new generator; by default the source's, or the CPU for a seed.

    >>> first, second = split(0, "simulator"), split(0, "planner")
    >>> bool((torch.rand(3, generator=first) == torch.rand(3, generator=second)).any())
    False
    """
    if isinstance(source, torch.Generator):
        seed, own_device = source.initial_seed(), source.device
    else:
        seed, own_device = source, torch.device("cpu")
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    # 63 bits, so that the seed of a split is itself a seed that can be split
    return generator(int.from_bytes(digest[:8], "little") >> 1, own_device if device is None else device)


def on_device(source: torch.Generator, device: torch.device) -> torch.Generator:
    """A generator of this device: the source itself, or one that starts from its next draw."""
    if source.device.type == device.type:
        return source
    return generator(int(torch.randint(2**63 - 1, (), generator=source, device=source.device)), device)


def normal(
    shape: Sequence[int],
    *,
    generator: Generators,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Standard normal draws of a shape.

    With a sequence of generators, row i of the first axis comes from generator i alone, so that a scene draws
    the same in a batch as on its own (there with one generator and `shape[1:]`).

    Args:
        shape: of the result; the first axis is that of the generators where there are several.
        generator: one, or one a row.
        dtype: of the result.
        device: of the result; the draws are made on the generator's own.

    Raises:
        ValueError: the number of generators is not the number of rows.
    """
    return _draw(torch.randn, shape, generator, dtype, device)


def uniform(
    shape: Sequence[int],
    *,
    generator: Generators,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Draws from [0, 1) of a shape; arguments and errors as of `normal`."""
    return _draw(torch.rand, shape, generator, dtype, device)


def _draw(
    draw: Callable[..., Tensor],
    shape: Sequence[int],
    generator: Generators,
    dtype: torch.dtype | None,
    device: torch.device | str | None,
) -> Tensor:
    if isinstance(generator, torch.Generator):
        drawn = draw(tuple(shape), generator=generator, dtype=dtype, device=generator.device)
    else:
        rows = shape[0] if len(shape) else 0
        if len(generator) != rows or not rows:
            raise ValueError(
                f"Expected one generator for each of the {rows} rows of shape {tuple(shape)}, got {len(generator)}: "
                "give a single generator, or as many as the first axis is long"
            )
        drawn = torch.stack(
            [draw(tuple(shape[1:]), generator=one, dtype=dtype, device=one.device) for one in generator]
        )
    return drawn if device is None else drawn.to(device)
