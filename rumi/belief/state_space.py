"""Spaces that the state of something fixed lives in, the plane and SE(3): steps within them, and differences."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import se3
from sdf.so3 import wrap


@runtime_checkable
class StateSpace(Protocol):
    """States of which some distribution is held by particles.

    Steps are such that a step and its opposite lead there and back: proposals made of them are symmetric.
    """

    @property
    def dims(self) -> int:
        """Numbers of a step."""
        ...

    @property
    def units(self) -> tuple[float, ...]:
        """What moves the object's border by about one metre, for each of them."""
        ...

    def stepped(self, states: Float[Tensor, "N ..."], step: Float[Tensor, "N D"]) -> Float[Tensor, "N ..."]:
        """States after a step each."""
        ...

    def difference(self, a: Float[Tensor, "N ..."], b: Float[Tensor, "N ..."]) -> Float[Tensor, "N D"]:
        """The step that leads from b to a."""
        ...


@dataclass(frozen=True)
class PlaneSpace:
    """(x, y) or (x, y, yaw).

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


@dataclass(frozen=True)
class PoseSpace:
    """world_T_object in SE(3); a step is a twist (v, omega) in the object's own frame.

    Attributes:
        lever_m: half of about the object's width.
    """

    lever_m: float = 0.1

    @property
    def dims(self) -> int:
        """6."""
        return 6

    @property
    def units(self) -> tuple[float, ...]:
        """Metres, and radians by the lever."""
        return (1.0,) * 3 + (1.0 / self.lever_m,) * 3

    def stepped(self, states: Float[Tensor, "N 4 4"], step: Float[Tensor, "N 6"]) -> Float[Tensor, "N 4 4"]:
        """T exp(step): where a step is as likely as its opposite, so is the way back."""
        return states @ se3.exp(step)

    def difference(self, a: Float[Tensor, "N 4 4"], b: Float[Tensor, "N 4 4"]) -> Float[Tensor, "N 6"]:
        """log(b^-1 a)."""
        return se3.log(se3.inverse(b) @ a)
