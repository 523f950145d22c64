"""Contact of a tool's points with the object's true surface, of which a simulated gripper senses."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf.base import SDF
from sensors.touch.tactile import points_in_box


@torch.no_grad()
def touching(
    true: SDF, object_T_tool: Float[Tensor, "K 4 4"], points: Float[Tensor, "n 3"], contact_m: float
) -> Bool[Tensor, "K n"]:
    """Which points of a tool are within `contact_m` of the object's surface, instant by instant (RUMI, V.A)."""
    touched = torch.zeros(len(object_T_tool), len(points), dtype=torch.bool)
    near, index = points_in_box(object_T_tool, points, _box(true, points, contact_m))
    if len(index):
        touched[near.instant, index] = true.distance(near.points).abs() <= contact_m
    return touched


@torch.no_grad()
def outside(
    true: SDF, object_T_tool: Float[Tensor, "M 4 4"], points: Float[Tensor, "M 3"], contact_m: float
) -> Bool[Tensor, "M"]:
    """Which points, each of a tool at a pose of its own, are farther than `contact_m` outside the object's surface."""
    places = (object_T_tool[:, :3, :3] @ points[..., None])[..., 0] + object_T_tool[:, :3, 3]
    low, high = _box(true, places, contact_m)
    x, y, z = ((places >= low) & (places <= high)).unbind(-1)
    clear = ~(x & y & z)  # `all` takes ten times as long
    near = (~clear).nonzero()[:, 0]
    if len(near):
        clear[near] = true.distance(places[near]) > contact_m
    return clear


def _box(true: SDF, like: Tensor, contact_m: float) -> Float[Tensor, "2 3"]:
    """Where alone points touch the object or are in it, so that free motion costs next to nothing."""
    low, high = true.bounds.to(like)
    return torch.stack((low - contact_m, high + contact_m))
