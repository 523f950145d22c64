"""Prior of a sensor that is off: an offset of about so much in any direction, which turns nothing."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.seeding import normal

STRAIGHT_RAD = 0.01
"""Deviation of the turn."""


class Ring(NamedTuple):
    """An offset's distance: mean and deviation, metres."""

    middle: float
    spread: float


HAND, CAMERA = Ring(0.006, 0.0015), Ring(0.010, 0.003)
"""Of a hand and of a camera that are off."""


def drawn(ring: Ring, count: int, generator: torch.Generator) -> Float[Tensor, "M 3"]:
    """So many offsets (x, y, yaw)."""
    numbers = normal((count, 2), generator=generator, dtype=torch.float64)
    angle = 2.0 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    far = (ring.middle + ring.spread * numbers[:, 0]).abs()
    return torch.stack((far * angle.cos(), far * angle.sin(), STRAIGHT_RAD * numbers[:, 1]), -1)
