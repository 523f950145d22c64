"""What of a level tool objects meet that lie or lean on the floor: the deepest points, from beside and from above."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.resting import RestingPoses
from sdf import se3
from sdf.base import SDF

LEVEL = 0.5  # share of a contact's normal that has to be level for it to push
GRAZE_M = 0.001  # distance from the tool up to which what it presses on from above is dragged along
GROUP = 16  # points of the tool that lie near each other, as many as the compiled version takes at a time


class Scene(NamedTuple):
    """Object's signed distances and resting poses, and points of the tool in the world."""

    sdf: SDF
    rests: RestingPoses
    points: Float[Tensor, "n 3"]


class Met(NamedTuple):
    """What of the tool each of E objects meets.

    Attributes:
        depth: (E), of the point that is deepest in it sideways, metres; 0 for none.
        inward: (E, 2), level normal into it there.
        place: (E, 3), of that point.
        steep: (E), depth of the deepest point from above or below, down to -GRAZE_M, which is none.
        normal: (E, 3), into it there.
        at: (E, 3), of that point.
    """

    depth: Float[Tensor, "E"]
    inward: Float[Tensor, "E 2"]
    place: Float[Tensor, "E 3"]
    steep: Float[Tensor, "E"]
    normal: Float[Tensor, "E 3"]
    at: Float[Tensor, "E 3"]


def met_by(scene: Scene, planar: Float[Tensor, "E 3"], lying: Float[Tensor, "E 3"]) -> Met:
    """What objects meet.

    Args:
        scene: table of distances, resting poses, and the tool where it is.
        planar: (x, y, yaw) of each.
        lying: resting pose, edge that it leans about, and tilt.
    """
    sdf, rests, points = scene
    poses = rests.world_T_object(planar, lying)
    back = se3.inverse(poses)
    with torch.no_grad():
        local = se3.apply(back, points.expand(len(poses), -1, 3)).to(sdf.bounds)
        distance = sdf.distance(local)
        row, which = (distance < GRAZE_M).nonzero(as_tuple=True)
        gradient = sdf(local[row, which]).gradient.to(poses)
    gradient = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    inward, depth = -(gradient[:, None] @ back[row, :3, :3])[:, 0], -distance[row, which].to(poses)
    level, found = inward[:, :2].norm(dim=-1) > LEVEL, []
    for kept, least in ((level, 0.0), (~level, -GRAZE_M)):
        some = kept & (depth > least)
        deep = poses.new_full(distance.shape, least)
        deep[row[some], which[some]] = depth[some]
        most, index = deep.max(-1)
        normals = poses.new_zeros(*distance.shape, 3)
        normals[row[some], which[some]] = inward[some]
        found += [most, normals[torch.arange(len(poses)), index], points[index]]
    most, normal, place = found[:3]
    return Met(most, normal[:, :2] / normal[:, :2].norm(dim=-1, keepdim=True).clamp_min(1e-9), place, *found[3:])
