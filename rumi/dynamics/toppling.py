"""Quasi-static pushing of an object that may topple, by a tool that moves in space: slide, lean on the tool, fall.

What the tool meets sideways moves out of its way. With friction mu at floor and tool, a push at the height h slides the
object while that takes less force than to lift it about the edge ahead, which is s away from the centre of mass:
h < s (1/mu + mu). Else it leans about that edge by the tilt that the tool asks for, and back as the tool goes. With the
centre of mass beyond the edge it falls as a pendulum does, slowly at first, and then is as it comes to rest.

A *steep* contact, the tool on top of it or below a part that juts out, turns it about the edge for which that takes
the least force, where that is little more than its weight: pressed down beyond the edge, lifted within it, or dragged
along by friction near it; behind the edge it rises as far as the tool above lets it. What is pressed down elsewhere
stays, or goes along with the tool. Lifted, what is high up would go back over the edge, along the tool that carries it:
where the tool carries so much that its friction holds, the edge slides below it instead, towards the tool.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.resting import RestingPoses
from rumi.dynamics.sliding import Sliding, Touch, contact_twist, moved_by, pushed_out, rotated
from rumi.dynamics.steep_contact import LEAST_M, OFF_M, SHARE, levered, levers_of
from rumi.dynamics.tool_contact import GRAZE_M, Met, Scene, met_by
from sdf.base import SDF

MOST_M = 0.012  # that one contact moves an object, at most
PASSES, TILTS, HALVES = 2, 2, 5
ACROSS = 0.3  # cosine to the edge's normal below which a push does not lean on it
INSTANT_S = 0.05  # duration of a motion
RATE = 0.5  # rad/s at which a fall begins: a tool that goes 8 cm in a second, 16 cm above the floor
LANDS_RAD = 0.35  # into a fall, from when on it is as it comes to rest
SWINGS = 0.75 * 9.81  # m/s^2 over the distance of mass from edge: square of a thin rod's rate of falling
STICKS = 10.0  # friction of a contact that sticks


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
    soft: Float[Tensor, "E"],
    grip: Float[Tensor, "E"],
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
        soft: how far the tool goes into each from above before that keeps it from rising, metres.
        grip: share of the tool's way that the top of each goes along where it is pressed on and cannot turn over.
    """
    planar, lying = state[0], state[1].clone()
    count = len(planar)
    points = torch.cat((rotated(tool[:, :2], after[2].expand(len(tool))) + after[:2], tool[:, 2:] + after[3]), -1)
    slid, fell = (torch.zeros(count, dtype=torch.bool) for _ in range(2))
    ahead = planar.new_zeros(count, 2)
    scene = Scene(sdf, rests, points)
    # what leans on the tool goes with it; what that leaves is as it rests
    limit = _limit(rests, lying, firm)
    falls = lying[:, 2] >= limit
    falling, leaning = falls.nonzero()[:, 0], ((lying[:, 1] >= 0) & ~falls).nonzero()[:, 0]
    way = (after - before)[[0, 1, 3]]
    if len(falling):
        lying[falling], ahead[falling] = _fallen(rests, planar[falling], lying[falling], limit[falling])
    if len(leaning):
        rubs = body.friction[leaning], soft[leaning]
        there, lying[leaning], ahead[leaning] = _leant(scene, planar[leaning], lying[leaning], *rubs, way)
        planar = planar.index_copy(0, leaning, there)
    free = (lying[:, 1] < 0).nonzero()[:, 0]
    met = met_by(scene, planar[free], lying[free])
    edge, tilt, outward, slides = levered(rests, planar[free], lying[free], met, body.friction[free], way)
    turns = edge >= 0
    some = free[turns]
    lying[some] = torch.stack((lying[some, 0], edge[turns].to(lying), tilt[turns]), -1)
    planar = _along(planar, some, slides[turns], outward[turns])
    lying[some] = _held_down(scene, planar[some], lying[some], body.friction[some], soft[some], way)
    ahead[some] = outward[turns]
    pushes = ~turns & (met.depth > 0)
    dragged = ~turns & ~pushes & (met.steep > -GRAZE_M) & (met.normal[:, 2] < 0) & (grip[free] > 0)
    some = free[dragged]
    if len(some):
        planar = planar.index_copy(
            0, some, _dragged(planar[some], met.at[dragged, :2], grip[some], before, after, body.at(some))
        )
        slid[some] = True
    depth, inward, place = met.depth[pushes], met.inward[pushes], met.place[pushes]
    found = free[pushes]
    if len(found):
        ahead[found] = inward
        about, off, rate = _edge_ahead(rests, planar[found], lying[found], inward)
        friction = body.friction[found]
        leans = (rate > ACROSS) & (place[:, 2] > off * (1.0 / friction + friction))
        tips = found[leans]
        tilt = depth[leans] / (place[leans, 2] * rate[leans]).clamp_min(LEAST_M)
        lying[tips] = torch.stack((lying[tips, 0], about[leans].to(lying), tilt), -1)
        there, lying[tips], _ = _leant(scene, planar[tips], lying[tips], body.friction[tips], soft[tips], way)
        planar = planar.index_copy(0, tips, there)
        pushed, now = found[~leans], planar[found[~leans]]
        slid[pushed] = True
        start, own, some = now, body.at(pushed), torch.arange(len(pushed))
        touch = depth[~leans], inward[~leans], place[~leans]
        for turn in range(PASSES):
            if turn:
                met = met_by(scene, now, lying[pushed])
                some = (met.depth > 0).nonzero()[:, 0]
                touch = met.depth[some], met.inward[some], met.place[some]
            many = len(some)
            if not many:
                break
            met_at = Touch(touch[2][:, :2], touch[1], touch[0].clamp_max(MOST_M))
            tools = before[:3].expand(many, 3), after[:3].expand(many, 3)
            out = pushed_out(now[some], start[some], *tools, met_at, own.at(some))
            now = now.index_copy(0, some, out)
        planar = planar.index_copy(0, pushed, now)
    edges, rest, edge = rests.edges, lying[:, 0].long(), lying[:, 1].long()
    down = (lying[:, 2] >= _limit(rests, lying, firm) + LANDS_RAD).nonzero()[:, 0]
    if len(down):
        rest, edge = rest[down], edge[down]
        change = edges.change[rest, edge]
        moved = planar[down, :2] + rotated(change[:, :2], planar[down, 2])
        planar = planar.index_copy(0, down, torch.cat((moved, planar[down, 2:] + change[:, 2:]), -1))
        none = torch.zeros_like(change[:, 0])
        lying[down] = torch.stack((edges.next[rest, edge].to(lying), none - 1.0, none), -1)
        fell[down] = True
    return Push(Leaning(planar, lying), slid, fell, ahead)


def _along(
    planar: Float[Tensor, "E 3"], rows: Int[Tensor, "S"], slides: Float[Tensor, "S"], outward: Float[Tensor, "S 2"]
) -> Float[Tensor, "E 3"]:
    """Poses of which some slide so far, each over its edge."""
    there = torch.cat((planar[rows, :2] + slides[:, None] * outward, planar[rows, 2:]), -1)
    return planar.index_copy(0, rows, there)


def _limit(rests: RestingPoses, lying: Float[Tensor, "E 3"], firm: Float[Tensor, "E"]) -> Float[Tensor, "E"]:
    """Tilt from which on each falls; infinite for what leans on nothing."""
    rest, edge = lying[:, 0].long(), lying[:, 1].long()
    return torch.where(edge >= 0, firm * rests.edges.tip_rad[rest, edge.clamp_min(0)], torch.inf)


def _fallen(
    rests: RestingPoses, planar: Float[Tensor, "E 3"], lying: Float[Tensor, "E 3"], limit: Float[Tensor, "E"]
) -> tuple[Float[Tensor, "E 3"], Float[Tensor, "E 2"]]:
    """What falls, a motion later, and the direction over its edge: a thin rod near the top of its swing."""
    edges, rest, edge = rests.edges, lying[:, 0].long(), lying[:, 1].long()
    normal, tip = edges.normal[rest, edge], edges.tip_rad[rest, edge]
    off = ((edges.point[rest, edge] - rests.centre[rest]) * normal).sum(-1).clamp_min(OFF_M)
    rate = (SWINGS * tip.sin().clamp_min(LEAST_M) / off).sqrt()
    into, turn = lying[:, 2] - limit, rate * INSTANT_S
    into = into * turn.cosh() + torch.hypot(into, RATE / rate) * turn.sinh()
    return torch.cat((lying[:, :2], (limit + into)[:, None]), -1), rotated(normal, planar[:, 2])


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
    scene: Scene,
    planar: Float[Tensor, "E 3"],
    lying: Float[Tensor, "E 3"],
    friction: Float[Tensor, "E"],
    soft: Float[Tensor, "E"],
    way: Float[Tensor, "3"],
) -> tuple[Float[Tensor, "E 3"], Float[Tensor, "E 3"], Float[Tensor, "E 2"]]:
    """Poses and tilts of objects that lean on the tool where it is now, and the direction over their edges.

    Rests where the tool left. From the tilt before: at rest the tool may be so deep in it that the way out is on the
    other side.
    """
    lying, rows, edge = lying.clone(), torch.arange(len(planar)), lying[:, 1].long()
    touched = torch.zeros(len(planar), dtype=torch.bool)
    outward = planar[:, :2]
    for turn in range(TILTS):
        met = met_by(scene, planar, lying)
        levers = levers_of(scene.rests, planar, lying, met, friction, way)
        lifts, arm, drag, outward, carries, carried, slides = (part[rows, edge] for part in levers)
        inside = (met.depth > 0) | (met.steep > 0)
        along, high = (met.inward * outward).sum(-1), met.at[:, 2].clamp_min(LEAST_M)
        more = torch.where(along > ACROSS, met.depth / (met.place[:, 2] * along).clamp_min(LEAST_M), 0.0 * along)
        lifted = (lifts > LEAST_M) & (met.steep > met.depth)
        more = torch.where(lifted, met.steep / lifts.clamp_min(LEAST_M), more)
        more = _back(met, lifts, soft, more)
        if turn == 0:
            dragged = (lifts <= LEAST_M) & (met.steep > -GRAZE_M) & (met.depth <= 0) & (met.normal[:, 2] < 0)
            dragged &= (drag > 0) & (arm > SHARE)
            more, inside = torch.where(dragged, drag / high, more), inside | dragged
            more = torch.where(carries, carried, more)
            planar = _along(planar, rows[carries], slides[carries], outward[carries])
        going = inside if turn == 0 else inside & touched
        lying[going, 2] += more[going]
        touched |= inside
    lying = _upright(lying)
    left = (~touched).nonzero()[:, 0]
    if len(left):
        low, high = torch.zeros_like(lying[left, 2]), lying[left, 2]
        for turn in range(HALVES):
            middle = low if turn == 0 else 0.5 * (low + high)
            tried = torch.cat((lying[left, :2], middle[:, None]), -1)
            met = met_by(scene, planar[left], tried)
            held = (met.depth > 0) | (met.steep > 0)
            low, high = torch.where(held, middle, low), torch.where(held, high, middle)
        gone = high <= 0.0
        lies = torch.where(gone, -torch.ones_like(high), lying[left, 1])
        lying[left] = torch.stack((lying[left, 0], lies, high), -1)
    return planar, lying, outward


def _dragged(
    planar: Float[Tensor, "E 3"],
    at: Float[Tensor, "E 2"],
    grip: Float[Tensor, "E"],
    before: Float[Tensor, "4"],
    after: Float[Tensor, "4"],
    body: Sliding,
) -> Float[Tensor, "E 3"]:
    """Objects of which a point of the top goes a share of the tool's way there."""
    off = at - after[:2]
    way = at - before[:2] - rotated(off, (before[2] - after[2]).expand(len(at)))
    wanted = grip[:, None] * way
    inward = wanted / wanted.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    arm = at - planar[:, :2] - rotated(body.centre, planar[:, 2])
    twist = contact_twist(arm, inward, wanted, body.lever, torch.full_like(grip, STICKS))
    return moved_by(planar, twist, body.centre)


def _back(
    met: Met, lifts: Float[Tensor, "E"], soft: Float[Tensor, "E"], tilt: Float[Tensor, "E"]
) -> Float[Tensor, "E"]:
    """Changes of tilts, less than 0 where the tool stands in the way from above: that much it lets rise."""
    deep = met.steep - soft
    pressed = (lifts < -LEAST_M) & (deep > 0) & (met.steep > met.depth)
    return torch.where(pressed, deep / lifts.clamp_max(-LEAST_M), tilt)


def _held_down(
    scene: Scene,
    planar: Float[Tensor, "E 3"],
    lying: Float[Tensor, "E 3"],
    friction: Float[Tensor, "E"],
    soft: Float[Tensor, "E"],
    way: Float[Tensor, "3"],
) -> Float[Tensor, "E 3"]:
    """Tilts as far as the tool above lets objects rise; rests where it does not."""
    lying = lying.clone()
    met = met_by(scene, planar, lying)
    lifts = levers_of(scene.rests, planar, lying, met, friction, way).lifts
    lifts = lifts[torch.arange(len(planar)), lying[:, 1].long()]
    lying[:, 2] += _back(met, lifts, soft, torch.zeros_like(lifts))
    return _upright(lying)


def _upright(lying: Float[Tensor, "E 3"]) -> Float[Tensor, "E 3"]:
    """At rest where no tilt is left."""
    rests = torch.stack((lying[:, 0], -torch.ones_like(lying[:, 1]), torch.zeros_like(lying[:, 2])), -1)
    return torch.where((lying[:, 2] > 0)[:, None], lying, rests)
