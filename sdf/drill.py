"""A drill-like object of the size of the YCB power drill, from a box and capsules."""

import torch

from sdf import se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Box, Capsule, Placed, Union
from sdf.symmetry import Symmetries


class Drill(Union):
    """A pistol drill that stands on its battery on z = 0; x points along its chuck, y = 0 is its mirror plane.

    The body lies `forward` of the middle of the base, so that the drill turned by half a turn is far from itself.
    Exact outside.

    Args:
        base: length, width and height of the battery, metres.
        handle_radius: metres.
        body_radius: metres.
        body_length: between the centres of the body's round ends, metres.
        body_height: of the body's axis above the floor, metres.
        forward: how far the body's middle is ahead of the base's, metres.
        chuck_radius: metres.
        chuck_length: by which the chuck's axis is ahead of the body's, metres.
    """

    def __init__(
        self,
        base: tuple[float, float, float] = (0.075, 0.056, 0.040),
        handle_radius: float = 0.019,
        body_radius: float = 0.029,
        body_length: float = 0.080,
        body_height: float = 0.158,
        forward: float = 0.030,
        chuck_radius: float = 0.015,
        chuck_length: float = 0.050,
    ) -> None:
        middle = torch.tensor([0.0, 0.0, 0.5 * base[2]])
        front, back = forward + 0.5 * body_length, forward - 0.5 * body_length
        self.base, self.body_radius = base, body_radius
        self.capsules = (
            ((0.0, 0.0, 0.5 * base[2]), (0.5 * forward, 0.0, body_height), handle_radius),
            ((back, 0.0, body_height), (front, 0.0, body_height), body_radius),
            ((front, 0.0, body_height), (front + chuck_length, 0.0, body_height), chuck_radius),
        )
        block = Placed(Box([0.5 * side for side in base]), se3.make(torch.eye(3), middle))
        super().__init__((block, *(Capsule(*capsule) for capsule in self.capsules)))


def drill_model(spacing: float = 0.002, points: int = 500, *, drill: Drill | None = None, seed: int = 0) -> ObjectModel:
    """The built-in drill; no turn maps it to itself."""
    return object_model("drill", drill or Drill(), Symmetries.none(), spacing=spacing, points=points, seed=seed)
