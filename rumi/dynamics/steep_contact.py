"""What a steep contact of an object on the floor does: the edges that it can turn about, and which gives way first.

The tool is on top of the object or below a part that juts out. With its friction mu it turns the object about the edge
for which that takes the least force, where that is at most twice the weight W. From below it either slips along the
surface, about an edge that stays, or what it carries stays on it, and the edge slides on the floor instead, towards it:
what is up there would go back over the edge otherwise. Moments about the edge and friction mu of what the edge bears
give the force then: (d + mu h) / (l + mu h) W up and mu times the rest of W away from the edge, against the foot's
friction, for a mass d and a tool l from the edge, at the height h. It holds within the friction cone.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.resting import RestingPoses
from rumi.dynamics.sliding import rotated
from rumi.dynamics.tool_contact import GRAZE_M, Met

LEAST_M = 0.01  # lever of a lean, at least
OFF_M = 0.001  # distance of an edge from below the centre of mass, at least
RISES = 0.1  # share of the tool's way that goes up, from which on it may carry an object
SHARE = 0.5  # lever of a steep contact about an edge, of the weight's, at least: a tool presses with twice the weight


class Levers(NamedTuple):
    """What a steep contact of E objects does about K edges.

    Attributes:
        lifts: (E, K), metres that the contact goes inward for each radian of tilt.
        arm: (E, K), lever of its force with friction over the weight's.
        drag: (E, K), metres that the tool goes outward.
        outward: (E, K, 2), of each edge, unit, world frame.
        carries: (E, K), whether the tool that rises takes the contact along, so that the edge slides on the floor.
        carried: (E, K), radians that it tilts then.
        slides: (E, K), metres that the edge goes outward then.
    """

    lifts: Float[Tensor, "E K"]
    arm: Float[Tensor, "E K"]
    drag: Float[Tensor, "E K"]
    outward: Float[Tensor, "E K 2"]
    carries: Bool[Tensor, "E K"]
    carried: Float[Tensor, "E K"]
    slides: Float[Tensor, "E K"]


def levers_of(
    rests: RestingPoses,
    planar: Float[Tensor, "E 3"],
    lying: Float[Tensor, "E 3"],
    met: Met,
    friction: Float[Tensor, "E"],
    way: Float[Tensor, "3"],
) -> Levers:
    """Levers of steep contacts about all edges.

    Args:
        rests: resting poses, and their edges.
        planar: (x, y, yaw) of each object.
        lying: resting pose, edge that it leans about, and tilt.
        met: of the tool where it is now.
        friction: of floor and tool.
        way: (x, y, z) that the tool went.
    """
    edges, rest = rests.edges, lying[:, 0].long()
    normal, point = edges.normal[rest], edges.point[rest]
    off = ((point - rests.centre[rest][:, None]) * normal).sum(-1).clamp_min(OFF_M)
    outward = rotated(normal, planar[:, None, 2])
    corner = planar[:, None, :2] + rotated(point, planar[:, None, 2])
    beyond = ((met.at[:, None, :2] - corner) * outward).sum(-1)
    along = (outward * met.normal[:, None, :2]).sum(-1)
    drag = outward @ way[:2]
    high, rise = met.at[:, 2:], met.normal[:, 2:]
    lifts = high * along - beyond * rise
    friction, into = friction[:, None], (met.normal @ way)[:, None]
    # slips: the tool rubs along its way; from below, against what of that and of the object's turn is along the surface
    across = high * rise + beyond * along
    rubs = high * drag / way[:2].norm().clamp_min(1e-12)
    below = (rise > 0) & (lifts > LEAST_M)
    turns = across * into / lifts.clamp_min(LEAST_M)
    rubs = torch.where(below, across * (drag * rise - way[2] * along - turns).sign(), rubs)
    arm = (lifts + friction * rubs) / off
    # holds: the edge slides towards the tool; moments about it, and it bears what the tool does not
    up = (off + friction * high) / (friction * high - beyond).clamp_min(LEAST_M)
    back = friction * (1.0 - up)
    presses = up * rise - back * along
    carries = presses * (1.0 + friction * friction).sqrt() > torch.hypot(up, back)
    carries &= (up < 1.0) & (beyond < 0) & (rise > 0) & (into > 0) & (met.steep > met.depth)[:, None]
    carries &= (-beyond * drag < high * way[2]) & (way[2] > RISES * way.norm())  # towards the tool, which rises
    arm = torch.where(carries, 1.0 / presses.clamp_min(1e-6), arm)
    share = (met.steep.clamp_min(0.0)[:, None] / into.clamp_min(1e-12)).clamp_max(1.0)
    carried = share * way[2] / (-beyond).clamp_min(LEAST_M)
    return Levers(lifts, arm, drag, outward, carries, carried, share * drag - high * carried)


def levered(
    rests: RestingPoses,
    planar: Float[Tensor, "E 3"],
    lying: Float[Tensor, "E 3"],
    met: Met,
    friction: Float[Tensor, "E"],
    way: Float[Tensor, "3"],
) -> tuple[Int[Tensor, "E"], Float[Tensor, "E"], Float[Tensor, "E 2"], Float[Tensor, "E"]]:
    """Edge about which a steep contact turns objects at rest (-1: none), and the tilt.

    Then the direction over that edge, and how far the edge slides that way.
    """
    lifts, arm, drag, outward, carries, carried, slides = levers_of(rests, planar, lying, met, friction, way)
    steep, high = met.steep[:, None], met.at[:, 2:].clamp_min(LEAST_M)
    lifted = ((lifts > LEAST_M) | carries) & (steep > met.depth[:, None])
    dragged = (lifts <= LEAST_M) & (steep > -GRAZE_M) & (met.depth[:, None] <= 0) & (met.normal[:, 2:] < 0) & (drag > 0)
    can = (lifted | dragged) & (arm > SHARE) & rests.edges.tip_rad[lying[:, 0].long()].isfinite()
    most, edge = torch.where(can, arm, torch.full_like(arm, -torch.inf)).max(-1)
    tilt = torch.where(lifted, steep.clamp_min(0.0) / lifts.clamp_min(LEAST_M), drag / high)
    tilt, slides = torch.where(carries, carried, tilt), torch.where(carries, slides, torch.zeros_like(tilt))
    rows = torch.arange(len(edge))
    return torch.where(most > 0, edge, -1), tilt[rows, edge], outward[rows, edge], slides[rows, edge]
