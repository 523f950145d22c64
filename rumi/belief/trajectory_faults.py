"""Log-likelihood ratios of named faults against the belief of an upright object's trajectories, for each reading.

A fault is a predictive density of its own: where the object may be after what came before, and what the hand then
feels. "No fault" is what the filter adds up itself while it takes the reading in (the marginal likelihood of sequential
Monte Carlo); a knocked object is importance sampling of the belief before the reading, moved about. All count a point
as the independent readings that it is worth to the filter, so that a ratio is a product of powers of ratios, which have
a mean of 1 at most where the filter's prediction is right.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.predicted_action import followed, predicted
from rumi.belief.pushed_model import Pushed
from rumi.belief.segments import besides, seen_besides
from rumi.belief.sensed_motion import USUAL_NATS
from rumi.belief.stuck_hand import Told
from rumi.belief.tempering import log_mean
from rumi.belief.trajectory_history import History, Kind
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.sliding import rotated
from rumi.resampling import resample_systematic, systematic
from rumi.seeding import normal
from sensors.reading import Reading

TRAJECTORY_FAULTS = (
    "knocked",
    "absent",
    "dead hand",
    "false contacts",
    "push model off",
    "stuck hand",
    "second object",
    "stale camera",
)
"""The object is elsewhere near by; it is gone; the hand feels nothing; it feels what is not there, briefly; the object
slides as no prior has it: friction or mass far from what is expected; the hand feels the same all the time; something
else is felt where the object is not; the camera repeats its last view to the digit."""

FALSE = 0.3
"""Share of the actions with a false contact, where there are such."""

ALIKE = 0.001
"""Chance that something that stands in the way is felt alike all the way."""

_DRAWS = 900  # poses to which a knock may have moved the object, at least
_UNLIKELY = 5.0  # nats that an action is unlikely by, from which on that is worked out twice
_APART_M = 0.01  # between places of the hand that feel something at one instant and the next, where it is not the same
_TELLS = 1.0  # nats that a reading is short of what fits best, from which on something can be told from it
_BRIEF = 0.8, 0.1  # chance that a false contact, and a true one, lasts for two instants at most
AN_INSTANT, _PADS = 2, 2  # instants that a brief contact lasts at most, and pads of a hand
UNMET_M = 0.012  # from the surface of every particle: what is felt there is felt by none
_STRAINED = 15.0  # nats that an action is unlikely by, from which on the push model is asked about
_USUAL = 0.5  # share of the actions of a wrong push model that look as usual
_HIDDEN = 0.05  # chance that a camera sees nothing of an object that is there
_NO_REPEAT = Told(-math.inf, -math.inf)


def new_segments(before: Trajectories, after: Trajectories) -> int:
    """How many segments a reading added to the history; 0 where it was begun anew."""
    added = after.forgotten + len(after.history) - before.forgotten - len(before.history)
    return added if 0 < added <= len(after.history) else 0


@torch.no_grad()
def log_ratios(
    before: Trajectories,
    log_weights: Float[Tensor, "N"],
    after: Trajectories,
    pose_filter: PoseTrajectoryFilter,
    own: MisfitSettings,
    *,
    generator: torch.Generator,
    looks: tuple[Reading, Reading] | None = None,
    stuck: Told = _NO_REPEAT,
) -> Float[Tensor, "K"]:
    """Log-likelihood ratio of each of `TRAJECTORY_FAULTS` against the belief, nats; 0 where a reading tells nothing.

    Args:
        before: particles before the reading.
        log_weights: of them.
        after: particles that have taken it in.
        pose_filter: of both.
        own: how far a knock goes, and how often a contact means nothing even so.
        generator: of the draws.
        looks: the readings before and of the action, where a camera looks after every action; None else.
        stuck: what the action tells of a stuck hand, which counts whether or not it tells anything else.
    """
    told = dict.fromkeys(TRAJECTORY_FAULTS, 0.0) | {"stuck hand": stuck.ratio}
    new = new_segments(before, after)
    if not new:
        return _tensor(told)
    model, sensed = pose_filter.model, pose_filter.own
    history = after.history.since(len(after.history) - new)
    none = after.log_evidence - before.log_evidence
    felt = bool((history.kind == Kind.FELT).any())
    if felt and none < -_UNLIKELY:  # an estimate that errs by nats: the mean of two
        again = predicted(before, log_weights, history, pose_filter, generator).log_evidence
        none = float(np.logaddexp(none, again)) - math.log(2.0)
    gone, dead = without_feeling(history, sensed)
    seen = history.kind == Kind.SEEN
    if looks is not None and not bool(seen.any()):  # all else has the object hidden, and not where the view is free
        gone, seen = gone - math.log(_HIDDEN), history.kind == Kind.FREE
    if bool(seen.any()):  # the object is there and as hard to foresee, whatever the hand feels
        shown = replace(history.unsensed(), weight=history.weight.masked_fill(~seen, 0.0))
        dead += predicted(before, log_weights, shown, pose_filter, generator).log_evidence
    told |= {"absent": gone - none, "dead hand": dead - none}
    if felt:
        unmet = unmet_instants(after, history, model)
        told |= {
            "false contacts": by_false_contacts(len(unmet), own, stated_false(len(history.tool), sensed)),
            "push model off": math.log(_USUAL),
            "second object": math.log1p(-FALSE),
        }
        if len(unmet) > 2:
            beside = sum(log_beside(before, log_weights, history, unmet, pose_filter, generator)) - none
            told["second object"] = math.log(FALSE) + beside
            if stuck.repeated > _TELLS:  # it feels on the object, anywhere, or beside what is felt as usual, as likely
                told["second object"] += math.log(ALIKE)
                either = np.logaddexp(stuck.ratio + math.log(2.0), stuck.repeated + beside)
                told["stuck hand"] = float(either) - math.log(3.0)
    repeated = looks is not None and _repeats(*looks, pose_filter)
    if not repeated:
        told["stale camera"] = -math.inf
    if none > -_TELLS:
        return _tensor(told).clamp_max(_TELLS)
    if repeated:
        blind = replace(history, weight=history.weight.masked_fill(history.kind == Kind.SEEN, 0.0))
        misses = predicted(before, log_weights, blind, pose_filter, generator).log_evidence - none
        # a view that does not fit is no repetition by chance; one that does may well be, of what stands still
        told["stale camera"] = misses - (math.log(own.outlier) if misses > _TELLS else 0.0)
    told["knocked"] = log_knocked(before, log_weights, history, pose_filter, own, generator) - none
    if felt and none < -_STRAINED:
        doubting = pose_filter.doubting()
        told["push model off"] = predicted(before, log_weights, history, doubting, generator).log_evidence - none
    return _tensor(told)


def _tensor(told: Mapping[str, float]) -> Float[Tensor, "K"]:
    return torch.tensor([told[name] for name in TRAJECTORY_FAULTS], dtype=torch.float64)


def by_false_contacts(unmet: int, own: MisfitSettings, stated: float) -> float:
    """Log-likelihood ratio of false contacts, by the instants at which something was felt where nothing is.

    Pads that are stated to feel falsely now and then do so for an instant: that is no fault, unless it comes often.
    """
    if not unmet:
        return math.log1p(-FALSE)
    brief = unmet <= AN_INSTANT
    lasts, lasts_else = _BRIEF if brief else (1.0 - _BRIEF[0], 1.0 - _BRIEF[1])
    none = own.outlier * lasts_else + (stated if brief else 0.0)
    return math.log(FALSE * lasts / none)


def by_brief_touch(own: MisfitSettings, stated: float) -> float:
    """Log-likelihood ratio of something unknown that is felt briefly, against pads that feel falsely as stated."""
    return math.log(_BRIEF[1] / (own.outlier * _BRIEF[1] + stated))


def stated_false(instants: int, sensed: PoseTrajectorySettings) -> float:
    """Chance that pads which are as they are stated to be feel something false in an action of so many instants."""
    return -math.expm1(_PADS * instants * math.log1p(-sensed.false))


def _repeats(last: Reading, reading: Reading, pose_filter: PoseTrajectoryFilter) -> bool:
    """Whether an action's view is the last one again, to the digit, but for what the pads are at."""
    old, new = (seen_besides(one, pose_filter.model, pose_filter.own) for one in (last, reading))
    old = besides(old, reading.tool_pose[-1], pose_filter.model, pose_filter.own)
    new = besides(new, last.tool_pose[-1], pose_filter.model, pose_filter.own)
    return len(old) > 0 and old.points.equal(new.points)


def log_beside(
    before: Trajectories,
    log_weights: Float[Tensor, "N"],
    history: History,
    unmet: Sequence[int],
    pose_filter: PoseTrajectoryFilter,
    generator: torch.Generator,
) -> tuple[float, float]:
    """Log-likelihoods of what was felt at some instants, of something else than the object, and of the rest."""
    at = torch.searchsorted(history.point_ends, torch.arange(len(history.points)), right=True)
    others = torch.isin(at, torch.tensor(unmet))
    strange = float(history.weight[others & (history.kind == Kind.FELT)].sum())
    rest = replace(history, weight=history.weight.masked_fill(others, 0.0))
    told = predicted(before, log_weights, rest, pose_filter, generator).log_evidence
    return strange * math.log(pose_filter.own.outliers), told


def without_feeling(history: History, sensed: PoseTrajectorySettings) -> tuple[float, float]:
    """Log-likelihoods of a reading without an object, and of one by a hand that feels nothing.

    They are the same but for what a camera sees, which is counted of an absent object alone.
    """
    never, always = math.log(sensed.outliers), math.log1p(-sensed.outliers)
    worth = history.worth().sum(0)
    each = worth.new_zeros(len(Kind))
    each[Kind.FELT] = each[Kind.PAD_FELT] = never
    each[Kind.PAD_CLEAR] = each[Kind.PAD_SILENT] = always
    dead = float(worth @ each) + USUAL_NATS * float(history.motion_power.sum())  # whatever a sensor of motion told
    return dead + never * float(worth[Kind.SEEN]), dead


def unmet_instants(after: Trajectories, history: History, model: Pushed) -> list[int]:
    """Instants of the last segments at which the hand felt something where no particle has a surface.

    Not where it goes on feeling what it felt at a surface just before: that slid away.
    """
    found, first = [], len(after.history) - len(history)
    held: Tensor | None = None  # where on the hand a surface was felt, up to the instant before
    for segment in range(len(history)):
        begin, end = (int(history.ends[at]) if at >= 0 else 0 for at in (segment - 1, segment))
        poses = torch.cat((after.poses[:, first + segment], after.poses[:, first + segment + 1]))
        for instant in range(begin, end):
            points = _felt_at(history, instant)
            if not len(points):
                held = None
                continue
            off = median_off(poses, points, model)
            place = _on_hand(points, history.tool[instant, 1])
            met = float(off.min()) <= UNMET_M
            if met or (held is not None and float((held - place).norm()) < _APART_M):
                held = place
            else:
                held = None
                found.append(instant)
    return found


def last_contact_off(after: Trajectories, new: int, pose_filter: PoseTrajectoryFilter) -> float:
    """How far what the hand felt last, in so many new segments, is from where the nearest particle has it felt, metres.

    The middle one of its points; 0 where nothing was felt, or nothing but what pads are stated to feel falsely.
    """
    history, model = after.history, pose_filter.model
    false = unmet_instants(after, history.since(len(history) - new), model) if new and pose_filter.own.false else []
    before = int(history.ends[len(history) - new - 1]) if new < len(history) else 0
    strange = {before + instant for instant in false} if len(false) <= AN_INSTANT else set()
    for segment in reversed(range(len(history) - new, len(history))):
        begin, end = (int(history.ends[at]) if at >= 0 else 0 for at in (segment - 1, segment))
        for instant in reversed(range(begin, end)):
            points = _felt_at(history, instant)
            if len(points) and instant not in strange:
                poses = torch.cat((after.poses[:, segment], after.poses[:, segment + 1]))
                return float(median_off(poses, points, model, pose_filter.own.felt_m).min())
    return 0.0


def median_off(
    poses: Float[Tensor, "n d"], points: Float[Tensor, "m 3"], model: Pushed, felt_m: float = 0.0
) -> Float[Tensor, "n"]:
    """Median distance of felt points from the surface of an object at some poses, or from where it is felt, metres."""
    return (model.sdf.distance(model.local(poses, points).to(model.sdf.bounds)) - felt_m).abs().median(-1).values


def _felt_at(history: History, instant: int) -> Float[Tensor, "m 3"]:
    low, high = (int(history.point_ends[at]) if at >= 0 else 0 for at in (instant - 1, instant))
    return history.points[low:high][history.kind[low:high] == Kind.FELT]


def _on_hand(points: Float[Tensor, "m 3"], tool: Float[Tensor, "C"]) -> Float[Tensor, "2"]:
    """Middle of points, seen from above in the hand's own frame."""
    return rotated(points[:, :2].mean(0) - tool[:2], -tool[2])


def log_knocked(
    before: Trajectories,
    log_weights: Tensor,
    history: History,
    pose_filter: PoseTrajectoryFilter,
    own: MisfitSettings,
    generator: torch.Generator,
) -> float:
    """Log predictive density of a reading where the object was knocked before it.

    Importance sampling of where it began, by the first segment; then sequential Monte Carlo.
    """
    draws = max(_DRAWS, len(before))
    moves = normal((draws, 3), generator=generator, dtype=torch.float64)
    rows = systematic(log_weights.double(), 0.5, draws)
    start = before.pose[rows].clone()
    start[:, :3] += moves * moves.new_tensor((own.knock_m, own.knock_m, own.knock_rad))
    first = History.empty(history.tool.shape[-1]).appended(history.segment(0))
    drawn = Trajectories.drawn(start, first, generator, systematic=before.systematic[rows])
    drawn = drawn.replayed(pose_filter.model, pose_filter.own, first, torch.zeros(draws, dtype=torch.long))
    gained = drawn.log_likelihood[:, 0]
    begun = drawn.at(resample_systematic(gained, len(before), generator=generator))
    begun = replace(begun, log_evidence=log_mean(torch.zeros_like(gained), gained))
    return followed(begun, history, pose_filter, generator).log_evidence
