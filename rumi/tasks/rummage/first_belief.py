"""First belief: of a first view the poses that fit it, without one the prior (RUMI, Alg 1, lines 1-3)."""

import torch

from rumi.belief.initialise import initialise, view_starts
from rumi.belief.particles import PoseBelief
from rumi.belief.reinitialise import prior_belief
from rumi.tasks.rummage.parts import RummagerParts
from sensors.observation import Observation, merge
from sensors.reading import Reading
from sensors.semantics import Semantics


def first_belief(
    rummager: RummagerParts, reading: Reading, *, generator: torch.Generator
) -> tuple[PoseBelief, Observation]:
    """The belief and the memory after the first view, or without one from the prior (Alg 1, lines 1-3)."""
    points = reading.observation.points
    none = Observation.empty(dtype=points.dtype, device=points.device)
    memory, _ = merge(none, reading.observation, rummager.filter.lattice)
    if rummager.filter.prior is not None:
        belief = prior_belief(rummager.filter, memory, rummager.initialise.particles, generator=generator)
        return rummager.filter.begin(belief, memory, generator=generator), memory
    if not bool(memory.of_class(Semantics.SURFACE).any()):
        raise ValueError("Expected a first view with surface points of the object, got none: check the object's mask")
    belief = seen_belief(rummager, memory, generator=generator)
    return rummager.filter.begin(belief, memory, generator=generator), memory


def seen_belief(rummager: RummagerParts, memory: Observation, *, generator: torch.Generator) -> PoseBelief:
    """Poses that fit the points of the surface in memory, of which there must be some."""
    surface, settings = memory.points[memory.of_class(Semantics.SURFACE)], rummager.initialise
    reach_m = float(rummager.model.surface_points[:, :2].norm(dim=-1).max())
    starts = view_starts(surface, settings.starts, reach_m, rummager.height_m, generator=generator)
    return initialise(
        rummager.filter.discrepancy,
        memory,
        starts,
        rummager.filter.search,
        rummager.filter.settings.peakiness,
        settings,
        generator=generator,
    )
