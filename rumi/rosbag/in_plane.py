"""Readings of a recording of an upright object: judged in the plane, touched no higher than the object is."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.tasks.rummage.agent import Rummager
from sensors.log.reader import Taken
from sensors.reading import Reading
from sensors.semantics import Semantics

_LEVEL_M = 0.002  # by which heights may differ and be of one floor
_UPRIGHT = math.cos(math.radians(10.0))  # of a tracked object that stands


def in_plane(taken: Sequence[Taken], rummager: Rummager) -> list[Taken]:
    """The readings of an object that is followed in the plane.

    Trackers and tools seldom agree on heights to the millimetre, and what stands on the floor is neither higher nor
    lower: a true pose that is upright is put on the floor. What a tool above the object feels is no touch of it.

    Args:
        taken: readings with true poses.
        rummager: that follows them.
    """
    if not rummager.upright or rummager.tool.spatial:
        return list(taken)
    return [
        replace(one, reading=_without_higher(one.reading, rummager), truth=_standing(one.truth, rummager.height_m))
        for one in taken
    ]


def _standing(truth: Float[Tensor, "4 4"] | None, height_m: float) -> Float[Tensor, "4 4"] | None:
    if truth is None or float(truth[2, 2]) < _UPRIGHT or abs(float(truth[2, 3]) - height_m) < _LEVEL_M:
        return truth
    put = truth.clone()
    put[2, 3] = height_m
    return put


def _without_higher(reading: Reading, rummager: Rummager) -> Reading:
    """The reading without touches by a tool above the object."""
    follows = rummager.filter
    if not isinstance(follows, PoseTrajectoryFilter):
        return reading
    lifted = follows.model.lifted(reading.tool_pose)
    if not bool((lifted & reading.in_contact).any()):
        return reading
    seen = reading.observation.of_class(Semantics.SURFACE)
    kept = (~(seen & lifted[reading.instant])).nonzero()[:, 0] if follows.own.lone else torch.arange(len(seen))
    return replace(
        reading,
        observation=reading.observation[kept],
        instant=reading.instant[kept],
        in_contact=reading.in_contact & ~lifted,
    )
