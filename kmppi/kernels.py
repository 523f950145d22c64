"""Time kernels: similarity of the controls at two instants by the steps between them."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi.types import KernelName

Kernel = Callable[[Float[Tensor, "*b"]], Float[Tensor, "*b"]]


def rbf(ratio: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """exp(-r^2 / 2) of the ratio r (*b) of time difference and scale (RUMI, V.F)."""
    return torch.exp(-0.5 * ratio**2)


def matern32(ratio: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Matern kernel, nu = 3/2, of r (*b): once differentiable controls."""
    scaled = math.sqrt(3.0) * ratio.abs()
    return (1.0 + scaled) * torch.exp(-scaled)


def matern52(ratio: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Matern kernel, nu = 5/2, of r (*b): twice differentiable controls."""
    scaled = math.sqrt(5.0) * ratio.abs()
    return (1.0 + scaled + scaled**2 / 3.0) * torch.exp(-scaled)


def bspline3(ratio: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Cubic B-spline of r (*b), 1 at 0 and 0 from |r| = 2: local, each knot reaches two scales."""
    r = ratio.abs()
    return 0.25 * (2.0 - r).clamp_min(0.0) ** 3 - (1.0 - r).clamp_min(0.0) ** 3


KERNELS: dict[KernelName, Kernel] = {"rbf": rbf, "matern32": matern32, "matern52": matern52, "bspline3": bspline3}


def kernel_matrix(
    name: KernelName, rows: Float[Tensor, "R"], columns: Float[Tensor, "C"], scale: float
) -> Float[Tensor, "R C"]:
    """Kernel between all pairs of times.

    Args:
        name: one of `KERNELS`.
        rows: (R,), times, steps.
        columns: (C,), times, steps.
        scale: length of the kernel, steps.

    Returns:
        (R, C), 1 where two times are equal.

    Raises:
        ValueError: the name is not in the table.
    """
    if name not in KERNELS:
        raise ValueError(f"Expected kernel to be one of {', '.join(KERNELS)}, got {name!r}")
    return KERNELS[name]((rows[:, None] - columns[None, :]) / scale)
