"""Steep contacts of a tool with objects on the floor: about which edge they turn them, and whether that edge slides.

The tool and the edge share the weight, by their levers about each other, and both rub with friction mu. Where a force
within the tool's friction cone can drag the edge along, which carries what the tool leaves of the weight, the contact
sticks and the edge slides: an object that is lifted at an overhang is drawn under the tool as it tilts. Else the edge
stands still and the tool slides on the object.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.resting import RestingPoses
from rumi.dynamics.sliding import Sliding, contact_twist, moved_by, rotated
from rumi.dynamics.tool_contact import GRAZE_M, HOOKS, Met

LEAST_M = 0.01  # lever of a lean, at least
OFF_M = 0.001  # distance of an edge from below the centre of mass, at least
STICKS = 10.0  # friction of a contact that sticks
SHARE = 0.5  # lever of a steep contact about an edge, of the weight's, at least: a tool presses with twice the weight
EDGE = 0.5  # lever of an edge's friction over that of what rests flat


class Levers(NamedTuple):
    """What a steep contact of E objects does about K edges.

    Attributes:
        lifts: (E, K), metres that the contact goes inward for each radian of tilt.
        arm: (E, K), lever of its force with friction over the weight's.
        drag: (E, K), metres that the tool goes outward.
        outward: (E, K, 2), of each edge, unit, world frame.
    """

    lifts: Float[Tensor, "E K"]
    arm: Float[Tensor, "E K"]
    drag: Float[Tensor, "E K"]
    outward: Float[Tensor, "E K 2"]


def levers(
    rests: RestingPoses,
    planar: Float[Tensor, "E 3"],
    lying: Float[Tensor, "E 3"],
    met: Met,
    friction: Float[Tensor, "E"],
    way: Float[Tensor, "2"],
) -> Levers:
    """Those of the contacts that a tool has after a way in the plane."""
    edges, rest = rests.edges, lying[:, 0].long()
    normal, point = edges.normal[rest], edges.point[rest]
    off = ((point - rests.centre[rest][:, None]) * normal).sum(-1).clamp_min(OFF_M)
    outward = rotated(normal, planar[:, None, 2])
    corner = planar[:, None, :2] + rotated(point, planar[:, None, 2])
    beyond = ((met.at[:, None, :2] - corner) * outward).sum(-1)
    along = (outward * met.normal[:, None, :2]).sum(-1)
    drag = outward @ way
    high, down = met.at[:, 2:], met.normal[:, 2:]
    lifts = high * along - beyond * down
    rubs = friction[:, None] * drag / way.norm().clamp_min(1e-12)
    # friction holds a force that lifts upright, as far as it goes
    level = met.normal[:, :2].norm(dim=-1, keepdim=True)
    slope = (level / down.clamp_min(1e-9) - friction[:, None]).clamp_min(0.0) / level.clamp_min(1e-9)
    arm = torch.where(down > 0, high * slope * along - beyond, lifts + high * rubs)
    return Levers(lifts, arm / off, drag, outward)


def steeper(met: Met) -> Bool[Tensor, "E"]:
    """Whether a steep contact counts, and not the level one: what lifts takes along what is beside it."""
    return met.steep > torch.where(met.normal[:, 2] > 0, HOOKS, 1.0) * met.depth


def levered(
    rests: RestingPoses,
    planar: Float[Tensor, "E 3"],
    lying: Float[Tensor, "E 3"],
    met: Met,
    friction: Float[Tensor, "E"],
    way: Float[Tensor, "2"],
) -> tuple[Int[Tensor, "E"], Float[Tensor, "E"], Float[Tensor, "E"], Float[Tensor, "E 2"]]:
    """Edge about which a steep contact turns objects at rest (-1: none), and how.

    Returns:
        the edge; the tilt by which the tool drags what it presses on over it; metres that the contact goes inward for
        each radian of tilt, 0 where it drags; the way over the edge.
    """
    lifts, arm, drag, outward = levers(rests, planar, lying, met, friction, way)
    steep, high = met.steep[:, None], met.at[:, 2:].clamp_min(LEAST_M)
    lifting = (lifts > LEAST_M) & steeper(met)[:, None]
    dragged = (lifts <= LEAST_M) & (steep > -GRAZE_M) & (met.depth[:, None] <= 0) & (met.normal[:, 2:] < 0) & (drag > 0)
    can = (lifting | dragged) & (arm > SHARE) & rests.edges.tip_rad[lying[:, 0].long()].isfinite()
    most, edge = torch.where(can, arm, torch.full_like(arm, -torch.inf)).max(-1)
    tilt, lifts = torch.where(lifting, 0.0, drag / high), torch.where(lifting, lifts, 0.0)
    rows = torch.arange(len(edge))
    return torch.where(most > 0, edge, -1), tilt[rows, edge], lifts[rows, edge], outward[rows, edge]


def lifted(
    rests: RestingPoses,
    planar: Float[Tensor, "E 3"],
    lying: Float[Tensor, "E 3"],
    met: Met,
    lifts: Float[Tensor, "E"],
    before: Float[Tensor, "4"],
    after: Float[Tensor, "4"],
    body: Sliding,
) -> tuple[Float[Tensor, "E 3"], Float[Tensor, "E"]]:
    """Places and tilts of objects that a steep contact turns about their edges.

    Args:
        rests: resting poses.
        planar: (x, y, yaw) of each.
        lying: resting pose, edge and tilt.
        met: the contact.
        lifts: metres that it goes inward for each radian of tilt, above 0.
        before: (x, y, yaw, z) of the tool.
        after: the same, after the motion.
        body: friction and sliding of each.
    """
    edges, rest, edge = rests.edges, lying[:, 0].long(), lying[:, 1].long()
    normal, point, tip = edges.normal[rest, edge], edges.point[rest, edge], edges.tip_rad[rest, edge]
    outward, high, friction = rotated(normal, planar[:, 2]), met.at[:, 2], body.friction
    arm = met.at[:, :2] - planar[:, :2] - rotated(point, planar[:, 2])
    within = -(arm * outward).sum(-1)
    lever = torch.where(within.abs() > LEAST_M, within, LEAST_M)
    # where the contact goes if it sticks, and what of that the tilt leaves to the edge
    off = met.at[:, :2] - after[:2]
    level = met.at[:, :2] - before[:2] - rotated(off, (before[2] - after[2]).expand(len(off)))
    way = torch.cat((level, (after[3] - before[3]).expand(len(off), 1)), -1)
    way = way + (met.steep - (way * met.normal).sum(-1))[:, None] * met.normal
    turn = way[:, 2] / lever
    slip = way[:, :2] - (high * turn)[:, None] * outward
    # the tool carries a share of the weight, the edge the rest, which rubs against its way
    apart = ((point - rests.centre[rest]) * normal).sum(-1).clamp_min(OFF_M)
    apart = apart * (tip - lying[:, 2]).clamp_min(0.0).sin() / tip.sin().clamp_min(LEAST_M)
    rub = torch.where((slip * outward).sum(-1) > 0, friction, -friction)
    balance = lever - rub * high
    carried = torch.where(balance.abs() > 1e-9, (apart - rub * high) / balance, torch.inf)
    pull, into = rub * (1.0 - carried), (outward * met.normal[:, :2]).sum(-1)
    pressed, rubbed = pull * into + carried * met.normal[:, 2], (pull * met.normal[:, 2] - carried * into).abs()
    sticks = (within.abs() > LEAST_M) & (carried < 1.0) & (rubbed <= friction * pressed)
    ahead = slip / slip.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    twist = contact_twist(arm, ahead, slip, EDGE * body.lever, torch.full_like(friction, STICKS))
    slid = torch.where(sticks[:, None], moved_by(planar, twist, point), planar)
    return slid, lying[:, 2] + torch.where(sticks, turn, met.steep / lifts)
