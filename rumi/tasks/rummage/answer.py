"""What rummaging says of its own answer: what it relies on, what was not measured, and why it is not sure."""

import math
from collections.abc import Sequence

import torch

from rumi.agent import StopReason
from rumi.belief.motion import Motion
from rumi.information.stopping import StopEvidence, shortfalls
from rumi.records import StepRecord
from rumi.registration.pose_summary import PoseSummary
from rumi.tasks.rummage.parts import RummagerParts
from sdf import se3
from sensors.semantics import Semantics

_TAKEN: dict[Motion, str] = {
    "sticking": "taken to stick to the tool",
    "pushed": "taken from the push model",
    "estimated": "estimated from the touches, from sticking contact on",
    "corrected": "taken from the push model and corrected by what is sensed",
    "trajectory": "each particle's own, by a push model with noise",
}
"""How a motion comes about that nothing measures."""

_RECORD: dict[Motion, str] = {
    "pushed": ": 8 of 8 such runs on record ended sure and 8 to 31 mm off",
    "estimated": ": 4 of 4 such runs on record ended 8 to 102 mm off",
    "corrected": ": 16 of 30 drawn mugs on record did",
    "trajectory": ": 2 of 100 drawn mugs on record did, 4 of 36 other objects",
}
"""What such runs came to in ideal conditions and in the plane; push_models.md, mugs without a slip sensor."""

_IN_SPACE = "each particle's own, by draws of how objects slide and topple"

_ENDED: dict[StopReason, str] = {
    "steps": "all actions are used up",
    "budget": "the time is up",
    "nothing to do": "no action was found worth doing",
    "interrupted": "the run was interrupted",
}
_TOLD = 0.05  # weight of a mode that counts as a rival
_LEVEL_M = 0.02  # above and below a level tool, that it touches


def relies_on(rummager: RummagerParts) -> str:
    """What a run takes for granted, in a line."""
    motion = rummager.filter.settings.motion
    moved = "measured" if motion == "measured" else f"not measured, {_taken(rummager)}"
    if rummager.senses_motion and motion == "trajectory":
        moved = f"sensed, as evidence of {_taken(rummager)}"
    reach = "none" if rummager.tool.reach is None else rummager.tool.reach.words
    known = f"motion: {moved}; reach: {reach}; push model: {_pushed_by(rummager)}; sensors: {rummager.sensors}"
    return known + (f"; conditions: {rummager.conditions}" if rummager.conditions else "")


def warnings(rummager: RummagerParts, history: Sequence[StepRecord] = ()) -> tuple[str, ...]:
    """What was not measured and can make a belief sure and wrong, from settings and from what came."""
    motion = rummager.filter.settings.motion
    missing = [str(record.step) for record in history[1:] if record.reading.object_motion is None]
    sensed = motion == "trajectory" and not missing and (rummager.senses_motion or len(history) > 1)
    if rummager.looks_again or sensed or _seen_again(history):
        return ()
    if motion != "measured":
        ideal = not rummager.conditions or rummager.conditions.startswith("ideal")
        drawn = motion == "trajectory" and rummager.tool.spatial  # on record under lab alone
        record, page = (_RECORD.get(motion, ""), "push_models") if ideal and not drawn else ("", "conditions")
        return (
            f"the object's motion is not measured, but {_taken(rummager)}, and no camera looks again: the belief may "
            f"end sure and wrong{record} (scripts/docs/results/{page}.md)",
        )
    if not missing:
        return ()
    plural = "s" if len(missing) > 1 else ""
    return (
        f"the object's motion was not measured in action{plural} {', '.join(missing)}, and no camera looks again: the "
        "belief may end sure and wrong (scripts/docs/results/push_models.md)",
    )


def _taken(rummager: RummagerParts) -> str:
    """How the motion comes about that is not measured."""
    motion = rummager.filter.settings.motion
    return _IN_SPACE if motion == "trajectory" and rummager.tool.spatial else _TAKEN[motion]


def _seen_again(history: Sequence[StepRecord]) -> bool:
    """Whether most actions that touched nothing saw the object's surface: a camera looks again."""
    free = [record.reading for record in history[1:] if not bool(record.reading.in_contact.any())]
    seen = sum(bool(reading.observation.of_class(Semantics.SURFACE).any()) for reading in free)
    return 2 * seen > len(free)


def why_not(
    rummager: RummagerParts, record: StepRecord, pose: PoseSummary, stopped_by: StopReason, doubt: str | None = None
) -> str | None:
    """Why a belief is not sure, by the parts of its stopping rule or else by a doubt; None where it is."""
    if stopped_by == "sure":
        return None
    ended = _ENDED.get(stopped_by, stopped_by)
    evidence = StopEvidence(
        record.expected_nll,
        record.fit,
        record.apc,
        rummager.model.diagonal,
        record.contacts,
        pose.probability,
        math.exp(rummager.filter.log_chance(record.belief)),
    )
    short = () if doubt and record.converged else shortfalls(rummager.stop_rule, evidence)
    if not short:
        return f"{doubt}; {ended}" if doubt else ended
    first = short[0]
    if first.part == "fit":
        return (
            f"no pose explains the observations (least discrepancy {first.value:.3g}, allowed {first.allowed:.3g}): "
            f"calibration, wrench sign, floor height, mesh? `rumi check` shows where; {ended}"
        )
    if first.part == "chance":
        return (
            f"no pose explains the observations (readings as unlikely as these have a chance of {first.value:.2g} at "
            f"most, {first.allowed:.2g} is asked for): was it knocked, did it fall, is it another mesh? {ended}"
        )
    if first.part == "contacts":
        return f"{first.value:.0f} actions touched the object, {first.allowed:.0f} are asked for; {ended}"
    if first.part == "rule":
        return f"the stop rule {rummager.stop_rule.rule!r} does not hold; {ended}"
    if rummager.stop_rule.rule == "probability" and first.part != "nll":
        return f"believed right with probability {first.value:.2f} at least, {first.allowed:.2f} is asked for; {ended}"
    if sum(mode.weight >= _TOLD for mode in pose.modes) > 1:
        return f"{_rivals(rummager, record, pose)}; {ended}"
    return (
        "one pose explains the observations, but not closely enough (the belief expects "
        f"{first.value:.3g}, allowed {first.allowed:.3g}): touch it where it was not touched; {ended}"
    )


def _rivals(rummager: RummagerParts, record: StepRecord, pose: PoseSummary) -> str:
    """Which poses explain the observations, how far they are apart, and what would tell the first two apart."""
    rivals = [mode for mode in pose.modes if mode.weight >= _TOLD]
    first, second = (mode.world_T_object for mode in rivals[:2])
    own = rummager.model.symmetries.to(torch.float64)
    metres, radians = se3.distance(own.nearest(second, first), first)
    shares = ", ".join(f"{mode.weight:.2f}" for mode in rivals)
    points = se3.apply(first, rummager.model.surface_points.to(first))
    height = record.reading.tool_pose[-1, 2, 3].to(first)
    level = (points[:, 2] - height).abs() <= _LEVEL_M
    if not rummager.tool.spatial and bool(level.any()):
        points = points[level]
    exact = rummager.model.exact
    with torch.no_grad():
        apart = exact.distance(se3.apply(se3.inverse(second), points).to(rummager.model.surface_points)).abs()
    best = int(apart.argmax())
    x, y, z = points[best].tolist()
    return (
        f"{len(rivals)} poses explain the observations ({shares} of the weight), the first two "
        f"{1e3 * float(metres):.0f} mm and {float(torch.rad2deg(radians)):.0f} degrees apart: a touch at "
        f"({x:.3f}, {y:.3f}, {z:.3f}) m would tell them apart, where the first has its surface and the second is "
        f"{1e3 * float(apart[best]):.0f} mm off"
    )


def _pushed_by(rummager: RummagerParts) -> str:
    """The planner's push model, as far as it plans by one."""
    name = getattr(getattr(rummager.policy, "settings", None), "push_model", None)
    if name != "auto":
        return name or "none"
    upright = rummager.filter.search == "SE(2)" and not rummager.tool.spatial
    return "quasi-static" if upright else "displacement"
