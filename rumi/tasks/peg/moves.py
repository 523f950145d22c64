"""What the robot may do: twelve ways to press on a side of the block, and how it gets there."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.information.contact_gain import ContactKind, Outcomes
from rumi.tasks.peg.settings import PegSettings
from sdf.sweep import Sweep, sweep_rectangle, turned
from sensors.touch.rectangle_touch import way_clearances

_ALONG = (-0.7, 0.0, 0.7)
"""Places on each side, from its middle to its ends: twelve in all (time allocation, Fig. 3)."""


class Press(NamedTuple):
    """Where to press on the block at a pose, side by side.

    Attributes:
        standoff: (12, 2), where the ball's centre begins, in front of the side.
        target: (12, 2), where it ends at the latest, behind where the side is thought to be.
    """

    standoff: Float[Tensor, "A 2"]
    target: Float[Tensor, "A 2"]


@dataclass(frozen=True)
class Motion:
    """A way of the ball's centre to a touch.

    Attributes:
        path: (K, 3), metres, the tip's place first, each point a rest.
        direct: whether it stays low all along.
    """

    path: Float[Tensor, "K 3"]
    direct: bool


def presses(pose: Float[Tensor, "3"], settings: PegSettings) -> Press:
    """The twelve ways to press on the block at a pose, from its sides' normals."""
    half = settings.block.half()
    places, normals = [], []
    for axis in (0, 1):
        for sign in (1.0, -1.0):
            for share in _ALONG:
                at, out = half.new_zeros(2), half.new_zeros(2)
                at[axis], at[1 - axis] = sign * half[axis], share * half[1 - axis]
                out[axis] = sign
                places.append(at)
                normals.append(out)
    turn = turned(pose[2])
    at = torch.stack(places) @ turn.mT + pose[:2]
    out = torch.stack(normals) @ turn.mT
    radius = settings.radius_m
    return Press(at + (radius + settings.standoff_m) * out, at + (radius - settings.beyond_m) * out)


def motions(
    pose: Float[Tensor, "3"],
    tip: Float[Tensor, "3"],
    away: Float[Tensor, "2"] | None,
    poses: Float[Tensor, "N 3"],
    log_weights: Float[Tensor, "N"],
    settings: PegSettings,
) -> list[Motion]:
    """The twelve motions for a pose: straight there where that is very likely clear, over the top else.

    Args:
        pose: (x, y, yaw) that candidates are made for.
        tip: where the ball's centre is.
        away: normal of the side that it rests against, None where it rests against none.
        poses: of the particles.
        log_weights: of them.
        settings: of the task.
    """
    press = presses(pose, settings)
    low, lift = settings.low_m, settings.lift_m
    is_low = abs(float(tip[2]) - low) < 1e-6
    begin = tip[:2] if away is None else tip[:2] + settings.retreat_m * away
    clear = direct_ways(begin, press, poses, log_weights, settings) if is_low else torch.zeros(12, dtype=torch.bool)
    found = []
    for number, (standoff, target) in enumerate(zip(press.standoff, press.target, strict=True)):
        if bool(clear[number]):
            flat = [begin, standoff, target] if away is not None else [standoff, target]
            path = [tip, *(_at(place, low) for place in flat)]
        else:
            over = [_at(tip[:2], lift), _at(standoff, lift), _at(standoff, low), _at(target, low)]
            path = [tip, *over]
        found.append(Motion(torch.stack(path), bool(clear[number])))
    return found


def direct_ways(
    begin: Float[Tensor, "2"],
    press: Press,
    poses: Float[Tensor, "N 3"],
    log_weights: Float[Tensor, "N"],
    settings: PegSettings,
) -> Bool[Tensor, "A"]:
    """Whether the straight way to each standoff is clear of the block with the probability that is asked for."""
    ways = torch.stack((begin.expand_as(press.standoff), press.standoff), 1)
    gap = way_clearances(poses, settings.block.half(), ways)
    chance = ((gap > settings.radius_m).to(poses) * log_weights.softmax(-1)).sum(-1)
    return chance >= settings.clear


def outcomes(motion: Motion, poses: Float[Tensor, "N 3"], settings: PegSettings) -> Outcomes:
    """What a motion leads to for the block at each pose: on its way there, coming down, or pressing; or nothing."""
    half, radius = settings.block.half(), settings.radius_m
    points = motion.path[:, :2]
    felt = sweep_rectangle(poses, half, points[-2], points[-1], radius)
    if motion.direct:
        # the retreat, if there is one, meets nothing
        first = sweep_rectangle(poses, half, points[-3], points[-2], radius)
        parts = (torch.where(first.hit.view(-1, *[1] * (a.dim() - 1)), a, b) for a, b in zip(first, felt, strict=True))
        return Outcomes.of(Sweep(first.hit | felt.hit, *list(parts)[1:]))
    on_top = way_clearances(poses, half, points[-2].expand(1, 2, 2))[0] < radius
    plain = Outcomes.of(felt)
    place = points[-2].expand_as(plain.point)
    kind = torch.where(on_top, ContactKind.TOP, plain.kind * ContactKind.TOUCH)
    return Outcomes(kind, torch.where(on_top[:, None], place, plain.point), plain.normal)


def _at(place: Float[Tensor, "2"], height: float) -> Float[Tensor, "3"]:
    return torch.cat((place, place.new_tensor([height])))
