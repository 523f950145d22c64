"""Error of where a simulated tool is taken to be: constant in the tool's frame, drawn by seed."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.seeding import split


@dataclass(frozen=True)
class ToolOffset:
    """Between the configuration that the robot takes its tool to have and the one that it has.

    A level tool is off in the plane and in yaw; one in space in height too.

    Attributes:
        own_m: (2) or (3), where the tool is taken to be, seen from where it is, along the axes of the true one.
        yaw_rad: by which it is taken to be turned.
    """

    own_m: Float[Tensor, "D"]
    yaw_rad: float

    @classmethod
    def drawn(cls, off_m: float, off_rad: float, *, spatial: bool, seed: int) -> "ToolOffset":
        """That of a seed: in a random direction by `off_m`, to a random side by `off_rad`."""
        generator = split(seed, "tool pose")
        way = torch.randn(3 if spatial else 2, generator=generator, dtype=torch.float64)
        side = 1.0 if float(torch.rand((), generator=generator)) < 0.5 else -1.0
        return cls(off_m * torch.nn.functional.normalize(way, dim=0), side * off_rad)

    @property
    def none(self) -> bool:
        """Whether the tool is where it is taken to be."""
        return self.yaw_rad == 0 and not bool(self.own_m.any())

    def taken(self, true: Float[Tensor, "*b Q"]) -> Float[Tensor, "*b Q"]:
        """Configurations as the robot takes them, of true ones."""
        return true if self.none else self._moved(true, true[..., -1], 1.0)

    def true(self, taken: Float[Tensor, "*b Q"]) -> Float[Tensor, "*b Q"]:
        """True configurations, of those that the robot takes them for."""
        return taken if self.none else self._moved(taken, taken[..., -1] - self.yaw_rad, -1.0)

    def _moved(self, q: Tensor, yaw: Tensor, sign: float) -> Tensor:
        x, y, *up = (sign * self.own_m).tolist()
        cos, sin = yaw.cos(), yaw.sin()
        steps = (cos * x - sin * y, sin * x + cos * y, *(torch.full_like(yaw, z) for z in up))
        return q + torch.stack((*steps, torch.full_like(yaw, math.copysign(1.0, sign) * self.yaw_rad)), -1)
