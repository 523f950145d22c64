"""How a fused run's belief follows its readings, one after the other: the same steps live and from a log."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.renewal import challenge
from rumi.clock import Clock
from rumi.errors import UsageError
from rumi.fused.evidence import FeltSoFar
from rumi.fused.finder import Finder
from rumi.fused.reading import FusedReading
from rumi.loop import first_belief
from rumi.planning.types import Plan
from rumi.records import StepRecord
from rumi.registration.initialise import initialise, view_starts
from rumi.scoring import observe
from rumi.seeding import split
from rumi.task import StepResult
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
        felt: what is no points, in the same frame.
    """

    belief: PoseBelief
    memory: Observation
    felt: FeltSoFar


def belief_streams(seed: int) -> Random:
    """The random streams that beliefs are made with."""
    return {name: split(seed, name) for name in ("initialise", "filter", "renewal")}


def begin(finder: Finder, reading: Reading, *, random: Random) -> Followed:
    """After the first view."""
    rummager, generator = finder.rummager, random["initialise"]
    felt = FeltSoFar.nothing(rummager.model.sdf, finder.settings, len(finder.surface))
    belief, memory = first_belief(rummager, reading, generator=generator)
    return Followed(_seen(finder, belief, memory, generator=generator), memory, felt)


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
    if not isinstance(reading, FusedReading) or reading.object_motion is None:
        raise UsageError(f"Expected readings of a fused run, with the object's motion, got a {type(reading).__name__}")
    renewal, generator = rummager.renewal, random["renewal"]
    with clock("belief"):
        belief, memory = known.belief, known.memory
        rides = reading.object_motion @ belief.world_T_attached
        felt = known.felt.joined(reading, rides, finder.surface, settings)
        fused = finder.filter.with_evidence(felt)
        belief, memory, info = fused(belief, memory, reading, generator=random["filter"])
        located = last.contacts >= settings.renewals and bool(memory.of_class(Semantics.SURFACE).any())
        if bool(reading.in_contact.any()) and not located:
            belief = challenge(fused, belief, memory, renewal, generator=generator)
    done = (control, plan, bool(info.resampled))
    record = observe(rummager, clock, history, result, belief, info.added, *done)
    if record.converged:
        clock.put_back(record.timings_s)
        with clock("belief"):
            belief = challenge(fused, belief, memory, renewal, generator=generator)
        record = observe(rummager, clock, history, result, belief, info.added, *done)
    return replace(known, belief=belief, memory=memory, felt=felt), record


def _seen(finder: Finder, belief: PoseBelief, memory: Observation, *, generator: torch.Generator) -> PoseBelief:
    """All poses that a first view leaves, weighed by the prior too; the belief itself where nothing was seen."""
    rummager, fused = finder.rummager, finder.filter
    surface, own = memory.points[memory.of_class(Semantics.SURFACE)], rummager.initialise
    if len(surface) == 0:
        return belief
    reach_m = float(rummager.model.surface_points[:, :2].norm(dim=-1).max())
    starts = view_starts(surface, own.starts, reach_m, rummager.height_m, generator=generator)
    peakiness = fused.settings.peakiness
    found = initialise(fused.discrepancy, memory, starts, fused.search, peakiness, own, generator=generator)
    return fused.weigh(found, found, memory, memory, torch.zeros((), dtype=torch.bool))
