"""The search that begins anew after an alarm: what the fault makes false is dropped, not averaged."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.island_filter import IslandFilter
from rumi.belief.knocked_trajectories import begun_again, pushed_anew, sought
from rumi.belief.misfit import MisfitSettings, knocked
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.pose_trajectories import PoseTrajectoryBelief
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.rival_filters import Rival, adopted
from rumi.records import StepRecord
from rumi.resampling import resample_systematic
from rumi.tasks.rummage.explanations import follows
from rumi.tasks.rummage.fault_state import Watch
from rumi.tasks.rummage.lost import sensed_now, taken_in
from rumi.weights import boltzmann
from sdf import se3
from sensors.observation import Observation, merge

_STRANGE = ("false contacts", "second object")  # what was felt was not the object
_DRAWS = 8  # poses to search among, for each particle


def searched_again(
    steps: Sequence[StepRecord],
    memory: Observation,
    pose_filter: PoseFilter,
    own: MisfitSettings,
    now: Watch,
    *,
    before: Observation,
    generator: torch.Generator,
) -> tuple[PoseBelief, Observation]:
    """The belief and the memory of a search that begins anew about what was believed, from one reading alone.

    Observations before it that ride with the object are dropped: they told where it was. What was felt where nothing is
    is dropped itself: belief and memory before it go on. Where nothing was felt any more the search begins where the
    object was before, from all readings since that were not left out.

    Args:
        steps: of the run, the first view first; the last one's reading raised the alarm.
        memory: points so far.
        pose_filter: that the belief is of.
        own: settings.
        now: what the alarm was taken for, and what the run goes on by.
        before: points before the step.
        generator: of draws.
    """
    *_, last, record = steps
    named = now.named
    if named in _STRANGE or now.set_aside:
        return last.belief, before
    here = record.belief
    if now.unfelt_since is not None:
        assert isinstance(pose_filter, PoseTrajectoryFilter)
        readings, begun = taken_in(steps[now.unfelt_since :]), steps[now.unfelt_since - 1].belief
        assert isinstance(begun, PoseTrajectoryBelief)
        return sought(pose_filter, begun, readings, memory, own, generator=generator)
    if now.adopted:
        assert isinstance(pose_filter, PoseTrajectoryFilter) and isinstance(here, PoseTrajectoryBelief)
        return _adopted(now.adopted, now.following or pose_filter, here), memory
    if isinstance(pose_filter, IslandFilter):
        if named == "knocked":  # some of its particles jump in each action, all where none fits
            return record.belief, memory
        begun = pose_filter.begun_again(record.belief, record.reading, generator=generator)
        return begun, memory[(~memory.attached).nonzero()[:, 0]]
    anew: PoseBelief | None = None
    if follows(pose_filter):
        assert isinstance(last.belief, PoseTrajectoryBelief) and isinstance(here, PoseTrajectoryBelief)
        if named == "push model off":
            return pushed_anew(pose_filter.doubting(), last.belief, record.reading, before, generator=generator)
        anew = begun_again(pose_filter, last.belief, here, own, generator=generator)
    told = sensed_now(record, pose_filter.settings.motion)
    points = replace(told, points=se3.apply(here.world_T_attached, told.points))
    none = Observation.empty(dtype=points.points.dtype, device=points.points.device)
    memory, _ = merge(none, points, pose_filter.lattice)
    if anew is not None:
        return anew, memory
    count = here.log_weights.shape[-1]
    poses = here.world_T_attached @ knocked(here, own, _DRAWS * count)
    belief = PoseBelief.uniform(poses)
    weights = boltzmann(pose_filter.total(belief, memory), pose_filter.settings.peakiness)
    rows: Float[Tensor, "N"] = resample_systematic(weights, count, generator=generator)
    kept = PoseBelief.uniform(poses[rows])
    kept = replace(kept, attached_T_object=pose_filter.descend(kept, memory, pose_filter.settings.descent))
    kept = replace(kept, discrepancy=pose_filter.total(kept, memory))
    return pose_filter.begin(kept, memory, generator=generator), memory


def _adopted(rivals: Sequence[Rival], pose_filter: PoseTrajectoryFilter, like: PoseTrajectoryBelief) -> PoseBelief:
    """The belief of a rival in the frame of another: with as many particles; or in space, by all of its populations."""
    frame, count = like.world_T_attached, len(like.log_weights)
    if isinstance(pose_filter, IslandFilter):
        each = [pose_filter.belief_of(one.now, one.log_weights, frame, like.log_weights) for one in rivals]
        return pose_filter.mixture(each)
    even = torch.full((count,), -math.log(count), dtype=torch.float64)
    return pose_filter.belief_of(adopted(rivals[0], count), even, frame, like.log_weights)
