"""Lattice of a tabulated distance: nodes close together about the object, far apart beyond."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Lattice(NamedTuple):
    """Lattice of a table: the positions of its nodes.

    Attributes:
        axes: along x, y and z, metres, float64.
        origin: metres, the lower corner of the fine part.
        spacing: of the fine part, metres.
        outer: number of wide cells on every side.
        outer_spacing: their width, metres.
    """

    axes: tuple[Float[Tensor, "X"], Float[Tensor, "Y"], Float[Tensor, "Z"]]
    origin: tuple[float, float, float]
    spacing: float
    outer: int
    outer_spacing: float


def lattice_about(
    bounds: Float[Tensor, "2 3"], spacing: float, padding: float, *, outer: float = 0.25, outer_spacing: float = 0.02
) -> Lattice:
    """The lattice of `GridSDF.from_sdf`, which says what the arguments mean."""
    if not spacing > 0 or padding < 0 or outer < 0:
        raise ValueError(f"Expected spacing > 0, padding >= 0, outer >= 0, got {spacing}, {padding}, {outer}")
    corners = bounds.double().cpu()
    low, high = (corners[0] - padding).tolist(), (corners[1] + padding).tolist()
    wide = max(outer_spacing, spacing)
    count = _whole(outer / wide)
    beyond = wide * torch.arange(1, count + 1, dtype=torch.float64)
    axes = []
    for start, end in zip(low, high, strict=True):
        fine = start + spacing * torch.arange(max(_whole((end - start) / spacing), 1) + 1, dtype=torch.float64)
        axes.append(torch.cat((start - beyond.flip(0), fine, fine[-1] + beyond)))
    return Lattice((axes[0], axes[1], axes[2]), (low[0], low[1], low[2]), spacing, count, wide)


def _whole(ratio: float) -> int:
    """Least whole number not below a ratio, up to a thousandth (rounding)."""
    return math.ceil(ratio - 1e-3)
