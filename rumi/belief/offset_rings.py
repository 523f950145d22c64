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


def displaced(ring: Ring, numbers: Float[Tensor, "M 3"], generator: torch.Generator) -> Float[Tensor, "M 3"]:
    """Offsets (x, y, yaw) of standard normals, of which the first is the distance's and the last the turn's."""
    angle = 2.0 * math.pi * torch.rand(len(numbers), generator=generator, dtype=torch.float64)
    far = (ring.middle + ring.spread * numbers[:, 0]).abs()
    return torch.stack((far * angle.cos(), far * angle.sin(), STRAIGHT_RAD * numbers[:, 2]), -1)


def drawn(ring: Ring, count: int, generator: torch.Generator) -> Float[Tensor, "M 3"]:
    """So many offsets (x, y, yaw)."""
    return displaced(ring, normal((count, 3), generator=generator, dtype=torch.float64), generator)


def log_density(ring: Ring, moves: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
    """Log-density of offsets (x, y, yaw)."""
    far = moves[:, :2].norm(dim=-1).clamp_min(1e-9)
    middle, spread = ring
    folded = torch.logaddexp(-0.5 * ((far - middle) / spread).square(), -0.5 * ((far + middle) / spread).square())
    turn = -0.5 * (moves[:, 2] / STRAIGHT_RAD).square() - math.log(STRAIGHT_RAD)
    return folded - math.log(spread) + turn - math.log(2.0 * math.pi) - (2.0 * math.pi * far).log()
