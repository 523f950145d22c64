"""Semantics of points (free, occupied, surface), and the sensor model that ties them to signed distance."""

from enum import IntEnum

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.numbers import Numbers, Range


class Semantics(IntEnum):
    """Semantic class of a point; the value is its index in every `(…, 3)` semantics axis."""

    FREE = 0
    OCCUPIED = 1
    SURFACE = 2


def semantics_probability(
    distance: Float[Tensor, "*b"], sharpness: float | Tensor = 100.0, tolerance: float | Tensor = 0.003
) -> Float[Tensor, "*b 3"]:
    """p(S | signed distance), last axis [free, occupied, surface], sums to 1 (RUMI, V.E).

    With `excess = max(0, |v| - tolerance)`, `1 - exp(-sharpness * excess)` goes to the side that the
    sign of v names and the rest to the surface. The paper prints the raw v in the occupied row; the
    toleranced one is used in all three, since otherwise they do not sum to 1.

    Args:
        distance: signed distance, metres.
        sharpness: 1/m.
        tolerance: metres within which a point counts as surface for sure.
    """
    excess = (distance.abs() - tolerance).clamp_min(0.0)
    # each by itself: of a difference from 1 little would be left where one of them is small
    surface = torch.exp(-sharpness * excess)
    off_surface = -torch.expm1(-sharpness * excess)
    outside = distance > 0
    zero = torch.zeros_like(off_surface)
    return torch.stack(
        (torch.where(outside, off_surface, zero), torch.where(outside, zero, off_surface), surface),
        dim=-1,
    )


def log_surface_probability(
    distance: Float[Tensor, "*b"], sharpness: float | Tensor = 100.0, tolerance: float | Tensor = 0.003
) -> Float[Tensor, "*b"]:
    """Log p(surface | signed distance): -sharpness * max(0, |v| - tolerance), never -inf (RUMI, V.E)."""
    return -sharpness * (distance.abs() - tolerance).clamp_min(0.0)


class SemanticSensor(Numbers):
    """The sensor model as a module: `sharpness` (1/m) and `tolerance` (m) are buffers or, if asked, trained.

    Args:
        sharpness: fall-off of the surface probability, 1/m.
        tolerance: metres within which a point counts as surface for sure.
        trainable: train both, within their range (`sdf.numbers.Numbers`).
    """

    sharpness: Tensor
    tolerance: Tensor

    def __init__(self, sharpness: float = 100.0, tolerance: float = 0.003, *, trainable: bool = False) -> None:
        super().__init__()
        for name, value in (("sharpness", sharpness), ("tolerance", tolerance)):
            self.enter(name, value, Range.POSITIVE if trainable else None)

    def forward(self, distance: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
        """p(S | signed distance) (*b, 3)."""
        return semantics_probability(distance, self.sharpness, self.tolerance)
