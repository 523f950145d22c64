"""What a run may be lost by: prior shares of the explanations, and what an alarm is named."""

from collections.abc import Mapping, Sequence
from typing import TypeGuard

import torch

from rumi.belief.change_test import ChangeEvidence, ChangeTest
from rumi.belief.island_filter import IslandFilter
from rumi.belief.misfit import MISFITS
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter

PRIOR: dict[str, float] = {
    "knocked": 0.25,
    "absent": 0.1,
    "dead hand": 0.1,
    "false contacts": 0.15,
    "push model off": 0.1,
    "stuck hand": 0.03,
    "second object": 0.03,
    "stale camera": 0.03,
    "none of these": 0.04,
}
"""What a run may be lost by, where particles have trajectories of their own, with the prior share of each."""

IN_SPACE: dict[str, float] = {
    "knocked": 0.25,
    "absent": 0.2,
    "dead hand": 0.2,
    "false contacts": 0.12,
    "second object": 0.08,
    "stuck hand": 0.05,
    "none of these": 0.1,
}
"""The same in space, where some particles jump as no push model has it."""

_MISFITS = dict(zip(MISFITS, (0.6, 0.25, 0.15), strict=True))

STATIC = {"hand off": 0.1, "camera off": 0.1, "another size": 0.1, "push model off": 0.05}
"""The same of faults that hold from the first view on."""

NOTHING_FELT = "absent or dead hand"
"""What an alarm is named where the object's absence and a hand that feels nothing are as probable."""

HAND_OR_CAMERA = "hand or camera off"
"""What an alarm is named where touches are beside the view, and little tells which of the two is off."""

GONE = ("absent", "dead hand", NOTHING_FELT, "stuck hand", "hand off", HAND_OR_CAMERA, "stale camera")
"""Faults after which a search finds nothing."""

SEARCHED = ("knocked", "none of these")
"""Faults with the same search after them, but in space, where a knock needs none."""

UNFELT = ("absent", "dead hand", NOTHING_FELT)
"""Faults by which nothing is felt, until something is."""

_TIE = 1e-6  # share by which probabilities of faults with the same densities may differ
_FAULTY = 0.2  # share of runs with a fault, for what is told alone: no alarm hangs on it
_SURE = 0.95  # share of one of hand and camera in what both have, from which on it is named alone


def static_of(pose_filter: PoseFilter) -> Mapping[str, float]:
    """Those of a run by a filter that hold from the first view on, with prior shares; in space a size alone."""
    if isinstance(pose_filter, IslandFilter):
        return {"another size": STATIC["another size"]}
    return STATIC if follows(pose_filter) else {}


def follows(pose_filter: PoseFilter) -> TypeGuard[PoseTrajectoryFilter]:
    """Whether particles have trajectories of their own, of an upright object."""
    return isinstance(pose_filter, PoseTrajectoryFilter) and not isinstance(pose_filter, IslandFilter)


def faults_of(pose_filter: PoseFilter) -> Mapping[str, float]:
    """What a run by a filter may be lost by, with prior shares."""
    if follows(pose_filter):
        return PRIOR
    return IN_SPACE if isinstance(pose_filter, IslandFilter) else _MISFITS


def all_faults_of(pose_filter: PoseFilter) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Names of all that a run by a filter may be lost by, those from the first view on last, and prior shares."""
    shares = [*faults_of(pose_filter).items(), *static_of(pose_filter).items()]
    return tuple(name for name, _ in shares), tuple(share for _, share in shares)


def chances_by_name(test: ChangeTest, evidence: ChangeEvidence, names: Sequence[str]) -> dict[str, float]:
    """Posterior of no fault and of each fault by name; what is told in two ways has the sum."""
    chances = dict.fromkeys(["no fault", *names], 0.0)
    for name, chance in zip(["no fault", *names], chances_of(test, evidence), strict=True):
        chances[name] += chance
    return chances


def named(chances: Mapping[str, float]) -> tuple[str, float]:
    """What an alarm is named, and its probability: the likeliest fault, two that nothing told apart being one."""
    each = {name: chance for name, chance in chances.items() if name != "no fault"}
    gone, dead, hand, view = (each.get(name, 0.0) for name in ("absent", "dead hand", "hand off", "camera off"))
    if "dead hand" in each and abs(gone - dead) <= _TIE * max(gone, dead):
        each = {name: chance for name, chance in each.items() if name not in ("absent", "dead hand")}
        each[NOTHING_FELT] = gone + dead
    if "hand off" in each and max(hand, view) < _SURE * (hand + view):
        each = {name: chance for name, chance in each.items() if name not in ("hand off", "camera off")}
        each[HAND_OR_CAMERA] = hand + view
    name = max(each, key=lambda one: each[one])
    return name, each[name]


def given(chances: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """Probabilities of some of the explanations where it is one of these; even ones where none has any."""
    total = sum(chances[name] for name in names)
    return {name: chances[name] / total if total > 0 else 1.0 / len(names) for name in names}


def chances_of(test: ChangeTest, evidence: ChangeEvidence) -> list[float]:
    """Posterior of no fault in the run so far, then of each fault, where `_FAULTY` of the runs come to have one."""
    each = test.explanations(evidence)
    count = float(evidence.readings) + 1.0  # the test itself has every run come to a fault, some time
    each = torch.cat((each[:1] * (_FAULTY + (1.0 - _FAULTY) * count), _FAULTY * each[1:]))
    return [float(part) for part in each / each.sum()]
