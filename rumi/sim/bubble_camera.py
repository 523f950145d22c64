"""Simulated soft bubble over a pad: a membrane that clings to what is pressed into it, and a camera inside."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.robot.gripper import GripperShape
from sdf import se3
from sensors.vision.camera import pinhole, pixel_rays

_HEIGHT, _WIDTH = 72, 96
_FIELD_RAD = math.radians(120.0)
_BEHIND_M = 0.004  # the membrane ends this far before the palm


class BubbleCamera:
    """The membrane at rest as its camera sees it; the camera stands on the palm and looks along the pad.

    The membrane is the pad's ellipsoid grown by `membrane_m`; where the other pad's membrane is in the way, and at the
    palm, there is none.

    Args:
        shape: the gripper's.
        pad: which of its pads.
        membrane_m: height of the membrane above the pad.
    """

    def __init__(self, shape: GripperShape, pad: int, membrane_m: float) -> None:
        self.intrinsics = pinhole(_HEIGHT, _WIDTH, _FIELD_RAD, dtype=torch.float64)
        center = torch.tensor(shape.pad_centers[pad], dtype=torch.float64)
        eye = torch.tensor([shape.palm_front_m, float(center[1]), 0.0], dtype=torch.float64)
        # forward is the tool's x, right its -y, down its -z
        turn = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
        self.tool_T_camera = se3.make(turn, eye)
        self.rays = pixel_rays(_HEIGHT, _WIDTH, self.intrinsics).reshape(-1, 3)
        ways = self.rays @ turn.mT
        half = torch.tensor(shape.pad_m, dtype=torch.float64) + membrane_m
        self.rest = _far_side((eye - center) / half, ways / half).reshape(_HEIGHT, _WIDTH)
        places = eye + self.rest.reshape(-1, 1) * ways
        other = torch.tensor(shape.pad_centers[1 - pad], dtype=torch.float64)
        free = ((places - other) / half).norm(dim=-1) > 1.0
        free &= places[:, 0] > shape.palm_front_m + _BEHIND_M
        self.membrane: Bool[Tensor, "H W"] = free.reshape(_HEIGHT, _WIDTH)
        self.rest = torch.where(self.membrane, self.rest, torch.zeros_like(self.rest))

    def ways(self, world_T_tool: Float[Tensor, "4 4"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "n 3"]]:
        """Where the camera is in the world, and the directions of the membrane's pixels, whose depth is 1."""
        world_T_camera = world_T_tool.double() @ self.tool_T_camera
        own = self.rays[self.membrane.reshape(-1)]
        return world_T_camera[:3, 3], own @ world_T_camera[:3, :3].mT

    def image(self, met: Float[Tensor, "n"]) -> Float[Tensor, "H W"]:
        """Depth of the membrane where what is met, along the pixels' rays, pushes it in; 0 where there is none."""
        depth = self.rest.clone()
        depth[self.membrane] = torch.minimum(depth[self.membrane], met)
        return depth


def _far_side(eye: Float[Tensor, "3"], ways: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """How many times its length each ray goes from inside a unit ball to its surface."""
    a, b = ways.square().sum(-1), ways @ eye
    return (-b + (b.square() - a * (eye @ eye - 1.0)).sqrt()) / a
