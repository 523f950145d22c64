"""Whether a belief that is sure is so by other draws too: copies of it that are asked before a run stops.

A belief of few particles is sure once in a while by its draws alone, and a run stops at the first such belief. Copies
take in the same readings by other draws. The mean over belief and copies errs less than each (a mixture of independent
runs of a sampler), and a belief that stands alone is no time to be sure.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief import rival_filters
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.pose_trajectories import PoseTrajectoryBelief
from rumi.records import StepRecord
from rumi.registration.pose_summary import mass_within
from rumi.tasks.rummage.fault_state import Watch
from rumi.tasks.rummage.lost import follows, taken_in
from sdf import se3
from sdf.symmetry import Symmetries


@torch.no_grad()
def asked(
    now: Watch,
    history: Sequence[StepRecord],
    pose_filter: PoseFilter,
    symmetries: Symmetries,
    *,
    copies: int,
    within_m: float,
    within_rad: float,
    generator: torch.Generator,
) -> Watch:
    """What is known after a step, with what copies of the belief make of its best pose; none before it first is sure.

    Args:
        now: what is known.
        history: records of all steps, the last of which is asked about.
        pose_filter: that the belief is of.
        symmetries: of the object.
        copies: how many there are; 0 asks none.
        within_m: metres that a pose is right within.
        within_rad: radians.
        generator: of the draws.
    """
    here, begun = history[-1].belief, history[now.begun].belief
    if not copies or now.lost or not follows(pose_filter):
        return replace(now, copies=None, agreed=1.0)
    rivals, readings = now.copies, taken_in(history[-1:])
    if rivals is None or now.copied != now.begun:
        assert isinstance(begun, PoseTrajectoryBelief) and begun.trajectories is not None
        if not history[-1].converged:
            return replace(now, copies=None, agreed=1.0)
        rivals = rival_filters.copied(pose_filter, begun.trajectories, copies, generator)
        readings = taken_in(history[now.begun + 1 :])
    for reading in readings:
        rivals = rival_filters.followed(rivals, reading, generator)
    frame, like = here.world_T_attached, here.log_weights
    beliefs = [here, *(one.pose_filter.belief_of(one.now, one.log_weights, frame, like) for one in rivals)]
    best = se3.renormalised(here.mode().double())
    shares = [_share(belief, best, symmetries, within_m, within_rad) for belief in beliefs]
    return replace(now, copies=rivals, copied=now.begun, agreed=sum(shares) / len(shares))


def _share(
    belief: PoseBelief, best: Float[Tensor, "4 4"], symmetries: Symmetries, within_m: float, within_rad: float
) -> float:
    """Weight of the poses of a belief that are within tolerances of one."""
    poses, weights = se3.renormalised(belief.world_T_object.double()), belief.log_weights.double().softmax(-1)
    return mass_within(poses, weights, best, symmetries.to(torch.float64), within_m, within_rad)
