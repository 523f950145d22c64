"""Quasi-static pushing of an object that may topple, by a tool that moves in space: slide, lean on the tool, fall.

What the tool meets sideways moves out of its way. With friction mu at floor and tool, a push at the height h slides the
object while that takes less force than to lift it about the edge ahead, which is s away from the centre of mass:
h < s (1/mu + mu). Else it leans about that edge by the tilt that the tool asks for, and back as the tool goes; with the
centre of mass above the edge it falls to the next resting pose at once. Pushes from above do nothing.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.dynamics.resting import RestingPoses
from rumi.dynamics.sliding import Sliding, Touch, pushed_out, rotated
from sdf import se3
from sdf.base import SDF

_MOST_M = 0.012  # that one contact moves an object, at most
_LEVEL = 0.5  # share of a contact's normal that has to be level for it to push
_PASSES, _TILTS = 2, 3
_ACROSS = 0.3  # cosine to the edge's normal below which a push does not lean on it


class Leaning(NamedTuple):
    """State of E objects: (x, y, yaw) of the resting frame, resting pose, edge it leans about (-1: none), tilt."""

    planar: Float[Tensor, "E 3"]
    lying: Float[Tensor, "E 3"]


class Push(NamedTuple):
    """What a motion of the tool did to E objects.

    Attributes:
        state: afterwards.
        slid: (E), whether it was pushed sideways.
        fell: (E), whether it fell over.
        ahead: (E, 2), direction of the last contact's push; 0 without one.
    """

    state: Leaning
    slid: Bool[Tensor, "E"]
    fell: Bool[Tensor, "E"]
    ahead: Float[Tensor, "E 2"]


def push_in_space(
    sdf: SDF,
    rests: RestingPoses,
    tool: Float[Tensor, "n 3"],
    state: Leaning,
    before: Float[Tensor, "4"],
    after: Float[Tensor, "4"],
    body: Sliding,
    firm: Float[Tensor, "E"],
) -> Push:
    """Objects after one small motion of a tool that stays level.

    Args:
        sdf: of the object.
        rests: its resting poses.
        tool: points of the tool's surface, tool frame, metres.
        state: of the objects.
        before: (x, y, yaw, z) of the tool.
        after: the same, after the motion.
        body: friction and sliding of each; `centre` in the resting frame.
        firm: tilt at which each falls over, as a share of that at which its centre of mass is above the edge.
    """
    planar, lying = state
    count = len(planar)
    points = torch.cat((rotated(tool[:, :2], after[2].expand(len(tool))) + after[:2], tool[:, 2:] + after[3]), -1)
    slid, fell = (torch.zeros(count, dtype=torch.bool) for _ in range(2))
    ahead = planar.new_zeros(count, 2)
    flat = torch.stack((lying[:, 0], torch.full_like(lying[:, 1], -1.0), torch.zeros_like(lying[:, 2])), -1)
    found, depth, inward, place = _deepest(sdf, rests, points, planar, flat)
    met = torch.zeros(count, dtype=torch.bool)
    met[found] = True
    # what the tool does not reach stands as it rests
    lying = torch.where(met[:, None], lying, flat)
    if not len(found):
        return Push(Leaning(planar, lying), slid, fell, ahead)
    ahead[found] = inward
    rest, edge = lying[found, 0].long(), lying[found, 1].long()
    way = rotated(inward, -planar[found, 2])
    # the edge ahead of the push, from below the centre of mass
    edges = rests.edges
    centre = rests.centre[rest][:, None]
    off = ((edges.point[rest] - centre) * edges.normal[rest]).sum(-1)
    rate = (edges.normal[rest] * way[:, None]).sum(-1)
    real = edges.tip_rad[rest].isfinite() & (rate > 1e-3)
    ratio = torch.where(real, off / rate.clamp_min(1e-3), torch.full_like(rate, torch.inf))
    chosen = ratio.argmin(-1)
    rows = torch.arange(len(found))
    friction = body.friction[found]
    high = place[:, 2] > ratio[rows, chosen] * (1.0 / friction + friction)
    leans = high & ratio[rows, chosen].isfinite() & (rate[rows, chosen] > _ACROSS)
    still = (edge >= 0) & (rate[rows, edge.clamp_min(0)] > _ACROSS)
    about = torch.where(still, edge, chosen)
    leans = leans | still
    tips = found[leans]
    if len(tips):
        about = about[leans].to(lying)
        tilt = depth[leans] / (place[leans, 2] * rate[leans, about.long()]).clamp_min(0.01)
        for turn in range(_TILTS):
            lying[tips] = torch.stack((lying[tips, 0], about, tilt), -1)
            if turn == _TILTS - 1:
                break
            inner, deep, normal, at = _deepest(sdf, rests, points, planar[tips], lying[tips])
            outward = rotated(edges.normal[lying[tips[inner], 0].long(), about[inner].long()], planar[tips[inner], 2])
            tilt[inner] += deep / (at[:, 2] * (normal * outward).sum(-1)).clamp_min(0.01)
        over = tilt >= firm[tips] * edges.tip_rad[lying[tips, 0].long(), about.long()]
        down = tips[over]
        if len(down):
            rest, edge = lying[down, 0].long(), lying[down, 1].long()
            change = edges.change[rest, edge]
            moved = planar[down, :2] + rotated(change[:, :2], planar[down, 2])
            planar = planar.index_copy(0, down, torch.cat((moved, planar[down, 2:] + change[:, 2:]), -1))
            lying[down] = torch.stack(
                (edges.next[rest, edge].to(lying), torch.full_like(over[over].to(lying), -1.0), 0.0 * change[:, 0]), -1
            )
            fell[down] = True
    slides = found[~leans]
    if len(slides):
        lying[slides] = flat[slides]
        slid[slides] = True
        kept = ~leans
        now = planar[slides]
        start, own = now, body.at(slides)
        some, touch = torch.arange(len(slides)), (depth[kept], inward[kept], place[kept])
        for turn in range(_PASSES):
            if turn:
                some, *touch = _deepest(sdf, rests, points, now, lying[slides])
                if not len(some):
                    break
            many = len(some)
            met_at = Touch(touch[2][:, :2], touch[1], touch[0].clamp_max(_MOST_M))
            out = pushed_out(
                now[some], start[some], before[:3].expand(many, 3), after[:3].expand(many, 3), met_at, own.at(some)
            )
            now = now.index_copy(0, some, out)
        planar = planar.index_copy(0, slides, now)
    return Push(Leaning(planar, lying), slid, fell, ahead)


def _deepest(
    sdf: SDF,
    rests: RestingPoses,
    points: Float[Tensor, "n 3"],
    planar: Float[Tensor, "E 3"],
    lying: Float[Tensor, "E 3"],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Objects that the tool is in sideways: which, how deep, the level normal into them, and the point of the tool."""
    poses = rests.world_T_object(planar, lying)
    back = se3.inverse(poses)
    with torch.no_grad():
        local = se3.apply(back, points.expand(len(poses), -1, 3)).to(sdf.bounds)
        distance = sdf.distance(local)
        row, which = (distance < 0).nonzero(as_tuple=True)
        gradient = sdf(local[row, which]).gradient.to(poses)
    gradient = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    outward = (gradient[:, None] @ back[row, :3, :3])[:, 0]
    level = outward[:, :2].norm(dim=-1)
    kept = level > _LEVEL
    depth = torch.zeros(distance.shape, dtype=poses.dtype)
    row, which, outward = row[kept], which[kept], outward[kept]
    depth[row, which] = -distance[row, which].to(poses)
    directions = poses.new_zeros(*distance.shape, 2)
    directions[row, which] = -outward[:, :2] / level[kept, None]
    most, index = depth.max(-1)
    found = (most > 0).nonzero()[:, 0]
    return found, most[found], directions[found, index[found]], points[index[found]]
