"""Whether a run is lost: a test of every reading against the belief."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief import island_faults, island_rivals, rival_filters, stuck_hand, trajectory_faults
from rumi.belief.change_test import ChangeTest
from rumi.belief.island_filter import IslandBelief, IslandFilter
from rumi.belief.misfit import MISFITS, MisfitSettings, log_ratios
from rumi.belief.motion import Motion
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.pose_trajectories import PoseTrajectoryBelief
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.remarks import Remark
from rumi.belief.rival_filters import Rival
from rumi.records import StepRecord
from rumi.tasks.rummage.explanations import (
    GONE,
    HAND_OR_CAMERA,
    NOTHING_FELT,
    SEARCHED,
    UNFELT,
    all_faults_of,
    chances_by_name,
    follows,
    given,
    named,
    static_of,
)
from rumi.tasks.rummage.fault_state import DOUBT, Watch
from sdf.object_model import ObjectModel
from sensors.observation import Observation, attach
from sensors.reading import Reading

_CLEAR, _WAITS = 0.7, 2  # probability from which on an alarm is named at once, and actions that it waits for it
_TELLS = 1.0  # nats
_FALSE_TOUCH = "false touch"  # remark by a step whose reading was left out
# nats of all readings so far, from which on faults from the first view on are asked about: upright, and in space
_STRAINED, _STRAINED_IN_SPACE = -5.0, -65.0

SLIDES: tuple[Motion, ...] = ("pushed", "corrected", "trajectory")
"""Motions by a push model, of an object that slides and stays as it stands."""


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
    last: StepRecord,
    record: StepRecord,
    pose_filter: PoseFilter,
    model: ObjectModel,
    own: MisfitSettings,
    *,
    generator: torch.Generator,
    history: Sequence[StepRecord] = (),
    looks_again: bool = False,
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
        history: the steps before it, the first view first; without them faults from there on are not asked about.
        looks_again: whether a camera looks after every action.

    Returns:
        what is known now, and a remark where an alarm is due.
    """
    open_yet = before.named in (None, *UNFELT)  # what was only not felt may be felt again
    if own.alpha == 0 or (before.lost and not open_yet):
        return replace(before, nats=0.0, p_value=1.0, set_aside=False), None
    names, shares = all_faults_of(pose_filter)
    test = ChangeTest(shares, own.alpha)
    evidence = test.begin() if before.evidence is None else before.evidence
    steps = (*history, record) if history else (last, record)
    of_action, repeated = _ratios(steps, pose_filter, model, own, generator, looks_again)
    strange = own.recover and _is_strange(of_action, names, record, pose_filter)
    rivals, static = before.rivals, before.static
    if static_of(pose_filter) and open_yet and not strange:
        rivals, static = _rivals(before, record, history, pose_filter, generator)
    ratios = _all_ratios(before, of_action, static, names)
    enough = DOUBT if isinstance(pose_filter, IslandFilter) else test.threshold
    due = float(test.log_evidence(test.update(evidence, ratios))) >= enough
    if due and open_yet and not strange and rivals and not rival_filters.is_asked_again(rivals):
        rivals, static = _asked_again(rivals, record, history, pose_filter, generator)
        ratios = _all_ratios(before, of_action, static, names)
    evidence = test.update(evidence, ratios)
    weighed = torch.logsumexp(ratios + ratios.new_tensor(test.weights).log(), -1)
    chances = chances_by_name(test, evidence, names)
    after = replace(
        before,
        evidence=evidence,
        nats=float(test.log_evidence(evidence)),
        p_value=math.exp(min(0.0, -float(weighed))),  # Markov's inequality
        explanations=chances if open_yet else before.explanations,
        beside_m=_beside(last, record, pose_filter) if bool(record.reading.in_contact.any()) else before.beside_m,
        rivals=rivals,
        static=static,
        set_aside=False,
    )
    # what is searched for and felt was knocked, however well the belief of the search explains the touch
    found = before.unfelt_since is not None and bool(record.reading.in_contact.any()) and not strange
    if not found and not bool(test.alarm(evidence)):
        return replace(after, set_aside=strange), None
    name, chance = named(given(chances, SEARCHED) if found else chances)
    alike = name in SEARCHED and not isinstance(pose_filter, IslandFilter)
    clear = sum(chances[each] for each in SEARCHED) if alike else chance
    unclear = clear < _CLEAR or (repeated > _TELLS and name != "stuck hand")
    if unclear and after.waited < _WAITS and not found:  # one more action tells more than a wrong recovery undoes
        tells = bool((ratios.abs() > _TELLS).logical_and(ratios.isfinite()).any())
        return replace(after, waited=after.waited + tells), None
    if before.lost and (name in UNFELT or not bool(record.reading.in_contact.any())):
        return after, None
    likeliest = {NOTHING_FELT: "absent", HAND_OR_CAMERA: "hand off"}.get(name, name)
    since = before.begun + max(1, round(float(test.onset(evidence)[names.index(likeliest)])))
    remark = Remark(
        f"lost: {name}",
        record.step,
        f"no pose that is believed fits since about action {since}; as if {name} (probability {chance:.2f})",
    )
    searches = own.recover and name not in GONE
    told_by = replace(
        after,
        evidence=after.evidence if name in UNFELT else None,
        begun=before.begun if name in UNFELT else record.step,
        lost=not searches,
        named=name,
        explanations=chances,
        beside_m=0.0,
        waited=0,
        unfelt_since=since if name == NOTHING_FELT and own.recover and follows(pose_filter) else None,
    )
    return (_going_on(told_by, pose_filter) if searches else told_by), remark


def _is_strange(
    of_action: Float[Tensor, "k"], names: Sequence[str], record: StepRecord, pose_filter: PoseFilter
) -> bool:
    """Whether something was felt falsely, so that the reading is left out where no alarm is due."""
    if isinstance(pose_filter, IslandFilter):
        return island_faults.false_touch(of_action, record.reading, pose_filter)
    return follows(pose_filter) and float(of_action[names.index("false contacts")]) > _TELLS


def _rivals(
    before: Watch,
    record: StepRecord,
    history: Sequence[StepRecord],
    pose_filter: PoseFilter,
    generator: torch.Generator,
) -> tuple[tuple[Rival, ...] | None, Mapping[str, float]]:
    """Rivals that have taken the reading in, and what they say; begun where the readings so far are unlikely enough."""
    assert isinstance(pose_filter, PoseTrajectoryFilter)
    none, rivals, readings = pose_filter.log_evidence(record.belief), before.rivals, [record.reading]
    if rivals is None:
        if not history or none > (_STRAINED if follows(pose_filter) else _STRAINED_IN_SPACE):
            return None, before.static
        if isinstance(pose_filter, IslandFilter):
            rivals = island_rivals.begun(pose_filter, generator)
        else:
            first, _ = pose_filter.particles_of(history[0].belief)
            rivals = rival_filters.begun(pose_filter, first, generator)
        readings = taken_in((*history[1:], record))
    for reading in readings:
        rivals = rival_filters.followed(rivals, reading, generator)
    rivals = rival_filters.left(rivals, rival_filters.log_none(rivals, none))
    return rivals, _static(rivals, none, pose_filter)


def _static(rivals: Sequence[Rival], none: float, pose_filter: PoseTrajectoryFilter) -> Mapping[str, float]:
    """Log-likelihood ratio of all readings, of each fault that holds from the first view on."""
    own = island_rivals if isinstance(pose_filter, IslandFilter) else rival_filters
    return own.log_ratios(rivals, none)


def taken_in(steps: Sequence[StepRecord]) -> list[Reading]:
    """Readings of some steps but those that were left out."""
    return [step.reading for step in steps if all(remark.name != _FALSE_TOUCH for remark in step.remarks)]


def _all_ratios(
    before: Watch, of_action: Float[Tensor, "k"], static: Mapping[str, float], names: Sequence[str]
) -> Float[Tensor, "K"]:
    """Log-likelihood ratios of a reading, of faults of the action and of those that hold from the first view on."""
    open_yet = before.named in (None, *UNFELT)
    rest = [
        static[name] - before.static[name] if open_yet and static[name] > -math.inf else -math.inf
        for name in names[len(of_action) :]
    ]
    ratios = torch.cat((of_action, of_action.new_tensor(rest)))
    if before.following is not None:  # no prior is wider than a wide one
        ratios = ratios.where(torch.tensor([name != "push model off" for name in names]), -torch.inf)
    return ratios


def _asked_again(
    rivals: tuple[Rival, ...],
    record: StepRecord,
    history: Sequence[StepRecord],
    pose_filter: PoseFilter,
    generator: torch.Generator,
) -> tuple[tuple[Rival, ...], Mapping[str, float]]:
    """Rivals with further copies, where an alarm is due or in space a run would not be sure, and what they say then."""
    assert isinstance(pose_filter, PoseTrajectoryFilter)
    readings = taken_in((*history[1:], record))
    if isinstance(pose_filter, IslandFilter):
        rivals = island_rivals.doubted(pose_filter, rivals, readings, generator)
    else:
        first, _ = pose_filter.particles_of(history[0].belief)
        rivals = (*rivals, *rival_filters.doubted(pose_filter, first, readings, generator))
    return rivals, _static(rivals, pose_filter.log_evidence(record.belief), pose_filter)


def _going_on(told_by: Watch, pose_filter: PoseFilter) -> Watch:
    """What is known after an alarm, with the filter and the belief that the run goes on by."""
    told_by = replace(told_by, adopted=())
    if not isinstance(pose_filter, PoseTrajectoryFilter):
        return told_by
    if told_by.named == "push model off":
        return replace(told_by, following=pose_filter.doubting())
    some = [rival for rival in told_by.rivals or () if rival.name == told_by.named]
    if not some or told_by.named not in ("another size", "camera off"):
        return told_by
    alike, following = rival_filters.likeliest(some), told_by.following
    if told_by.named == "another size":
        following = alike[0].pose_filter.supposing(own=pose_filter.own)
    return replace(told_by, adopted=tuple(alike), following=following, rivals=None)


def told(record: StepRecord, now: Watch, alarm: Remark | None = None) -> StepRecord:
    """A step's record with what is known of faults after it."""
    if now.set_aside:
        said = "something was felt for an instant where no pose that is believed has a surface: left out"
        record = replace(record, remarks=(*record.remarks, Remark(_FALSE_TOUCH, record.step, said)))
    return replace(
        record,
        lost=now.nats,
        p_value=now.p_value,
        explanations=dict(now.explanations),
        remarks=(*record.remarks, *filter(None, (alarm,))),
    )


def _beside(last: StepRecord, record: StepRecord, pose_filter: PoseFilter) -> float:
    """How far what a step felt last is from where any particle has it felt, metres; 0 where nothing tells."""
    both = [step.belief for step in (last, record)]
    if not follows(pose_filter) or not all(isinstance(belief, PoseTrajectoryBelief) for belief in both):
        return 0.0
    before, after = (belief.trajectories for belief in both if isinstance(belief, PoseTrajectoryBelief))
    assert before is not None and after is not None
    return trajectory_faults.last_contact_off(after, trajectory_faults.new_segments(before, after), pose_filter)


def _ratios(
    steps: Sequence[StepRecord],
    pose_filter: PoseFilter,
    model: ObjectModel,
    own: MisfitSettings,
    generator: torch.Generator,
    looks_again: bool,
) -> tuple[Float[Tensor, "K"], float]:
    """Log-likelihood ratios of the last step's reading, of each of `faults_of`; and that of how it repeats itself."""
    *_, last, record = steps
    added = sensed_now(record, pose_filter.settings.motion)
    rides = pose_filter.settings.motion == "measured" and pose_filter.prior is None
    asked = replace(last.belief, world_T_attached=record.belief.world_T_attached) if rides else record.belief
    found = log_ratios(asked, added, model.sdf, own)
    before, after = last.belief, record.belief
    if not (isinstance(before, PoseTrajectoryBelief) and isinstance(after, PoseTrajectoryBelief)):
        return found, 0.0
    assert isinstance(pose_filter, PoseTrajectoryFilter)
    anywhere = float(found[MISFITS.index("none of these")])
    readings = [step.reading for step in steps]
    stuck = stuck_hand.told_by(readings, pose_filter.model, pose_filter.own, anywhere=anywhere)
    none = found[MISFITS.index("none of these") :]
    if isinstance(pose_filter, IslandFilter):
        assert isinstance(before, IslandBelief) and isinstance(after, IslandBelief)
        told = island_faults.log_ratios(
            before, after, record.reading, pose_filter, own, generator=generator, stuck=stuck
        )
        if island_faults.false_touch(told, record.reading, pose_filter):
            stated = trajectory_faults.stated_false(len(record.reading.tool_pose), pose_filter.own)
            none = none.clamp_max(trajectory_faults.by_brief_touch(own, stated))
        return torch.cat((told, none)), stuck.repeated
    assert before.trajectories is not None and after.trajectories is not None
    told = trajectory_faults.log_ratios(
        before.trajectories,
        before.log_weights,
        after.trajectories,
        pose_filter,
        own,
        generator=generator,
        looks=(last.reading, record.reading) if looks_again else None,
        stuck=stuck,
    )
    return torch.cat((told, none)), stuck.repeated
