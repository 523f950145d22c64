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
_LEAST_M = 0.01  # lever of a lean, at least
_PASSES, _TILTS, _HALVES = 2, 2, 5
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
    planar, lying = state[0], state[1].clone()
    count = len(planar)
    points = torch.cat((rotated(tool[:, :2], after[2].expand(len(tool))) + after[:2], tool[:, 2:] + after[3]), -1)
    slid, fell = (torch.zeros(count, dtype=torch.bool) for _ in range(2))
    ahead = planar.new_zeros(count, 2)
    scene = _Scene(sdf, rests, points)
    # what leans on the tool goes with it; what that leaves is as it rests
    leaning = (lying[:, 1] >= 0).nonzero()[:, 0]
    if len(leaning):
        lying[leaning], ahead[leaning] = _leant(scene, planar[leaning], lying[leaning])
    free = (lying[:, 1] < 0).nonzero()[:, 0]
    row, depth, inward, place = _deepest(scene, planar[free], lying[free])
    found = free[row]
    if len(found):
        ahead[found] = inward
        about, off, rate = _edge_ahead(rests, planar[found], lying[found], inward)
        friction = body.friction[found]
        leans = (rate > _ACROSS) & (place[:, 2] > off * (1.0 / friction + friction))
        tips = found[leans]
        tilt = depth[leans] / (place[leans, 2] * rate[leans]).clamp_min(_LEAST_M)
        lying[tips] = torch.stack((lying[tips, 0], about[leans].to(lying), tilt), -1)
        lying[tips], _ = _leant(scene, planar[tips], lying[tips])
        slides, now = found[~leans], planar[found[~leans]]
        slid[slides] = True
        start, own, some = now, body.at(slides), torch.arange(len(slides))
        touch = depth[~leans], inward[~leans], place[~leans]
        for turn in range(_PASSES):
            if turn:
                some, depth, inward, place = _deepest(scene, now, lying[slides])
                touch = depth, inward, place
            many = len(some)
            if not many:
                break
            met_at = Touch(touch[2][:, :2], touch[1], touch[0].clamp_max(_MOST_M))
            tools = before[:3].expand(many, 3), after[:3].expand(many, 3)
            out = pushed_out(now[some], start[some], *tools, met_at, own.at(some))
            now = now.index_copy(0, some, out)
        planar = planar.index_copy(0, slides, now)
    edges, rest, edge = rests.edges, lying[:, 0].long(), lying[:, 1].long()
    over = (edge >= 0) & (lying[:, 2] >= firm * edges.tip_rad[rest, edge.clamp_min(0)])
    down = over.nonzero()[:, 0]
    if len(down):
        rest, edge = rest[down], edge[down]
        change = edges.change[rest, edge]
        moved = planar[down, :2] + rotated(change[:, :2], planar[down, 2])
        planar = planar.index_copy(0, down, torch.cat((moved, planar[down, 2:] + change[:, 2:]), -1))
        none = torch.zeros_like(change[:, 0])
        lying[down] = torch.stack((edges.next[rest, edge].to(lying), none - 1.0, none), -1)
        fell[down] = True
    return Push(Leaning(planar, lying), slid, fell, ahead)


class _Scene(NamedTuple):
    """Object's signed distances and resting poses, and points of the tool in the world."""

    sdf: SDF
    rests: RestingPoses
    points: Float[Tensor, "n 3"]


def _edge_ahead(
    rests: RestingPoses, planar: Float[Tensor, "E 3"], lying: Float[Tensor, "E 3"], inward: Float[Tensor, "E 2"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Edge ahead of a push from below the centre of mass, its distance along the push, and the cosine to its normal."""
    edges, rest = rests.edges, lying[:, 0].long()
    way = rotated(inward, -planar[:, 2])
    off = ((edges.point[rest] - rests.centre[rest][:, None]) * edges.normal[rest]).sum(-1)
    rate = (edges.normal[rest] * way[:, None]).sum(-1)
    real = edges.tip_rad[rest].isfinite() & (rate > 1e-3)
    ratio = torch.where(real, off / rate.clamp_min(1e-3), torch.full_like(rate, torch.inf))
    off, about = ratio.min(-1)
    return about, off, torch.where(off.isfinite(), rate.gather(-1, about[:, None])[:, 0], torch.zeros_like(off))


def _leant(
    scene: _Scene, planar: Float[Tensor, "E 3"], lying: Float[Tensor, "E 3"]
) -> tuple[Float[Tensor, "E 3"], Float[Tensor, "E 2"]]:
    """Tilts of objects that lean on the tool where it is now, and the direction over their edges; rests where it left.

    From the tilt before: at rest the tool may be so deep in it that the way out is on the other side.
    """
    edges, lying = scene.rests.edges, lying.clone()
    outward = rotated(edges.normal[lying[:, 0].long(), lying[:, 1].long()], planar[:, 2])
    touched = torch.zeros(len(planar), dtype=torch.bool)
    for _ in range(_TILTS):
        row, depth, inward, place = _deepest(scene, planar, lying)
        touched[row] = True
        along = (inward * outward[row]).sum(-1)
        more = torch.where(along > _ACROSS, depth / (place[:, 2] * along).clamp_min(_LEAST_M), 0.0 * depth)
        lying[row, 2] += more
    left = (~touched).nonzero()[:, 0]
    if len(left):
        low, high = torch.zeros_like(lying[left, 2]), lying[left, 2]
        for turn in range(_HALVES):
            middle = low if turn == 0 else 0.5 * (low + high)
            tried = torch.cat((lying[left, :2], middle[:, None]), -1)
            held = torch.zeros(len(left), dtype=torch.bool)
            held[_deepest(scene, planar[left], tried)[0]] = True
            low, high = torch.where(held, middle, low), torch.where(held, high, middle)
        gone = high <= 0.0
        edge = torch.where(gone, -torch.ones_like(high), lying[left, 1])
        lying[left] = torch.stack((lying[left, 0], edge, high), -1)
    return lying, outward


def _deepest(
    scene: _Scene, planar: Float[Tensor, "E 3"], lying: Float[Tensor, "E 3"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Objects that the tool is in sideways: which, how deep, the level normal into them, and the point of the tool."""
    sdf, rests, points = scene
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
