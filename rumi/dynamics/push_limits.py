"""Where a push is outside of the quasi-static model of one contact that slides an upright object.

The tool holds the object at two places at once, or pushes it so high that it tips.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.dynamics.outline import Base
from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.sliding import rotated

_SIDES = 72  # directions in which a base's convex hull is looked at, and in which an object is moved
_DEEPER = 0.25  # of such a way, by which the tool is deeper in it then: it stands in the way
_WEDGED = 0.05  # of the weight over the push, below which it is not let fall


def held_twice(
    poses: Float[Tensor, "E 3"],
    tools: Float[Tensor, "E 3"],
    body: PushedBody,
    *,
    near_m: float = 0.002,
    turned_rad: float = math.radians(45.0),
) -> Bool[Tensor, "E"]:
    """Whether the tool keeps an object from two sides, whose normals differ, as a wedge or a grasp does.

    The model settles contacts one after the other: there forces between the two, which it knows nothing of, decide.
    One contact stands in the way of less than half of all level motions, be it a flat side's, a corner's, or of a side
    that goes on beyond the object; two of them in the way of more.

    Args:
        poses: (x, y, yaw) of objects, metres and radians.
        tools: the same of the tool.
        body: object and tool.
        near_m: within which what is next to the object touches it.
        turned_rad: between the normals, at least.
    """
    points = body.pusher.points.to(poses)
    placed = tools[:, None, :2] + rotated(points, tools[:, None, 2])
    local = rotated(placed - poses[:, None, :2], -poses[:, None, 2])
    outline = body.outline.to(poses)
    way = 3.0 * near_m
    angle = torch.arange(_SIDES, dtype=poses.dtype, device=poses.device) * (2.0 * math.pi / _SIDES)
    moved = local[:, None] - way * torch.stack((angle.cos(), angle.sin()), -1)[:, None]
    now = (outline(local).distance.amin(-1) - body.pusher.thickness).clamp_max(0.0)
    then = outline(moved).distance.amin(-1) - body.pusher.thickness
    blocked = (then < now[:, None] - _DEEPER * way).sum(-1) * (2.0 * math.pi / _SIDES)
    return blocked > 2.0 * math.acos(_DEEPER) + turned_rad - 1e-6


def tips(
    yaw: Float[Tensor, "E"],
    direction: Float[Tensor, "2"],
    height_m: float,
    base: Base,
    touched: Float[Tensor, "E 2"] | None = None,
    *,
    friction: Float[Tensor, "*#E"] | float = 0.5,
    tool_friction: Float[Tensor, "*#E"] | float = 0.5,
) -> Bool[Tensor, "E"]:
    """Whether an upright object that is pushed at a height tips about an edge of its base before it slides.

    A push that is about to slide it moves the centre of pressure ahead of the centre of mass by friction times the
    height; out of the base's convex hull there is nothing to press on. Where it begins to lean, the side that the tool
    touches goes up, and the tool's own friction holds it down, by as much as it presses. Where the product of both
    frictions nears 1, pushing wedges the object.

    Args:
        yaw: of the objects, radians.
        direction: of the push, level; of any length but 0.
        height_m: of the push above what the object stands on.
        base: of the object.
        touched: places that the tool touches, object frame; None leaves the tool's own friction out.
        friction: coefficient between object and floor, one or one for each object.
        tool_friction: the same between object and tool.
    """
    ahead = rotated((direction / direction.norm()).to(yaw).expand(len(yaw), 2), -yaw)
    angle = torch.arange(_SIDES, dtype=yaw.dtype, device=yaw.device) * (2.0 * math.pi / _SIDES)
    sides = torch.stack((angle.cos(), angle.sin()), -1)
    reach = (sides @ (base.points - base.centre).to(yaw).mT).amax(-1)
    floor, tool = (torch.as_tensor(part).to(yaw).expand(len(yaw))[:, None] for part in (friction, tool_friction))
    if touched is None:
        return (floor * height_m * (ahead @ sides.mT) > reach).any(-1)
    # shares of the weight: what presses where it slides while held down all it can be, and the moment about an edge
    pressed = floor / (1.0 - floor * tool).clamp_min(_WEDGED)
    back = (reach - (touched - base.centre.to(yaw)) @ sides.mT).clamp_min(0.0)
    return (pressed * height_m * (ahead @ sides.mT) > reach + tool * pressed * back).any(-1)
