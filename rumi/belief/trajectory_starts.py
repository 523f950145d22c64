"""Start poses of trajectories that no view shows: draws of a prior, and of where a jump may have led.

A jump is a motion that no push model explains: a tool that drags the top of a box, a fall onto the tool, a hand. What
it did is not known, but the object was about where it was believed to be, went with the tool perhaps, may have fallen
over an edge, and rests again.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.belief.prior import PosePrior
from rumi.belief.pushed_model import Pushed
from rumi.dynamics.resting import RestingPoses
from rumi.dynamics.sliding import rotated
from rumi.seeding import normal, uniform
from sdf import se3
from sdf.so3 import wrap

KNOCKS = ((0.004, 0.06), (0.015, 0.25), (0.04, 0.8))
"""Deviations of a jump, one of which it has: metres along each level axis, radians of the turn."""

_FALLS, _GOES, _LEANS = 0.5, 0.7, 0.4  # shares that fall over an edge, that go with the tool, and that lean on it
_NATS, _NATS_AN_INSTANT = (
    12.0,
    2.4,
)  # by which readings of an action with contact are unlikely at the true poses, at most
_NARROW_M, _NARROW_RAD = 0.012, 0.2  # deviations of place and yaw up to which poses are about one
_STEPS, _FARTHEST_M, _LEVEL = 2, 0.08, 0.5  # of the way of a surface to a felt point


def from_prior(prior: PosePrior, count: int, random: torch.Generator) -> Float[Tensor, "count 6"]:
    """Draws of poses (x, y, yaw, way of resting, no edge, no tilt)."""
    share = torch.rand(count, 2, generator=random, dtype=torch.float64)
    place = prior.mean.double() + prior.spread_m * normal((count, 2), generator=random, dtype=torch.float64)
    way = (share[:, 1] * len(prior.ways)).floor().clamp_max(len(prior.ways) - 1.0)
    yaw = math.pi * (2.0 * share[:, 0] - 1.0)
    if prior.yaw is not None:
        yaw = wrap(prior.yaw[0] + prior.yaw[1] * normal((count,), generator=random, dtype=torch.float64))
    return torch.cat((place, torch.stack((yaw, way, 0.0 * way - 1.0, 0.0 * way), -1)), -1)


def jumped(
    rests: RestingPoses,
    poses: Float[Tensor, "N 6"],
    way: Float[Tensor, "2"],
    *,
    generator: torch.Generator,
    held: bool = False,
) -> Float[Tensor, "N 6"]:
    """Poses after a jump each.

    Args:
        rests: resting poses of the object.
        poses: (x, y, yaw, resting pose, edge it leans about, tilt) before it.
        way: of the tool while it touched, metres.
        generator: of the draws.
        held: whether the tool touches still, so that some lean on it.
    """
    count, edges = len(poses), rests.edges
    share = uniform((4, count), generator=generator, dtype=torch.float64)
    planar, rest = poses[:, :3].clone(), poses[:, 3].long()
    edge = _edge(edges.tip_rad[rest], share[1])
    over = (share[0] < _FALLS) & (edge >= 0)
    change = edges.change[rest, edge.clamp_min(0)]
    change = torch.cat((rotated(change[:, :2], planar[:, 2]), change[:, 2:]), -1)
    planar += torch.where(over[:, None], change, 0.0)
    rest = torch.where(over, edges.next[rest, edge.clamp_min(0)], rest)
    planar[:, :2] += torch.where(share[2] < _GOES, share[2] / _GOES, 0.0)[:, None] * way
    scale = planar.new_tensor([(m, m, rad) for m, rad in KNOCKS])[(share[3] * len(KNOCKS)).long()]
    planar += scale * normal(scale.shape, generator=generator, dtype=torch.float64)
    lying = at_rest(planar, rest)
    if held:
        share = uniform((3, count), generator=generator, dtype=torch.float64)
        tip = edges.tip_rad[rest]
        edge = _edge(tip, share[1])
        leans = (share[0] < _LEANS) & (edge >= 0)
        tilt = share[2] * tip.gather(-1, edge.clamp_min(0)[:, None])[:, 0]
        lying[:, 4:] = torch.where(leans[:, None], torch.stack((edge.to(tilt), tilt), -1), lying[:, 4:])
    return lying


def jittered(poses: Float[Tensor, "N 6"], *, generator: torch.Generator) -> Float[Tensor, "N 6"]:
    """Poses moved about by the least of `KNOCKS`."""
    scale = poses.new_tensor((KNOCKS[0][0], KNOCKS[0][0], KNOCKS[0][1]))
    moved = poses[:, :3] + scale * normal((len(poses), 3), generator=generator, dtype=torch.float64)
    return torch.cat((moved, poses[:, 3:]), -1)


def at_rest(planar: Float[Tensor, "N 3"], rest: Int[Tensor, "N"]) -> Float[Tensor, "N 6"]:
    """Poses that lean on nothing."""
    none = torch.zeros_like(planar[:, 0])
    return torch.cat((planar, torch.stack((rest.to(planar), none - 1.0, none), -1)), -1)


def brought_to(
    model: Pushed, poses: Float[Tensor, "N D"], points: Float[Tensor, "N 3"], apart_m: float
) -> Float[Tensor, "N D"]:
    """Poses shifted along the floor until a point of each is a distance from its surface, by Newton's method.

    Where the surface that is nearest faces up or down, and for points too far off, they stay as they are.
    """
    poses = poses.clone()
    for _ in range(_STEPS):
        world = model.world_T_object(poses)
        local = se3.apply(se3.inverse(world), points[:, None])[:, 0]
        with torch.no_grad():
            found = model.sdf(local.to(model.sdf.bounds))
        outward = (world[:, :3, :3] @ found.gradient.to(poses)[:, :, None])[:, :2, 0]
        size, way = outward.norm(dim=-1), found.distance.to(poses) - apart_m
        meant = (size > _LEVEL) & (way.abs() < _FARTHEST_M)
        step = torch.where(meant, way / size.clamp_min(_LEVEL).square(), 0.0)
        poses[:, :2] += step[:, None] * outward
    return poses


def least_fit(instants: int) -> float:
    """Log-likelihood of an action's readings below which what is believed is not what happened.

    At the true poses of simulated boxes and drills they are above it (results/push_models.md).

    Args:
        instants: of contact in it.
    """
    return -(_NATS + _NATS_AN_INSTANT * instants)


def is_narrow(poses: Float[Tensor, "N 6"]) -> bool:
    """Whether poses rest in one way, at about one place and yaw."""
    if bool((poses[:, 3] != poses[0, 3]).any()) or bool((poses[:, 4] >= 0).any()):
        return False
    turn = wrap(poses[:, 2] - poses[0, 2]).std(unbiased=False)
    return float(poses[:, :2].std(0, unbiased=False).max()) < _NARROW_M and float(turn) < _NARROW_RAD


def _edge(tip_rad: Float[Tensor, "N E"], share: Float[Tensor, "N"]) -> Tensor:
    """One of the edges of each that it can topple over, by a number in [0, 1); -1 where there is none."""
    real = tip_rad.isfinite()
    many = real.sum(-1)
    wanted = (share * many).long().clamp_max(many - 1) + 1
    found = (real.cumsum(-1) == wanted[:, None]) & real
    return torch.where(many > 0, found.to(torch.uint8).argmax(-1), -1)
