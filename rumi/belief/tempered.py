"""Evidence too sharp for the particles at hand, let in little by little, so that no mode is lost by chance.

Where a reading is far more exact than particles are apart, the one that happens to be nearest to some mode takes all
weight, and every other mode dies with its particles. Raised to a small power the likelihood lets many live on; moves
bring them nearer before the power grows.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.static_filter import StateEvidence, StaticBelief, StaticFilter
from rumi.errors import DegenerateBeliefError
from rumi.resampling import resample_systematic
from rumi.weights import effective_sample_size

_KEPT = 0.5
"""Share of the effective sample size that is left after each rise of the power."""
_HALVINGS = 40
"""Of the interval that the next power is looked for in."""


@dataclass(frozen=True)
class Tempered:
    """All evidence, the new part of it to a power.

    Attributes:
        every: all evidence, the new one included.
        new: what came now.
        power: of its likelihood, in [0, 1].
    """

    every: StateEvidence
    new: StateEvidence
    power: float

    def log_likelihood(self, states: Float[Tensor, "N ..."], /) -> Float[Tensor, "N"]:
        """Of each state, up to a constant, nats."""
        whole = self.every.log_likelihood(states)
        # what cannot be at all cannot be by any power
        less = (1.0 - self.power) * self.new.log_likelihood(states)
        return torch.where(whole > -torch.inf, whole - less, whole)


def update_tempered(
    follow: StaticFilter,
    belief: StaticBelief,
    new: StateEvidence,
    every: StateEvidence,
    *,
    power: float = 0.0,
    generator: torch.Generator,
) -> StaticBelief:
    """Weigh by new evidence in as many steps as it takes, resampling and moving particles between them.

    Args:
        follow: the filter, of something that does not move: one without noise.
        belief: before; weighed by the new evidence to the given power already.
        new: evidence that came now.
        every: all evidence so far, the new one included.
        power: that the belief has of the new evidence.
        generator: of all draws.

    Raises:
        DegenerateBeliefError: no particle is possible any more.
    """
    while power < 1.0:
        told = new.log_likelihood(belief.states)
        rise = _rise(belief.log_weights, told, 1.0 - power)
        power = 1.0 if rise == 1.0 - power else power + rise
        partly = Tempered(every, new, power)
        log = belief.log_weights + rise * told
        belief = StaticBelief(belief.states, log.log_softmax(-1), belief.log_target + rise * told)
        ess = belief.ess
        if ess < follow.settings.trigger * len(log):
            index = resample_systematic(belief.log_weights, generator=generator)
            belief = follow.start(belief.states[index], evidence=partly)
            belief, _ = follow.moved(belief, partly, ess=ess, generator=generator)
    return belief


def _rise(log_weights: Float[Tensor, "N"], told: Float[Tensor, "N"], most: float) -> float:
    """By how much the power may grow."""
    held = (log_weights > -torch.inf) & (told > -torch.inf)
    if not bool(held.any()):
        raise DegenerateBeliefError("No particle explains the reading: more particles, or noise that fits the sensor")
    log, told = log_weights[held], told[held]
    told = told - told.max()
    least = _KEPT * effective_sample_size(log)
    low, high = 0.0, most
    if effective_sample_size(log + high * told) >= least:
        return most
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_sample_size(log + middle * told) >= least else (low, middle)
    return high
