"""Where a push is outside of the quasi-static model of one contact: the tool holds the object at two places at once."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.sliding import rotated


def held_twice(
    poses: Float[Tensor, "E 3"],
    tools: Float[Tensor, "E 3"],
    body: PushedBody,
    *,
    near_m: float = 0.002,
    apart_m: float = 0.01,
    turned_rad: float = math.radians(45.0),
) -> Bool[Tensor, "E"]:
    """Whether the tool's border touches an object at two places whose normals differ, as a wedge or a grasp does.

    The model settles contacts one after the other: there forces between the two, which it knows nothing of, decide.
    A side along a flat side touches at many places with one normal, and a corner at one: neither counts.

    Args:
        poses: (x, y, yaw) of objects, metres and radians.
        tools: the same of the tool.
        body: object and tool.
        near_m: within which what is next to the object touches it.
        apart_m: between the two places, at least.
        turned_rad: between their normals, at least.
    """
    points = body.pusher.points.to(poses)
    placed = tools[:, None, :2] + rotated(points, tools[:, None, 2])
    local = rotated(placed - poses[:, None, :2], -poses[:, None, 2])
    outline = body.outline.to(poses) if hasattr(body.outline, "to") else body.outline
    found = outline(local)
    touching = (found.distance - body.pusher.thickness) < near_m
    normal = found.gradient / found.gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    apart = torch.cdist(local, local) > apart_m
    turned = normal @ normal.mT < math.cos(turned_rad)
    return (apart & turned & touching[:, :, None] & touching[:, None, :]).flatten(1).any(-1)
