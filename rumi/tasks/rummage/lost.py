"""Whether a run is lost: a test of every reading against the belief, and the search that begins anew after an alarm."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief import trajectory_faults
from rumi.belief.change_test import ChangeEvidence, ChangeTest
from rumi.belief.knocked_trajectories import begun_again
from rumi.belief.misfit import MISFITS, MisfitSettings, knocked, log_ratios
from rumi.belief.motion import Motion
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.pose_trajectories import PoseTrajectoryBelief
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.remarks import Remark
from rumi.belief.unseen_trajectory_filter import UnseenTrajectoryFilter
from rumi.records import StepRecord
from rumi.resampling import resample_systematic
from rumi.weights import boltzmann
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.observation import Observation, attach, merge

PRIOR: dict[str, float] = {
    "knocked": 0.3,
    "absent": 0.15,
    "dead hand": 0.1,
    "false contacts": 0.2,
    "hand off": 0.1,
    "camera off": 0.1,
    "none of these": 0.05,
}
"""What a run may be lost by, where particles have trajectories of their own, with the prior share of each."""

_MISFITS = dict(zip(MISFITS, (0.6, 0.25, 0.15), strict=True))
_UNSAID = {"absent": "; or the hand feels nothing: nothing here tells which", "dead hand": "; or the object is gone"}
_FAULTY = 0.2  # share of runs with a fault, for what is told alone: no alarm hangs on it
_OFF = {"hand off": 0.006, "camera off": 0.010}  # metres within which a search begins anew
_STRAIGHT_RAD = 0.05  # and radians: an offset turns nothing
_GONE = ("absent", "dead hand")  # faults after which a search would find nothing

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
        nats: evidence against "no fault so far", after the last reading.
        p_value: of the last reading under the belief, an upper bound.
        explanations: posterior of "no fault" and of each fault after the last reading that was asked about; after an
            alarm that of the alarm, until the next.
        named: the fault of the last alarm.
    """

    evidence: ChangeEvidence | None = None
    begun: int = 0
    lost: bool = False
    unseated: str | None = None
    nats: float = 0.0
    p_value: float = 1.0
    explanations: Mapping[str, float] = field(default_factory=dict)
    named: str | None = None

    def doubt(self) -> str | None:
        """What speaks for a fault, though not enough for an alarm: no time to be sure."""
        if self.unseated is not None:
            return (
                f"the object may lie otherwise than any pose believed ({self.unseated!r} was remarked), and nothing "
                "measures how: look again, measure its motion, or push it lower (--tool-height)"
            )
        if self.evidence is not None and self.nats > _DOUBT:
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


def faults_of(pose_filter: PoseFilter) -> Mapping[str, float]:
    """What a run by a filter may be lost by, with prior shares."""
    return PRIOR if _follows(pose_filter) else _MISFITS


def watch(
    before: Watch,
    last: StepRecord,
    record: StepRecord,
    pose_filter: PoseFilter,
    model: ObjectModel,
    own: MisfitSettings,
    *,
    generator: torch.Generator,
) -> tuple[Watch, Remark | None]:
    """Take a step's reading into the test.

    Where particles have trajectories of their own, the belief before the reading is asked, and what the filter added up
    while it took the reading in. Else the belief before it where it rides along with the object by its measured motion;
    where a prior is all there is at first and particles are drawn anew, the belief that has taken it in.

    Args:
        before: what was known.
        last: the step before, with the belief that the reading came to.
        record: of the step.
        pose_filter: that the belief is of.
        model: the object.
        own: settings.
        generator: of draws.

    Returns:
        what is known now, and a remark where an alarm is due.
    """
    if own.alpha == 0 or before.lost:
        return replace(before, nats=0.0, p_value=1.0), None
    shares = faults_of(pose_filter)
    names, test = list(shares), ChangeTest(tuple(shares.values()), own.alpha)
    evidence = test.begin() if before.evidence is None else before.evidence
    ratios = _ratios(last, record, pose_filter, model, own, generator)
    if before.named is not None:  # a search is about what it touched, whatever hand and view are off by
        ratios = ratios.where(torch.tensor([name not in _OFF for name in names]), -torch.inf)
    evidence = test.update(evidence, ratios)
    weighed = torch.logsumexp(ratios + ratios.new_tensor(test.weights).log(), -1)
    chances = dict(zip(["no fault", *names], _chances(test, evidence), strict=True))
    after = replace(
        before,
        evidence=evidence,
        nats=float(test.log_evidence(evidence)),
        p_value=math.exp(min(0.0, -float(weighed))),  # Markov's inequality
        explanations=chances if before.named is None else before.explanations,
    )
    if not bool(test.alarm(evidence)):
        return after, None
    name = max(names, key=lambda one: chances[one])
    since = before.begun + max(1, round(float(test.onset(evidence)[names.index(name)])))
    remark = Remark(
        f"lost: {name}",
        record.step,
        f"no pose that is believed fits since about action {since}; as if {name} "
        f"(probability {chances[name]:.2f}){_UNSAID.get(name, '')}",
    )
    searches = own.recover and name not in _GONE
    told_by = replace(after, evidence=None, begun=record.step, lost=not searches, named=name, explanations=chances)
    return told_by, remark


def _chances(test: ChangeTest, evidence: ChangeEvidence) -> list[float]:
    """Posterior of no fault in the run so far, then of each fault, where `_FAULTY` of the runs come to have one."""
    each = test.explanations(evidence)
    count = float(evidence.readings) + 1.0  # the test itself has every run come to a fault, some time
    each = torch.cat((each[:1] * (_FAULTY + (1.0 - _FAULTY) * count), _FAULTY * each[1:]))
    return [float(part) for part in each / each.sum()]


def told(record: StepRecord, now: Watch, alarm: Remark | None = None) -> StepRecord:
    """A step's record with what is known of faults after it."""
    return replace(
        record,
        lost=now.nats,
        p_value=now.p_value,
        explanations=dict(now.explanations),
        remarks=(*record.remarks, *filter(None, (alarm,))),
    )


def _follows(pose_filter: PoseFilter) -> bool:
    """Whether particles have trajectories of their own, of an upright object."""
    return isinstance(pose_filter, PoseTrajectoryFilter) and not isinstance(pose_filter, UnseenTrajectoryFilter)


def _ratios(
    last: StepRecord,
    record: StepRecord,
    pose_filter: PoseFilter,
    model: ObjectModel,
    own: MisfitSettings,
    generator: torch.Generator,
) -> Float[Tensor, "K"]:
    """Log-likelihood ratios of a step's reading, of each of `faults_of`."""
    added = sensed_now(record, pose_filter.settings.motion)
    rides = pose_filter.settings.motion == "measured" and pose_filter.prior is None
    asked = replace(last.belief, world_T_attached=record.belief.world_T_attached) if rides else record.belief
    found = log_ratios(asked, added, model.sdf, own)
    before, after = last.belief, record.belief
    if not (isinstance(before, PoseTrajectoryBelief) and isinstance(after, PoseTrajectoryBelief)):
        return found
    if not (isinstance(pose_filter, PoseTrajectoryFilter) and _follows(pose_filter)):
        return found
    assert before.trajectories is not None and after.trajectories is not None
    told = trajectory_faults.log_ratios(
        before.trajectories,
        before.log_weights,
        after.trajectories,
        pose_filter.model,
        pose_filter.own,
        own,
        untouched=last.contacts == 0,
        generator=generator,
    )
    return torch.cat((told, found[MISFITS.index("none of these") :]))


def searched_again(
    last: StepRecord,
    record: StepRecord,
    memory: Observation,
    pose_filter: PoseFilter,
    own: MisfitSettings,
    named: str | None,
    *,
    before: Observation,
    generator: torch.Generator,
) -> tuple[PoseBelief, Observation]:
    """The belief and the memory of a search that begins anew about what was believed, from one reading alone.

    As far about it as the fault asks for: a knock moves and turns it, a hand or a view that is off only moves it.

    Observations before it that ride with the object are dropped: they told where it was. What was felt where nothing is
    is dropped itself: belief and memory before it go on.

    Args:
        last: the step before.
        record: of the step whose reading raised the alarm.
        memory: points so far.
        pose_filter: that the belief is of.
        own: settings.
        named: what the alarm was taken for.
        before: points before the step.
        generator: of draws.
    """
    if named == "false contacts":
        return last.belief, before
    if isinstance(pose_filter, UnseenTrajectoryFilter) and isinstance(record.belief, PoseTrajectoryBelief):
        begun = pose_filter.begun_again(record.belief, record.reading, generator=generator)
        return begun, memory[(~memory.attached).nonzero()[:, 0]]
    here = record.belief
    if named in _OFF:
        own = replace(own, knock_m=_OFF[named], knock_rad=_STRAIGHT_RAD)
    anew: PoseBelief | None = None
    if isinstance(pose_filter, PoseTrajectoryFilter) and _follows(pose_filter):
        assert isinstance(last.belief, PoseTrajectoryBelief) and isinstance(here, PoseTrajectoryBelief)
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
