"""Trajectories begun anew after an alarm: what was believed, moved about or not, under all that one action brought.

Importance sampling of where the object was when the action began, from the belief before it moved by a knock, then
moves under the action's readings. What came before is forgotten: it told where the object was before the knock.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch

from rumi.belief.misfit import MisfitSettings
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_trajectories import PoseTrajectoryBelief, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.systematic_errors import as_seen
from rumi.belief.tempering import check_finite, power_of
from rumi.belief.trajectory_faults import new_segments
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_moves import Moves
from rumi.resampling import resample_systematic
from rumi.seeding import normal
from rumi.weights import equal_weights
from sdf import se3
from sensors.observation import Observation
from sensors.reading import Reading

_DRAWS, _STARTS, _SWEEPS = 4000, 300, 8


@torch.no_grad()
def begun_again(
    pose_filter: PoseTrajectoryFilter,
    before: PoseTrajectoryBelief,
    after: PoseTrajectoryBelief,
    own: MisfitSettings,
    *,
    generator: torch.Generator,
) -> PoseTrajectoryBelief | None:
    """The belief after a knock before the last action, in a frame of its own that rests in the world's.

    Args:
        pose_filter: that the beliefs are of.
        before: the belief before the action.
        after: the belief that has taken it in, whose history holds the action.
        own: how far a knock moves and turns.
        generator: of the draws.

    Returns:
        the belief; None where the action added no reading.
    """
    last, now = before.trajectories, after.trajectories
    if last is None or now is None or not (new := new_segments(last, now)):
        return None
    sensed, model, history = pose_filter.own, pose_filter.model, now.history.since(len(now.history) - new)
    drawn = _knocked(before, history, own, _DRAWS, generator)
    start = drawn.poses[:, 0]
    drawn = drawn.replayed(model, sensed, history, torch.zeros(_DRAWS, dtype=torch.long))
    gained = drawn.log_likelihood.sum(-1)
    check_finite(gained)
    power = power_of(torch.zeros_like(gained), gained, 0.0, float(_STARTS))  # starts are proposals: they may be wide
    seen = as_seen(sensed, drawn.systematic, start)
    starts = seen[resample_systematic(power * gained, _STARTS, generator=generator)]
    drawn = replace(drawn.at(resample_systematic(gained, sensed.particles, generator=generator)), starts=starts)
    moves = Moves(model, sensed, generator)
    for _ in range(_SWEEPS):
        drawn = moves.sweep(drawn, history, whole=True)
    flat = equal_weights(len(drawn))
    return pose_filter.belief_of(drawn, flat, se3.identity().to(after.world_T_attached), after.log_weights)


def sought(
    pose_filter: PoseTrajectoryFilter,
    before: PoseTrajectoryBelief,
    readings: Sequence[Reading],
    memory: Observation,
    own: MisfitSettings,
    *,
    generator: torch.Generator,
) -> tuple[PoseBelief, Observation]:
    """The belief and the memory where an object may have been knocked away before some actions that did not feel it.

    The belief that took silence for anything but a knock is forgotten: it has the object pushed to where no tool pushes
    it, or is surer and surer of what little was left. The evidence of the readings before is kept: beliefs under other
    faults, which go on, have theirs of all readings.

    Args:
        pose_filter: that the belief is of.
        before: the belief before these actions.
        readings: of them.
        memory: points after them; what rides with the object is dropped.
        own: how far a knock moves and turns.
        generator: of the draws.
    """
    last, count = before.trajectories, max(pose_filter.own.particles, pose_filter.own.first_particles)
    assert last is not None
    drawn = replace(_knocked(before, History.empty(), own, count, generator), log_evidence=last.log_evidence)
    even = equal_weights(count)
    belief: PoseBelief = pose_filter.belief_of(drawn, even, before.world_T_attached, before.log_weights)
    memory = memory[(~memory.attached).nonzero()[:, 0]]
    for reading in readings:
        belief, memory, _ = pose_filter(belief, memory, reading, generator=generator)
    return belief, memory


def _knocked(
    before: PoseTrajectoryBelief, history: History, own: MisfitSettings, count: int, generator: torch.Generator
) -> Trajectories:
    """So many trajectories that begin where a knock may have moved a belief's, with a history of their own."""
    last = before.trajectories
    assert last is not None
    rows = resample_systematic(before.log_weights.double(), count, generator=generator)
    start = last.pose[rows].clone()
    scale = start.new_tensor((own.knock_m, own.knock_m, own.knock_rad))
    start[:, :3] += scale * normal((count, 3), generator=generator, dtype=torch.float64)
    return Trajectories.drawn(start, history, generator, systematic=last.systematic[rows])


def pushed_anew(
    pose_filter: PoseTrajectoryFilter,
    before: PoseTrajectoryBelief,
    reading: Reading,
    memory: Observation,
    *,
    generator: torch.Generator,
) -> tuple[PoseBelief, Observation]:
    """The belief and the memory after an action under a filter of another motion prior.

    Poses before the action are kept; how they came about, which the old prior had its part in, is forgotten.

    Args:
        pose_filter: with the new prior.
        before: the belief before the action.
        reading: of the action.
        memory: points before it.
        generator: of the draws.
    """
    last = before.trajectories
    assert last is not None
    fresh = Trajectories.drawn(last.pose.clone(), History.empty(), generator, systematic=last.systematic)
    belief, memory, _ = pose_filter(replace(before, trajectories=fresh), memory, reading, generator=generator)
    return belief, memory
