"""Log-likelihood ratios of named faults against the belief of islands, for each reading of an object that may topple.

Each fault is a predictive density of the action by each population, as of upright objects
(`rumi.belief.trajectory_faults`); that of the belief is their mixture, by the shares that they had. "No fault" is what
the filter adds up itself. Where that is little, or where silence is unlikely, it is worked out again from particles of
which none jumps: the filter has a share of them jump, as no push model has it, and what jumps explain is what is asked
about. So the ratios are not against the filter's own prediction everywhere: how often they raise an alarm is measured,
not proven.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.bootstrap_filter import BootstrapBelief
from rumi.belief.island_filter import IslandBelief, IslandFilter, islands_of
from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.predicted_action import predicted
from rumi.belief.segments import cut, felt_pads, path_of, pushed
from rumi.belief.stuck_hand import Told
from rumi.belief.trajectory_faults import (
    ALIKE,
    AN_INSTANT,
    FALSE,
    UNMET_M,
    by_false_contacts,
    log_beside,
    log_knocked,
    median_off,
    new_segments,
    stated_false,
    unmet_instants,
    without_feeling,
)
from rumi.belief.trajectory_history import History
from rumi.resampling import systematic
from sensors.reading import Reading
from sensors.semantics import Semantics

ISLAND_FAULTS = ("knocked", "absent", "dead hand", "false contacts", "second object", "stuck hand")
"""The object is elsewhere near by; it is gone; the hand feels nothing; it feels what is not there, briefly; something
else is felt where the object is not; the hand feels the same all the time."""

_TELLS = 1.0  # nats: that silence is unlikely by from which on it is asked about; of a hand that repeats itself
_UNLIKELY = -12.0  # nats of an action with contact; at the true poses hardly any is below (results/push_models.md)
_AS_FELT = -2.0  # nats of a knock by an action with contact that is likely without one; -3 in the median
_ASKED, _TRACKS = 100, 24  # particles of a population that are asked where they have a surface, and which points tell
_ASKED_FIRST, _FEW = 1000, 0.05  # the same at a first touch, and share of them that may have one where it is false


class _Densities(NamedTuple):
    """Log predictive densities of an action by a population.

    Attributes:
        none: without a fault.
        faults: ratio of each fault against that.
        as_stated: without a fault, where pads feel something false as often as they are stated to.
    """

    none: float
    faults: Mapping[str, float]
    as_stated: float


@torch.no_grad()
def log_ratios(
    before: IslandBelief,
    after: IslandBelief,
    reading: Reading,
    pose_filter: IslandFilter,
    own: MisfitSettings,
    *,
    generator: torch.Generator,
    stuck: Told,
) -> Float[Tensor, "K"]:
    """Log-likelihood ratio of each of `ISLAND_FAULTS` against the belief, nats; 0 where a reading tells nothing.

    Args:
        before: populations before the reading.
        after: those that have taken it in.
        reading: of the action.
        pose_filter: of both.
        own: how far a knock goes, and how often a contact means nothing even so.
        generator: of the draws.
        stuck: what the action tells of a stuck hand.
    """
    pairs = zip(islands_of(before), islands_of(after), strict=True)
    each = [_densities(last, now, reading, pose_filter, own, generator, stuck) for last, now in pairs]
    shares = pose_filter.log_shares(islands_of(before)).numpy()
    none, as_stated = (_log_sum(shares + [getattr(one, part) for one in each]) for part in ("none", "as_stated"))
    found = []
    for name in ISLAND_FAULTS[:-1]:
        fault = _log_sum(shares + [one.none + one.faults[name] for one in each])
        found.append(fault - (as_stated if name == "false contacts" else none))
    return torch.tensor([*found, stuck.ratio], dtype=torch.float64)


def _log_sum(logs: Float[np.ndarray, "n"]) -> float:
    return float(np.logaddexp.reduce(logs))


def _densities(
    last: BootstrapBelief,
    now: BootstrapBelief,
    reading: Reading,
    pose_filter: IslandFilter,
    own: MisfitSettings,
    generator: torch.Generator,
    stuck: Told,
) -> _Densities:
    """Densities of an action by a population before it and after it.

    Of a first touch "no fault" is too likely, since particles are brought to what was felt: it is no evidence of one.
    """
    (before, log_weights), (after, _) = pose_filter.particles_of(last), pose_filter.particles_of(now)
    faults, felt = dict.fromkeys(ISLAND_FAULTS, 0.0), bool(reading.in_contact.any())
    none, new = after.log_evidence - before.log_evidence, new_segments(before, after)
    if before.apart and _is_brief(reading) and pose_filter.own.false > 0:
        faults |= _first_touch_of_nothing(before, log_weights, reading, pose_filter, own)
    if not new and (before.apart or not after.apart):  # nothing sensed, or a first touch that fits none
        return _Densities(none, faults, none)
    expected = after
    history = after.history.since(len(after.history) - new) if new else None
    if history is None:  # begun anew
        history = _history(before, log_weights, reading, pose_filter)
    gone, dead = without_feeling(history, pose_filter.own)
    unlikely = not new or (none < _UNLIKELY if felt else gone - none > _TELLS)
    if unlikely and not before.apart:
        expected = predicted(before, log_weights, history, pose_filter, generator)
        none = expected.log_evidence
    faults |= {"absent": gone - none, "dead hand": dead - none}
    if before.apart:
        return _Densities(none, faults, none)
    as_stated = none
    if felt:
        some = expected.at(systematic(torch.zeros(len(expected), dtype=torch.float64), 0.5, _ASKED))
        unmet = unmet_instants(some, history, pose_filter.model)
        against = by_false_contacts(len(unmet), own, stated_false(len(history.tool), pose_filter.own))
        faults |= {"false contacts": against, "second object": math.log1p(-FALSE)}
        if unmet:
            strange, rest = log_beside(before, log_weights, history, unmet, pose_filter, generator)
            faults["false contacts"] = math.log(FALSE) + rest - none
            as_stated = math.log(FALSE) + rest - against
            if len(unmet) > 2:  # met at any of the instants, alike
                faults["second object"] = math.log(FALSE / len(reading.in_contact)) + strange + rest - none
                faults["second object"] += math.log(ALIKE) if stuck.repeated > _TELLS else 0.0
    if unlikely:
        faults["knocked"] = log_knocked(before, log_weights, history, pose_filter, own, generator) - none
    elif felt:
        faults["knocked"] = _AS_FELT
    return _Densities(none, faults, as_stated)


def false_touch(ratios: Float[Tensor, "K"], reading: Reading, pose_filter: IslandFilter) -> bool:
    """Whether what an action felt is most likely a touch as pads are stated to feel it falsely now and then.

    Args:
        ratios: of the action, of `ISLAND_FAULTS`.
        reading: of the action.
        pose_filter: of the belief.
    """
    false, knocked = (float(ratios[ISLAND_FAULTS.index(name)]) for name in ("false contacts", "knocked"))
    return false > max(_TELLS, knocked) and _is_brief(reading) and pose_filter.own.false > 0


def _is_brief(reading: Reading) -> bool:
    return 0 < int(reading.in_contact.sum()) <= AN_INSTANT


def _first_touch_of_nothing(
    before: Trajectories,
    log_weights: Float[Tensor, "M"],
    reading: Reading,
    pose_filter: IslandFilter,
    own: MisfitSettings,
) -> Mapping[str, float]:
    """Ratio of false contacts by a brief first touch; none where more than a few particles have a surface there.

    A prior reaches far: no place is without any particle, and a brief touch of few is less likely than a false one.
    """
    model, sensed = pose_filter.model, pose_filter.own
    poses = before.pose[systematic(log_weights, 0.5, min(_ASKED_FIRST, len(before)))]
    points = reading.observation.points[reading.observation.of_class(Semantics.SURFACE)]
    if not len(points):  # touched, and nobody knows where
        return {}
    if float((median_off(poses, points.to(poses), model) <= UNMET_M).double().mean()) > _FEW:
        return {}
    stated = stated_false(len(reading.tool_pose), sensed)
    return {"false contacts": by_false_contacts(int(reading.in_contact.sum()), own, stated)}


def _history(
    now: Trajectories, log_weights: Float[Tensor, "M"], reading: Reading, pose_filter: IslandFilter
) -> History:
    """An action's history by the particles before it: of points that tell where the prior's median has them go."""
    model, own = pose_filter.model, pose_filter.own
    path, felt, history = path_of(reading, model), felt_pads(reading, model, own), History.empty(4)
    tracks = model.tracks(own, now.pose[systematic(log_weights, 0.5, min(_TRACKS, len(now)))], path)
    for instants in cut(reading, own):
        segment = pushed(reading, instants, path, felt, tracks[:, instants], model, own)
        history = history.appended(segment, opens=not len(history))
    return history
