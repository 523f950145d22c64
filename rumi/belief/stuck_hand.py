"""Stuck hand: a log-likelihood ratio by how often the very same points of its pads feel, wherever it goes.

What touches an object for a while feels it with other points of its pads as soon as it has moved some millimetres: of
490 pairs of instants of simulated mugs, drills and boxes, between which what felt went 2 mm or more, 22 have the same
points. A sensor that is stuck repeats them. How often one that is right does is learnt from the actions of the run in
which it felt nothing at some instant, so that few or large taxels raise no alarm for long.
"""

import math
from collections.abc import Sequence

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
_COUNTED = 5  # pairs of one action that tell: a steady push may go on as it began


def log_ratio(
    readings: Sequence[Reading], model: Pushed, own: PoseTrajectorySettings, *, anywhere: float = 0.0
) -> float:
    """Log-likelihood ratio of the last action by a stuck hand, nats; -inf where it felt nothing at an instant of it.

    Args:
        readings: of the run so far; with the last instant of the action before the last one's first is compared.
        model: of the hand's pads.
        own: of the sensors.
        anywhere: log-likelihood ratio of the action where what is felt may be anywhere; a stuck hand feels there, or
            where the object is, as likely.
    """
    *earlier, last = readings
    felt, tool = felt_pads(last, model, own), last.tool_pose
    if not bool(felt.any(-1).all()):
        return -math.inf
    if earlier and bool(earlier[-1].in_contact[-1]):
        felt = torch.cat((felt_pads(earlier[-1], model, own)[-1:], felt))
        tool = torch.cat((earlier[-1].tool_pose[-1:], tool))
    same, moved = _repeated(felt, tool, model.pads)
    right, pairs = _SAME, _SAME + _OTHER
    for reading in earlier:
        if bool(reading.in_contact.any()) and not bool(reading.in_contact.all()):
            again, of = _repeated(felt_pads(reading, model, own), reading.tool_pose, model.pads)
            right, pairs = right + again, pairs + of
    chance = right / pairs
    told = min(same, _COUNTED) * math.log(_STUCK / chance)
    told += (moved - same) * math.log((1.0 - _STUCK) / (1.0 - chance))
    return told + float(np.logaddexp(0.0, anywhere)) - math.log(2.0)


def _repeated(felt: Bool[Tensor, "K m"], tool: Float[Tensor, "K 4 4"], pads: Float[Tensor, "m 3"]) -> tuple[int, int]:
    """Pairs of instants at which the same points felt, and all pairs, of those between which what felt moved."""
    same = moved = 0
    for before, after, start, end in zip(felt, felt[1:], tool.double(), tool[1:].double(), strict=False):
        if bool(before.any()) and bool(after.any()) and _went(pads[before], start, end) >= _APART_M:
            moved += 1
            same += bool((before == after).all())
    return same, moved


def _went(points: Float[Tensor, "m 3"], start: Float[Tensor, "4 4"], end: Float[Tensor, "4 4"]) -> float:
    """How far the middle of some points of the hand went."""
    middle = points.double().mean(0, keepdim=True)
    return float((se3.apply(end, middle) - se3.apply(start, middle)).norm())
