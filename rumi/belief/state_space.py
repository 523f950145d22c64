"""State space of a fixed planar object: increments and differences of states."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.so3 import wrap


@dataclass(frozen=True)
class PlaneSpace:
    """(x, y) or (x, y, yaw) of something fixed.

    A step and its opposite lead there and back: proposals made of them are symmetric.

    Attributes:
        lever_m: half of about the object's width; None without yaw.
    """

    lever_m: float | None = 0.1

    @property
    def dims(self) -> int:
        """2 or 3."""
        return 2 if self.lever_m is None else 3

    @property
    def units(self) -> tuple[float, ...]:
        """Metres, and radians by the lever."""
        return (1.0, 1.0) if self.lever_m is None else (1.0, 1.0, 1.0 / self.lever_m)

    def stepped(self, states: Float[Tensor, "N D"], step: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        """Added; yaw goes on beyond half a turn."""
        return states + step

    def difference(self, a: Float[Tensor, "N D"], b: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        """Subtracted, yaw by the shorter way."""
        apart = a - b
        if self.lever_m is None:
            return apart
        turn = wrap(apart[..., 2:])
        return torch.cat((apart[..., :2], turn), -1)
