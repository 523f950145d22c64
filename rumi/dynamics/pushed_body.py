"""A pushed object with its tool, and a push of it whose outcome was measured."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import GridOutline, Support, support_of
from rumi.dynamics.sliding import Outline
from rumi.robot.tool_shape import ToolShape
from sdf.base import SDF


class PushedBody(NamedTuple):
    """An upright object and the level tool that pushes it.

    Attributes:
        outline: of the object at the tool's height.
        support: how it rests on the floor.
        pusher: the tool.
    """

    outline: Outline
    support: Support
    pusher: Pusher

    @classmethod
    def of(cls, sdf: SDF, height_m: float, shape: ToolShape, *, spacing_m: float = 0.005) -> "PushedBody":
        """Of an object and a gripper, at a height in the object's frame; points of its border so far apart."""
        outline, support = GridOutline.of_slice(sdf, height_m), support_of(sdf)
        return cls(outline, support, Pusher(shape.outline(spacing_m).to(support.centre)))


class ObservedPush(NamedTuple):
    """A push whose outcome was measured.

    Attributes:
        start: (3,), pose (x, y, yaw) before, metres and radians.
        path: (K1, 3), (x, y, yaw) of the tool.
        end: (3,), pose after.
    """

    start: Float[Tensor, "3"]
    path: Float[Tensor, "K1 3"]
    end: Float[Tensor, "3"]
