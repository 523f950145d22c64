"""Stuck hand: a log-likelihood ratio by how often the very same points of its pads feel, wherever it goes.

What touches an object for a while feels it with other points of its pads as soon as it has moved some millimetres: of
490 pairs of instants of simulated mugs, drills and boxes, between which what felt went 2 mm or more, 22 have the same
points. A sensor that is stuck repeats them. How often one that is right does is learnt from the actions of the run in
which it felt nothing at some instant, so that few or large taxels raise no alarm for long.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.pushed_model import Pushed
from rumi.belief.segments import felt_pads
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from sdf import se3
from sensors.reading import Reading

_STUCK = 0.99  # chance that the same points feel again, of a hand that is stuck
_SAME, _OTHER = 1.0, 9.0  # pairs of a hand that is right which the run begins with: the same points, and others
_APART_M = 0.002  # that they moved meanwhile: what stands still feels the same
_COUNTED = 3  # pairs of one push that tell: a steady one may go on as it began, and is no alarm by itself
_TURNED = 0.5  # cosine between the ways of two actions below which the second is no more of the first's push


class Told(NamedTuple):
    """What an action tells of a stuck hand, log-likelihood ratios in nats.

    Attributes:
        repeated: by how often it repeated itself; 0 without a pair of instants to compare, -inf where it felt nothing
            at an instant.
        ratio: that, and by where what it felt is.
    """

    repeated: float
    ratio: float


def told_by(readings: Sequence[Reading], model: Pushed, own: PoseTrajectorySettings, *, anywhere: float = 0.0) -> Told:
    """What the last action tells of a stuck hand.

    Args:
        readings: of the run so far. The action's first instant is compared with the last one before it, too.
        model: of the hand's pads.
        own: of the sensors.
        anywhere: log-likelihood ratio of the action where what is felt may be anywhere; a stuck hand feels there, or
            where the object is, as likely.
    """
    *earlier, last = readings
    felt, tool = felt_pads(last, model, own), last.tool_pose
    if not bool(felt.any(-1).all()):
        return Told(-math.inf, -math.inf)
    if earlier and bool(earlier[-1].in_contact[-1]):
        felt = torch.cat((felt_pads(earlier[-1], model, own)[-1:], felt))
        tool = torch.cat((earlier[-1].tool_pose[-1:], tool))
    same, moved = _repeated(felt, tool, model.pads)
    if not moved:
        return Told(0.0, 0.0)
    right, pairs = _SAME, _SAME + _OTHER
    for reading in earlier:
        if bool(reading.in_contact.any()) and not bool(reading.in_contact.all()):
            again, of = _repeated(felt_pads(reading, model, own), reading.tool_pose, model.pads)
            right, pairs = right + again, pairs + of
    chance = right / pairs
    counted = min(_COUNTED, _pairs_of_push(readings, model, own))
    told = min(same, _COUNTED - counted) * math.log(_STUCK / chance)
    told += (moved - same) * math.log((1.0 - _STUCK) / (1.0 - chance))
    return Told(told, told + float(np.logaddexp(0.0, anywhere)) - math.log(2.0))


def _pairs_of_push(readings: Sequence[Reading], model: Pushed, own: PoseTrajectorySettings) -> int:
    """Pairs with the same points in the push that the last action goes on with, before that action."""
    first = len(readings) - 1
    while first and bool(readings[first].in_contact.all() & readings[first - 1].in_contact[-1]):
        if _turns(readings, first):
            break
        first -= 1
    push = readings[first:-1]
    if not push:
        return 0
    silent = (~torch.cat([reading.in_contact for reading in push])).nonzero()[:, 0]
    begun = int(silent[-1]) + 1 if len(silent) else 0
    felt = torch.cat([felt_pads(reading, model, own) for reading in push])[begun:]
    return _repeated(felt, torch.cat([reading.tool_pose for reading in push])[begun:], model.pads)[0]


def _turns(readings: Sequence[Reading], number: int) -> bool:
    """Whether an action goes another way than the one before it."""
    start = readings[number - 2].tool_pose[-1] if number > 1 else readings[0].tool_pose[0]
    places = [pose[:3, 3].double() for pose in (start, *(each.tool_pose[-1] for each in readings[number - 1 :][:2]))]
    ways = places[1] - places[0], places[2] - places[1]
    return float(torch.nn.functional.cosine_similarity(*ways, dim=0)) < _TURNED


def _repeated(felt: Bool[Tensor, "K m"], tool: Float[Tensor, "K 4 4"], pads: Float[Tensor, "m 3"]) -> tuple[int, int]:
    """Pairs of instants at which the same points felt, and all pairs; each from the last one that what felt moved off.

    Instants may lie close together: each is compared with the last one from which what felt there has moved far enough.
    """
    same = moved = 0
    last: int | None = None
    for now in range(len(felt)):
        if not bool(felt[now].any()):
            last = None
        elif last is None:
            last = now
        elif _went(pads[felt[last]], tool[last].double(), tool[now].double()) >= _APART_M:
            moved += 1
            same += bool((felt[last] == felt[now]).all())
            last = now
    return same, moved


def _went(points: Float[Tensor, "m 3"], start: Float[Tensor, "4 4"], end: Float[Tensor, "4 4"]) -> float:
    """How far the middle of some points of the hand went."""
    middle = points.double().mean(0, keepdim=True)
    return float((se3.apply(end, middle) - se3.apply(start, middle)).norm())
