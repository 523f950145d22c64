"""Whether a run is lost: a test of every reading against the belief, and the search that begins anew after an alarm."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.change_test import ChangeEvidence
from rumi.belief.misfit import MISFITS, MisfitSettings, knocked, log_ratios
from rumi.belief.motion import Motion
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.pose_trajectories import PoseTrajectoryBelief
from rumi.belief.remarks import Remark
from rumi.belief.unseen_trajectory_filter import UnseenTrajectoryFilter
from rumi.records import StepRecord
from rumi.resampling import resample_systematic
from rumi.weights import boltzmann
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.observation import Observation, attach, merge

SLIDES: tuple[Motion, ...] = ("pushed", "corrected", "trajectory")
"""Motions by a push model, of an object that slides and stays as it stands."""

_DOUBT = 1.0  # nats
_DRAWS = 8  # poses to search among, for each particle


@dataclass(frozen=True)
class Watch:
    """What is known of faults so far.

    Attributes:
        evidence: since the belief was last begun; None before the first reading.
        begun: number of the action after which that was.
        lost: whether an alarm was raised that no search came after.
        unseated: name of the remark by which an object that no belief has but upright may lie otherwise; None where
            none says so.
    """

    evidence: ChangeEvidence | None = None
    begun: int = 0
    lost: bool = False
    unseated: str | None = None

    def doubt(self, own: MisfitSettings) -> str | None:
        """What speaks for a fault, though not enough for an alarm: no time to be sure."""
        if self.unseated is not None:
            return (
                f"the object may lie otherwise than any pose believed ({self.unseated!r} was remarked), and nothing "
                "measures how: look again, measure its motion, or push it lower (--tool-height)"
            )
        if self.evidence is not None and float(own.test.log_evidence(self.evidence)) > _DOUBT:
            return "the last readings fit a fault better than the belief"
        return None


def unseated(before: str | None, odd: Sequence[Remark], touched: bool) -> str | None:
    """Name of the remark by which an object that should stand, whose motion nothing measures, may lie otherwise.

    A push that tips it: touches that fit tell little of how it lies then, so that this lasts. Or heights at which no
    pose that is believed has it felt, until it is touched again and they are not odd.

    Args:
        before: what was said before the action.
        odd: all remarks of the action, also those that were said before.
        touched: whether the action touched it.
    """
    names = {remark.name for remark in odd}
    if before == "tips" or "tips" in names:
        return "tips"
    if "other height" in names:
        return "other height"
    return None if touched else before


def sensed_now(record: StepRecord, motion: str) -> Observation:
    """The points of a step that its belief can be asked about, in the frame that rides with the object.

    Particles that moved each in its own way share no frame but the present one: of them what was sensed just now.
    """
    if motion != "trajectory":
        return record.added
    sensed, instant = record.reading.observation, record.reading.instant
    now = sensed[instant == record.reading.tool_pose.shape[-3] - 1]
    return attach(now, torch.zeros_like(now.semantics), record.belief.world_T_attached[None])


def watch(
    before: Watch,
    last: PoseBelief,
    record: StepRecord,
    pose_filter: PoseFilter,
    model: ObjectModel,
    own: MisfitSettings,
) -> tuple[Watch, float, Remark | None]:
    """Take a step's reading into the test.

    The belief before it is asked, which with a measured motion rides along with the object; where particles move on
    their own, or a prior is all there is at first and particles are drawn anew, the belief that has taken it in.

    Args:
        before: what was known.
        last: belief before the step.
        record: of the step.
        pose_filter: that the belief is of.
        model: the object.
        own: settings.

    Returns:
        what is known now, the evidence against "no fault so far" in nats, and a remark where an alarm is due.
    """
    if own.alpha == 0 or before.lost:
        return before, 0.0, None
    test = own.test
    evidence = test.begin() if before.evidence is None else before.evidence
    added = sensed_now(record, pose_filter.settings.motion)
    rides = pose_filter.settings.motion == "measured" and pose_filter.prior is None
    asked = replace(last, world_T_attached=record.belief.world_T_attached) if rides else record.belief
    evidence = test.update(evidence, log_ratios(asked, added, model.sdf, own))
    after, nats = replace(before, evidence=evidence), float(test.log_evidence(evidence))
    if not bool(test.alarm(evidence)):
        return after, nats, None
    shares = test.explanations(evidence)[1:]
    best = int(shares.argmax())
    since = before.begun + max(1, round(float(test.onset(evidence)[best])))
    remark = Remark(
        f"lost: {MISFITS[best]}",
        record.step,
        f"no pose that is believed fits since about action {since}; as if {MISFITS[best]} "
        f"(probability {float(shares[best]):.2f} of what is known to happen)",
    )
    if own.recover and MISFITS[best] != "absent":
        return Watch(None, record.step, before.lost), nats, remark
    return Watch(None, record.step, lost=True), nats, remark


def searched_again(
    record: StepRecord,
    memory: Observation,
    pose_filter: PoseFilter,
    own: MisfitSettings,
    *,
    generator: torch.Generator,
) -> tuple[PoseBelief, Observation]:
    """The belief and the memory of a search that begins anew about what was believed, from one reading alone.

    Observations before it that ride with the object are dropped: they told where it was.
    """
    last = record.belief
    if isinstance(pose_filter, UnseenTrajectoryFilter) and isinstance(last, PoseTrajectoryBelief):
        begun = pose_filter.begun_again(last, record.reading, generator=generator)
        return begun, memory[(~memory.attached).nonzero()[:, 0]]
    told = sensed_now(record, pose_filter.settings.motion)
    points = replace(told, points=se3.apply(last.world_T_attached, told.points))
    none = Observation.empty(dtype=points.points.dtype, device=points.points.device)
    memory, _ = merge(none, points, pose_filter.lattice)
    count = last.log_weights.shape[-1]
    poses = last.world_T_attached @ knocked(last, own, _DRAWS * count)
    belief = PoseBelief.uniform(poses)
    weights = boltzmann(pose_filter.total(belief, memory), pose_filter.settings.peakiness)
    rows: Float[Tensor, "N"] = resample_systematic(weights, count, generator=generator)
    kept = PoseBelief.uniform(poses[rows])
    kept = replace(kept, attached_T_object=pose_filter.descend(kept, memory, pose_filter.settings.descent))
    kept = replace(kept, discrepancy=pose_filter.total(kept, memory))
    return pose_filter.begin(kept, memory, generator=generator), memory
