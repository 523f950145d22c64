"""How a fused run's belief follows its readings, one after the other: the same steps live and from a log."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.initialise import initialise, view_starts
from rumi.belief.particles import PoseBelief
from rumi.belief.reinitialise import challenge
from rumi.clock import Clock
from rumi.errors import UsageError
from rumi.loop import first_belief
from rumi.planning.policy import Plan
from rumi.records import StepRecord
from rumi.seeding import split
from rumi.task import StepResult
from rumi.tasks.handle.finder import Finder
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.scoring import observe
from rumi.weights import boltzmann
from sensors.contact_reading import ContactReading
from sensors.evidence import EvidenceSet
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

Random = Mapping[str, torch.Generator]


@dataclass(frozen=True)
class Followed:
    """All that is known after a reading, and that the next one is taken in with.

    Attributes:
        belief: where the mug may be.
        memory: points so far, in the frame that rides with it.
    """

    belief: PoseBelief
    memory: Observation


def belief_streams(seed: int) -> Random:
    """The random streams that beliefs are made with."""
    return {name: split(seed, name) for name in ("initialise", "filter", "renewal")}


def begin(finder: Finder, reading: Reading, *, random: Random) -> Followed:
    """After the first view."""
    rummager, generator = finder.rummager, random["initialise"]
    belief, memory = first_belief(rummager, reading, generator=generator)
    belief = replace(_seen(rummager, belief, memory, generator=generator), evidence=EvidenceSet())
    return Followed(belief, memory)


def follow(
    finder: Finder,
    known: Followed,
    clock: Clock,
    history: Sequence[StepRecord],
    result: StepResult,
    control: Float[Tensor, "A"],
    plan: Plan,
    *,
    random: Random,
) -> tuple[Followed, StepRecord]:
    """After an action: its reading taken in, and where that makes the belief sure, rivals drawn anew beside it.

    Args:
        finder: how.
        known: after the reading before.
        clock: what it lasts is told to.
        history: records so far.
        result: of the action.
        control: that was carried out.
        plan: that it is of.
        random: `belief_streams`.

    Raises:
        UsageError: a reading of another kind of run.
    """
    rummager, settings, reading, last = finder.rummager, finder.settings, result.reading, history[-1]
    if not isinstance(reading, ContactReading) or reading.object_motion is None:
        raise UsageError(f"Expected readings of a fused run, with the object's motion, got a {type(reading).__name__}")
    renewal, generator = rummager.renewal, random["renewal"]
    with clock("belief"):
        belief, memory, info = rummager.filter(known.belief, known.memory, reading, generator=random["filter"])
        located = last.contacts >= settings.renewals and bool(memory.of_class(Semantics.SURFACE).any())
        if bool(reading.in_contact.any()) and not located:
            belief = challenge(rummager.filter, belief, memory, renewal, generator=generator)
    done = (control, plan, bool(info.resampled))
    record = observe(rummager, clock, history, result, belief, info.added, *done)
    if record.converged:
        clock.put_back(record.timings_s)
        with clock("belief"):
            belief = challenge(rummager.filter, belief, memory, renewal, generator=generator)
        record = observe(rummager, clock, history, result, belief, info.added, *done)
    return Followed(belief, memory), record


def _seen(rummager: Rummager, belief: PoseBelief, memory: Observation, *, generator: torch.Generator) -> PoseBelief:
    """All poses that a first view leaves, weighed by the prior too; the belief itself where nothing was seen."""
    pose_filter = rummager.filter
    surface, own = memory.points[memory.of_class(Semantics.SURFACE)], rummager.initialise
    if len(surface) == 0:
        return belief
    reach_m = float(rummager.model.surface_points[:, :2].norm(dim=-1).max())
    starts = view_starts(surface, own.starts, reach_m, rummager.height_m, generator=generator)
    peakiness = pose_filter.settings.peakiness
    found = initialise(pose_filter.discrepancy, memory, starts, pose_filter.search, peakiness, own, generator=generator)
    total = pose_filter.total(found, memory)
    return replace(found, discrepancy=total).reweighted(boltzmann(total, peakiness))
