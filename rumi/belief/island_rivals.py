"""Rivals of islands: an object that may topple in other sizes, each size a population of a filter of its own.

What rivals are `rumi.belief.rival_filters` has. Estimates of the evidence in space differ by 5 to 20 nats where nothing
but the draws does (`rumi.belief.island_filter`), so that a power of their ratio counts. Where a run would not be sure
by it the likeliest size has new populations, as many as the belief, and no fault further ones: all of a belief may have
lost where the object is.
"""

from collections.abc import Mapping, Sequence

import torch

from rumi.belief import rival_filters
from rumi.belief.island_filter import IslandFilter
from rumi.belief.rival_filters import FURTHER, NO_FAULT, SIZES, Rival, followed
from sdf.grid_sdf import GridSDF
from sensors.reading import Reading

POWER = 0.5
"""Of the likelihood ratio of a size against no fault: ratios to a power below 1 keep a test's bound."""


def begun(pose_filter: IslandFilter, generator: torch.Generator) -> tuple[Rival, ...]:
    """A population of each other size, before the first reading; none of an object whose distances are not tabulated.

    Args:
        pose_filter: of no fault.
        generator: of the draws.
    """
    if not isinstance(pose_filter.model.sdf, GridSDF):
        return ()
    others = [pose_filter.supposing(model=pose_filter.model.resized(factor)) for factor in SIZES]
    return tuple(Rival.of("another size", len(SIZES), other, other.drawn(generator)) for other in others)


@torch.no_grad()
def doubted(
    pose_filter: IslandFilter, rivals: Sequence[Rival], readings: Sequence[Reading], generator: torch.Generator
) -> tuple[Rival, ...]:
    """The rivals with further populations of no fault, and with others of the likeliest, which was so by its draws.

    Args:
        pose_filter: of no fault.
        rivals: after all readings, one of each size.
        readings: since the first.
        generator: of the draws.
    """
    best = max(rivals, key=lambda each: each.log_evidence)
    count, other = pose_filter.own.islands, best.pose_filter
    assert isinstance(other, IslandFilter)
    more = tuple(Rival.of(NO_FAULT, 1, pose_filter, pose_filter.drawn(generator)) for _ in range(FURTHER))
    more += tuple(Rival.of(best.name, count * len(SIZES), other, other.drawn(generator)) for _ in range(count))
    for reading in readings:
        more = followed(more, reading, generator)
    return (*more, *(each for each in rivals if each is not best))


def log_ratios(rivals: Sequence[Rival], own: float) -> Mapping[str, float]:
    """What `rumi.belief.rival_filters.log_ratios` has, to a power that bears what the estimates err by."""
    return {name: POWER * ratio for name, ratio in rival_filters.log_ratios(rivals, own).items()}
