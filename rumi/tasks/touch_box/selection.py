"""Which poke: what candidates are worth by several measures, all of the same rollouts."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.information.binary_gain import expected_gain
from rumi.information.entropy import SharedSupport, weights_entropy
from rumi.registry import Table


class Rollouts(NamedTuple):
    """What C candidates do to N particles, step by step.

    Attributes:
        states: (C, T + 1, N, 3), poses, the present first.
        probability: (C, T, N), of a contact signal after each step.
        touching: (C, T, N), whether the tool touches then.
        log_weights: (N), now.
        likeliest: the particle that "ml-observation" takes for the truth, which may have no weight here; the heaviest
            if None.
    """

    states: Float[Tensor, "C T1 N 3"]
    probability: Float[Tensor, "C T N"]
    touching: Bool[Tensor, "C T N"]
    log_weights: Float[Tensor, "N"]
    likeliest: int | None = None


class Weighing(NamedTuple):
    """What candidates are weighed by.

    Attributes:
        rollouts: of the candidates.
        support: density term.
        generator: all randomness.
        hold: steps of contact.
        samples: reading sequences that are drawn for each candidate ("sequence").
        every: steps from one density term to the next.
    """

    rollouts: Rollouts
    support: SharedSupport
    generator: torch.Generator
    hold: int = 3
    samples: int = 32
    every: int = 4


Worth = tuple[Float[Tensor, "C"], Int[Tensor, "C"] | None]
"""Of each candidate: its value, and the step after which it is best cut off; None for its end."""

METHODS: Table[Callable[[Weighing], Worth]] = Table("method", "rumi.poke_methods")
"""Measures of what candidates are worth, by name."""


class Choice(NamedTuple):
    """What was chosen.

    Attributes:
        value: (C), of each candidate, by the method's measure.
        steps: (C), after which each is to be cut off.
        best: index of the best candidate.
    """

    value: Float[Tensor, "C"]
    steps: Int[Tensor, "C"]
    best: int


def choose(method: str, given: Weighing, *, funnel: float = 0.0) -> Choice:
    """Weigh candidates by a method and take the best.

    Args:
        method: of `METHODS`.
        given: what the candidates are weighed by.
        funnel: nats of worth for each nat by which the motion alone shrinks the belief's volume.

    Raises:
        UsageError: there is no such method.
    """
    count, steps = given.rollouts.probability.shape[:2]
    value, best = METHODS[method](given)
    whole = torch.full((count,), steps) if best is None else best
    if funnel != 0.0:
        value = value + funnel * shrinking(given.rollouts, given.support, whole)
    # where nothing gains, the first candidate is carried out to its end, which is an uninformed poke, since candidates
    # are drawn alike: to stand still would gather nothing and lead to the same choice again
    whole = torch.where(whole > 0, whole, steps)
    return Choice(value, whole, int(value.argmax()))


def sequence_information(
    rollouts: Rollouts, *, hold: int, samples: int, generator: torch.Generator
) -> Float[Tensor, "C"]:
    """Mutual information, nats, of the pose and all readings of a poke that ends after `hold` steps of contact.

    Mean over sampled truths and readings of the divergence of the weights after from those before; the readings are
    independent given the particle. A poke ends where the sampled truth has been touched for `hold` steps.
    """
    log = rollouts.log_weights.log_softmax(-1)
    chance = rollouts.probability
    steps = chance.shape[1]
    truth = torch.multinomial(log.exp(), samples, True, generator=generator)
    draw = torch.rand(samples, steps, generator=generator, dtype=chance.dtype)
    own = chance[:, :, truth].transpose(1, 2)  # (C, S, T)
    reading = (draw < own).to(chance.dtype)
    held = rollouts.touching[:, :, truth].transpose(1, 2).long().cumsum(-1)
    counts = (torch.nn.functional.pad(held, (1, 0))[..., :-1] < hold).to(chance.dtype)
    tiny = torch.finfo(chance.dtype).tiny
    yes, no = chance.clamp_min(tiny).log(), (1.0 - chance).clamp_min(tiny).log()
    told = (counts * reading) @ yes + (counts * (1.0 - reading)) @ no  # (C, S, N)
    evidence = torch.logsumexp(log + told, -1)
    return (told[:, torch.arange(samples), truth] - evidence).mean(-1)


def likeliest_gain(
    rollouts: Rollouts, support: SharedSupport, *, every: int
) -> tuple[Float[Tensor, "C"], Int[Tensor, "C"]]:
    """Entropy that each candidate takes away if the likeliest particle is the truth, and the best step for it.

    The reading after each step is the one that is expected of that particle: contact where it is touched.
    """
    log, chance = rollouts.log_weights.log_softmax(-1), rollouts.probability
    likely = int(log.argmax()) if rollouts.likeliest is None else rollouts.likeliest
    contact = rollouts.touching[:, :, likely, None]
    tiny = torch.finfo(chance.dtype).tiny
    after = log + torch.where(contact, chance, 1.0 - chance).clamp_min(tiny).log()
    gain = weights_entropy(log) - weights_entropy(after)
    volume = expected_gain(rollouts.states, log, chance, support, every=every).volume
    value, step = (gain + volume).max(-1)
    return value, step + 1


def shrinking(rollouts: Rollouts, support: SharedSupport, steps: Int[Tensor, "C"]) -> Float[Tensor, "C"]:
    """Nats by which each candidate's motion alone shrinks the volume of the belief, within its steps."""
    start = support(rollouts.states[0, 0], rollouts.log_weights).log_volume
    end = rollouts.states[torch.arange(len(steps)), steps]
    return start - support(end, rollouts.log_weights).log_volume


def expects_contact(touching: Bool[Tensor, "T N"], log_weights: Float[Tensor, "N"], hold: int) -> Float[Tensor, "T"]:
    """Weight of the particles that have been touched for `hold` steps or more, after each step.

    Args:
        touching: of the particles along the poke.
        log_weights: of the particles, by all readings so far.
        hold: steps.
    """
    return ((touching.long().cumsum(0) >= hold) * log_weights.softmax(-1)).sum(-1)


def _sequence(given: Weighing) -> Worth:
    """Information of all readings until the belief expects contact to have lasted `hold` steps."""
    rollouts, hold, samples = given.rollouts, given.hold, given.samples
    return sequence_information(rollouts, hold=hold, samples=samples, generator=given.generator), None


def _entropy(given: Weighing, *, density: bool = True) -> Worth:
    """The paper's Eq 9, one reading at the best step, with the density term or without."""
    rollouts, support = given.rollouts, given.support if density else None
    gain = expected_gain(rollouts.states, rollouts.log_weights, rollouts.probability, support, every=given.every)
    return gain.value, gain.best_step


def _max_contact(given: Weighing) -> Worth:
    """Weight of the particles that are touched."""
    touched = given.rollouts.touching.any(1)
    return (touched * given.rollouts.log_weights.softmax(-1)).sum(-1), None


def _uninformed(given: Weighing) -> Worth:
    """Drawn."""
    chance = given.rollouts.probability
    return torch.rand(len(chance), generator=given.generator, dtype=chance.dtype), None


METHODS.add("sequence", _sequence)
METHODS.add("entropy", _entropy)
METHODS.add("weights-only", partial(_entropy, density=False))
METHODS.add("ml-observation", lambda given: likeliest_gain(given.rollouts, given.support, every=given.every))
METHODS.add("max-contact", _max_contact)
METHODS.add("uninformed", _uninformed)
