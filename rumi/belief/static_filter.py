"""Resample-move particle filter of a static state: readings weigh it, and nothing else changes it.

Without motion there is nothing to predict and no noise to add (time allocation, Eq. 1). Where few particles keep all
weight, they are copied and moved by Metropolis's rule against all readings so far, which leaves the posterior as it is:
no noise blurs it, however many readings there are.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import DegenerateBeliefError
from rumi.information.neighbours import StateMetric
from rumi.resampling import resample_systematic
from rumi.seeding import normal, uniform
from rumi.weights import effective_sample_size, resampled_weights
from sdf import skipped_work
from sdf.bounds import ASCENDING, Checked, CountOr0, Positive, Share
from sdf.numbers import refuse_trained
from sensors.evidence import Evidence

_KEPT = 0.5
"""Share of the effective sample size that is left after each rise of the power."""
_HALVINGS = 40
"""Of the interval that the next power is looked for in."""


@dataclass(frozen=True)
class ResampleMoveSettings(Checked):
    """Settings of the resample-move filter.

    Attributes:
        trigger: share of N that the effective sample size falls below before particles are resampled and moved.
        moves: Metropolis moves of every particle then.
        jitter_m: least and greatest standard deviation of the moves that know nothing of the others, log-uniform.
        crossed: share of moves along the difference of two other particles, which fit whatever shape they fill.
    """

    trigger: Share = 0.5
    moves: CountOr0 = 8
    jitter_m: Annotated[tuple[Positive, Positive], ASCENDING] = (3e-4, 0.05)
    crossed: Share = 0.6

    def __post_init__(self) -> None:
        """Refuse what has no meaning, and what would drop a gradient."""
        refuse_trained(self)
        super().__post_init__()


@dataclass(frozen=True, eq=False)
class StaticBelief:
    """Weighted particles of a static state.

    Attributes:
        states: (N, ...).
        log_weights: (N), normalised.
        log_target: (N), log of prior and of the likelihood of all readings so far, up to a constant.
    """

    states: Float[Tensor, "N ..."]
    log_weights: Float[Tensor, "N"]
    log_target: Float[Tensor, "N"]

    @property
    def ess(self) -> float:
        """Effective sample size."""
        return float(effective_sample_size(self.log_weights))

    @property
    def best(self) -> Tensor:
        """The state of the highest posterior density."""
        held = torch.where(self.log_weights > -math.inf, self.log_target, -math.inf)
        return self.states[held.argmax()]


class ResampleMoveInfo(NamedTuple):
    """Diagnostics of an update.

    Attributes:
        ess: effective sample size after weighing.
        resampled: whether particles were resampled and moved.
        accepted: share of moves that were taken; 0 where there were none.
    """

    ess: float
    resampled: bool
    accepted: float


@dataclass(frozen=True)
class TemperedEvidence:
    """Tempered likelihood, all evidence with the new part of it to a power: an `Evidence`.

    Attributes:
        every: all evidence, the new one included.
        new: what came now.
        power: of its likelihood, in [0, 1].
    """

    every: Evidence
    new: Evidence
    power: float

    def log_likelihood(self, states: Float[Tensor, "N ..."], /) -> Float[Tensor, "N"]:
        """Of each state, up to a constant, nats."""
        whole = self.every.log_likelihood(states)
        # what cannot be at all cannot be by any power
        less = (1.0 - self.power) * self.new.log_likelihood(states)
        return torch.where(whole > -torch.inf, whole - less, whole)


@dataclass(frozen=True)
class ResampleMoveFilter:
    """Particle filter of a static state, whose particles move by Metropolis's rule after a resampling.

    Attributes:
        metric: of the states, whose scales are those of a step; a step and its opposite lead there and back, so that
            proposals made of them are symmetric.
        log_prior: log-density of states up to a constant; -inf where they cannot be.
        settings: of the filter.
    """

    metric: StateMetric
    log_prior: Callable[[Tensor], Tensor]
    settings: ResampleMoveSettings = ResampleMoveSettings()

    def start(
        self,
        states: Float[Tensor, "N ..."],
        log_weights: Float[Tensor, "N"] | None = None,
        evidence: Evidence | None = None,
    ) -> StaticBelief:
        """The belief of particles that were drawn from the prior, or from elsewhere and weighed for that.

        Args:
            states: particles.
            log_weights: of them; equal by default.
            evidence: that they were drawn and weighed by already.
        """
        log = states.new_zeros(len(states)) if log_weights is None else log_weights
        return StaticBelief(states, log.log_softmax(-1), self.log_target(states, evidence))

    def log_target(self, states: Float[Tensor, "N ..."], evidence: Evidence | None) -> Float[Tensor, "N"]:
        """Log of prior and likelihood, up to a constant."""
        prior = self.log_prior(states)
        return prior if evidence is None else prior + evidence.log_likelihood(states)

    def update(
        self, belief: StaticBelief, new: Evidence, every: Evidence, *, generator: torch.Generator
    ) -> tuple[StaticBelief, ResampleMoveInfo]:
        """Weigh by new evidence, then resample and move if too few particles are left.

        Args:
            belief: before.
            new: evidence that came now.
            every: all evidence so far, the new one included.
            generator: of all draws.

        Raises:
            DegenerateBeliefError: no particle is possible any more.
        """
        with skipped_work.work("predictions") as work:
            work.count(0.0, float(len(belief.log_weights)))  # what is fixed does not move
        told = new.log_likelihood(belief.states)
        log = belief.log_weights + told
        if not bool(torch.isfinite(log.logsumexp(-1))):
            raise DegenerateBeliefError(
                "No particle explains the reading: more particles, or noise that fits the sensor"
            )
        belief = StaticBelief(belief.states, log.log_softmax(-1), belief.log_target + told)
        ess = belief.ess
        if ess >= self.settings.trigger * len(log):
            return belief, ResampleMoveInfo(ess, False, 0.0)
        index = resample_systematic(belief.log_weights, generator=generator)
        equal = resampled_weights(belief.log_weights, index)
        belief = StaticBelief(belief.states[index], equal, belief.log_target[index])
        return self.move(belief, every, ess=ess, generator=generator)

    def move(
        self, belief: StaticBelief, every: Evidence | None, *, ess: float, generator: torch.Generator
    ) -> tuple[StaticBelief, ResampleMoveInfo]:
        """Metropolis moves: the same posterior by particles that are set apart, at weights as they were."""
        states, target, taken = belief.states.clone(), belief.log_target.clone(), 0
        # one half stands still while the other moves by its differences: so each move is exact; one alone has no other
        for half in ((0, 1) if len(states) > 1 else (0,)) * self.settings.moves:
            own = slice(half, None, 2)
            proposed = states[own] + self._steps(len(states[own]), states[1 - half :: 2], generator)
            there = self.log_target(proposed, every)
            chance = uniform(there.shape, generator=generator, dtype=there.dtype, device=there.device)
            accept = chance.log() < there - target[own]
            taken += int(accept.sum())
            wide = accept.view(-1, *[1] * (proposed.dim() - 1))
            states[own] = torch.where(wide, proposed, states[own])
            target[own] = torch.where(accept, there, target[own])
        tried = max(1, self.settings.moves * len(target))
        return replace(belief, states=states, log_target=target), ResampleMoveInfo(ess, True, taken / tried)

    def update_tempered(
        self,
        belief: StaticBelief,
        new: Evidence,
        every: Evidence,
        *,
        power: float = 0.0,
        generator: torch.Generator,
    ) -> StaticBelief:
        """Weigh by new evidence, tempered: in as many steps as it takes, particles resampled and moved between them.

        For evidence too sharp for the particles at hand: where a reading is far more exact than particles are apart,
        the one that happens to be nearest to some mode takes all weight, and every other mode dies with its particles.
        Raised to a small power the likelihood lets many live on; moves bring them nearer before the power grows.

        Args:
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
            partly = TemperedEvidence(every, new, power)
            log = belief.log_weights + rise * told
            belief = StaticBelief(belief.states, log.log_softmax(-1), belief.log_target + rise * told)
            ess = belief.ess
            if ess < self.settings.trigger * len(log):
                index = resample_systematic(belief.log_weights, generator=generator)
                belief = self.start(belief.states[index], evidence=partly)
                belief, _ = self.move(belief, partly, ess=ess, generator=generator)
        return belief

    def _steps(self, size: int, others: Float[Tensor, "M ..."], generator: torch.Generator) -> Float[Tensor, "N D"]:
        """Steps that are as likely as their opposites: jitter of any size, or differences of other particles."""
        shape = (size, self.metric.dims)
        even = partial(uniform, generator=generator, dtype=others.dtype, device=others.device)
        noisy = partial(normal, generator=generator, dtype=others.dtype, device=others.device)
        low, high = (math.log(bound) for bound in self.settings.jitter_m)
        scale = torch.exp(low + (high - low) * even((size, 1)))
        units = others.new_tensor(self.metric.scales)
        steps = scale * units * noisy(shape)
        if len(others) < 2:
            return steps
        pair = torch.randint(len(others), (2, size), generator=generator, device=generator.device).to(others.device)
        share = 10.0 ** (1.2 * even((size, 1)) - 1.0)
        across = share * self.metric.difference(others[pair[0]], others[pair[1]])
        # a hair's breadth more, so that copies of one particle part too
        across = across + self.settings.jitter_m[0] * units * noisy(shape)
        crossed = even((size, 1)) < self.settings.crossed
        return torch.where(crossed, across, steps)


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
