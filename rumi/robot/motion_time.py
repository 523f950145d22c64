"""Durations of motions that start and end at rest under limits on speed and acceleration."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.bounds import Checked, Positive
from sdf.check import check_shape


@dataclass(frozen=True)
class SpeedLimits(Checked):
    """Limits of a straight motion from rest to rest.

    Attributes:
        speed_m_s: v_max.
        acceleration_m_s2: a_max, of speeding up and of slowing down.
    """

    speed_m_s: Positive = 0.05
    acceleration_m_s2: Positive = 0.1


def travel_time(distance: Float[Tensor, "*b"], limits: SpeedLimits) -> Float[Tensor, "*b"]:
    """Seconds (*b) of straight motions from rest to rest (time allocation, Eqs. 9-16); none for no distance.

    The speed rises to its limit, holds, and falls; where the way is too short for that (up to v_max^2 / a_max) it rises
    and falls only.

    Args:
        distance: metres, 0 or more.
        limits: of the motion.
    """
    speed, acceleration = limits.speed_m_s, limits.acceleration_m_s2
    if bool((distance < 0).any()):
        raise ValueError(f"Expected distances of 0 or more, got {float(distance.min())}")
    long = distance / speed + speed / acceleration
    return torch.where(distance > speed**2 / acceleration, long, 2.0 * (distance / acceleration).sqrt())


def path_time(points: Float[Tensor, "*b K D"], limits: SpeedLimits) -> Float[Tensor, "*b"]:
    """Seconds (*b) of straight motions from point to point, with a rest at each: none for fewer than two points."""
    return travel_time(points.diff(dim=-2).norm(dim=-1), limits).sum(-1)


def poke_time(
    start: Float[Tensor, "*#b D"],
    standoff: Float[Tensor, "*#b D"],
    target: Float[Tensor, "*#b D"],
    approach: SpeedLimits,
    press: SpeedLimits | None = None,
) -> Float[Tensor, "*b"]:
    """Seconds (*b) of pokes: the way to in front of the surface, a rest, and the way on to the target (IV-C).

    Args:
        start: where the tool is, metres.
        standoff: in front of the surface.
        target: what the motion aims at; contact ends it there or before.
        approach: limits on the first way.
        press: on the second; the same unless given.
    """
    for name, place in (("standoff", standoff), ("target", target)):
        check_shape(name, place, "(*b, D)", last=(start.shape[-1],))
    first = travel_time((standoff - start).norm(dim=-1), approach)
    return first + travel_time((target - standoff).norm(dim=-1), press or approach)
