"""Approach: an action that may touch the object stops short of it, or goes on slowly."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief, subsample
from rumi.robot.tool import Tool
from sdf.base import SDF
from sdf.posed import posed_distance

APPROACH_M = 0.04
"""Length of an action that may touch an object which is soon toppled."""

_PARTS = 20  # of an action, at whose ends the tool is looked at
_PARTICLES = 64  # that stand for the belief
_SHARE = 0.02  # of the belief that the tool meets, from which on a touch is probable
_NEAR_M = 0.003  # of the tool to the surface, where it meets it
_SHORT_M = 0.003  # of the touch, where an action stops that leads to it
_ROOM_M = 0.010  # by which a touch may lie beyond a slow action's length and be gone on to at once


def shortened(
    control: Float[Tensor, "A"],
    tool: Tool,
    here: Float[Tensor, "Q"],
    belief: PoseBelief,
    sdf: SDF,
    slow_m: float,
) -> Float[Tensor, "A"]:
    """A control, shortened where it may touch the object.

    An action lasts as long whatever its length, so that a short one is slow: its instants lie close together, and a
    guarded move that ends with them ends soon after its touch. Where a touch is probable farther on than a slow
    action goes, the action stops short of it; else it goes on slowly, up to half as far again beyond the touch.

    Args:
        control: of the action, in [-1, 1].
        tool: the robot's.
        here: its configuration.
        belief: of where the object is.
        sdf: the object's.
        slow_m: length of a slow action.
    """
    path = tool.free_path(here, control[None], _PARTS)
    length = float((path[-1] - here)[:-1].norm())
    if length <= slow_m:
        return control
    few = subsample(belief, _PARTICLES)
    depth = posed_distance(sdf, few.world_T_object.to(path), tool.points(path).flatten(0, 1))
    met = (depth.unflatten(-1, (_PARTS, -1)).amin(-1) < _NEAR_M).cummax(-1).values
    share = few.log_weights.softmax(-1).to(path) @ met.to(path)
    probable = share >= _SHARE
    if not bool(probable[-1]):
        return control
    touch_m = length * int(torch.argmax(probable.byte())) / _PARTS
    most_m = touch_m - _SHORT_M if touch_m > slow_m + _ROOM_M else max(slow_m, touch_m + 0.5 * slow_m)
    return control * min(1.0, most_m / length)
