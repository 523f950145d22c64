"""Independent replicates of an update, pooled: what one population of particles is sure of others may deny.

A touch that tells much leaves a few of a hundred particles, and moves bring back what lies near those alone: of two
poses that explain all, one may be lost by chance. Populations with nothing in common but the belief before lose it or
not (island particles; Verge, Dubarry, Del Moral and Moulines 2015), so that a belief that decides something is asked of
several.
"""

import torch

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.pose_trajectories import PoseTrajectoryBelief
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.resampling import resample_systematic
from rumi.seeding import Generators, lone
from rumi.weights import equal_weights
from sensors.reading import Reading


@torch.no_grad()
def pooled(
    pose_filter: PoseFilter, before: PoseBelief, reading: Reading, after: PoseBelief, *, generator: Generators
) -> PoseBelief:
    """The belief after an action, pooled in equal shares with replicates of that update, as many particles as it had.

    All count by the history of the first, whose points were chosen by its particles. A belief that is not of one
    population of trajectories, or that the action told nothing, stays as it is.

    Args:
        pose_filter: that took the reading in.
        before: the belief before the action.
        reading: of the action.
        after: the belief after it.
        generator: of the replicates' draws.
    """
    if not isinstance(pose_filter, PoseTrajectoryFilter) or type(after) is not PoseTrajectoryBelief or after is before:
        return after
    own, random = pose_filter.own, lone(generator)
    (now, log_weights), begun = pose_filter.particles_of(after), pose_filter.particles_of(before)
    parts, count = [(now, log_weights)], len(now)
    for _ in range(own.replicates):
        done = pose_filter.advanced(*begun, reading, random)
        other = done.now.remembered(own.memory)
        if done.changed and len(other.history) == len(now.history):
            parts.append((other, done.log_weights))
    if len(parts) == 1:
        return after
    some = [
        part.at(resample_systematic(weights, count // len(parts) + (place < count % len(parts)), generator=random))
        for place, (part, weights) in enumerate(parts)
    ]
    first, even = torch.zeros(count, dtype=torch.long), equal_weights(count)
    pool = some[0].joined(*some[1:]).replayed(pose_filter.model, own, now.history, first)
    return pose_filter.belief_of(pool, even, after.world_T_attached, after.log_weights)
