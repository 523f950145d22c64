"""The gripper as rigid links, for filters that leave the robot out of what its camera sees."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.robot.gripper import GripperShape
from sdf import se3
from sdf.base import SDF
from sdf.primitives import Box, Placed


class Ellipsoid(SDF):
    """An ellipsoid about the origin; distances are exact on its surface and to first order off it.

    Args:
        half_axes: along x, y and z, metres.
    """

    def __init__(self, half_axes: tuple[float, float, float]) -> None:
        if not min(half_axes) > 0:
            raise ValueError(f"Expected half axes above 0, got {half_axes}")
        high = torch.tensor(half_axes)
        super().__init__(torch.stack((-high, high)))
        self.half_axes = half_axes

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres: (k - 1) k / |grad|, with k the scaled distance from the middle."""
        axes = points_o.new_tensor(self.half_axes)
        scaled = (points_o / axes).norm(dim=-1)
        steep = (points_o / axes.square()).norm(dim=-1)
        # at the very middle all directions are alike
        inside = -axes.min() * torch.ones_like(scaled)
        return torch.where(steep > 1e-9, scaled * (scaled - 1.0) / steep.clamp_min(1e-9), inside)


def gripper_links(shape: GripperShape, *, grown_m: float = 0.0) -> tuple[SDF, ...]:
    """Palm and pads in the tool's frame, each a link.

    Args:
        shape: the gripper's.
        grown_m: by which the pads are larger, such as a membrane over them.
    """
    a, b, c = (half + grown_m for half in shape.pad_m)
    palm = Box([0.5 * side for side in shape.palm_m])
    centers = ((shape.palm_center_m, 0.0, 0.0), *shape.pad_centers)
    members: tuple[SDF, ...] = (palm, *(Ellipsoid((a, b, c)) for _ in shape.pad_centers))
    turn = torch.eye(3)
    return tuple(Placed(m, se3.make(turn, torch.tensor(center))) for m, center in zip(members, centers, strict=True))
