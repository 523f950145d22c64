"""Anytime selection of a sensing action, thinking and motion timed together (time allocation, Alg. 1, corrected)."""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.clock import Now
from rumi.planning.duration_model import DurationModel

A = TypeVar("A")

_KEPT = 10_000
"""Candidates that wait for more time: of more than twice as many, those that need the least stay."""


@dataclass(frozen=True)
class Candidate(Generic[A]):
    """An action that may be chosen.

    Attributes:
        action: what `gain` is asked of.
        execution_s: seconds that carrying it out takes.
        work: that evaluating it takes, in the unit of the evaluation time, such as readings times particles.
    """

    action: A
    execution_s: float
    work: float = 1.0


class Evaluated(NamedTuple):
    """One evaluation of a decision.

    Attributes:
        begun_s, ended_s: since the decision began.
        execution_s: of the candidate.
        gain: of it, nats.
        taken: whether it was the best so far.
        action: of the candidate; None in records of before, which lack it.
    """

    begun_s: float
    ended_s: float
    execution_s: float
    gain: float
    taken: bool
    action: Any = None


@dataclass(frozen=True)
class Selection(Generic[A]):
    """Result of an anytime selection: the decision, and the time that it took.

    Attributes:
        candidate: what to do; None to stay.
        gain: expected of it, nats; 0 for staying.
        generated: candidates that were made.
        skipped: of them, those that there was no time for.
        doublings: how often the time was doubled, since there was nothing to do in it.
        t_max_s: allowed for the last round of thinking and the motion.
        thinking_s: from the beginning to the decision, all rounds.
        late_s: by which thinking and motion, if it takes as long as expected, end after the last deadline; below 0 for
            seconds to spare.
        ended: "deadline" where time ran out, "exhausted" where candidates did.
        measured: work and seconds of each evaluation: what the next fit of the evaluation time takes.
        history: the evaluations, in order.
    """

    candidate: Candidate[A] | None
    gain: float
    generated: int
    skipped: int
    doublings: int
    t_max_s: float
    thinking_s: float
    late_s: float
    ended: Literal["deadline", "exhausted"]
    measured: tuple[tuple[float, float], ...]
    history: tuple[Evaluated, ...]

    @property
    def evaluated(self) -> int:
        """Candidates that were evaluated."""
        return len(self.history)


def select(
    candidates: Iterable[Candidate[A]],
    gain: Callable[[A], float],
    t_max_s: float,
    *,
    evaluation: DurationModel,
    generation: DurationModel | None = None,
    doublings: int = 3,
    now: Now = time.perf_counter,
) -> Selection[A]:
    """The candidate of highest gain that thinking and motion together have the time for.

    Thinking ends when no evaluation would be done before the best candidate so far has to begin, or when candidates run
    out. Where that leaves nothing to do, the time is doubled, for this decision alone; candidates that there was no
    time for come first then, and no candidate is evaluated twice. Equal gains keep the earlier candidate. Where more
    than 20 000 wait for more time, the 10 000 that are the quickest to evaluate and to carry out are kept.

    As printed, the test before an evaluation asks whether the new candidate would end in time, not whether the best
    one so far still would; thinking would go on for ever where nothing gains anything; and an evaluation takes its
    mean time. Here the bound of the evaluation time is left for whichever of the two takes longer, and making a
    candidate counts.

    Args:
        candidates: in the order in which they are to be tried; taken one by one, and only while there is time. They
            must come to an end, or take time to make.
        gain: what an action is expected to tell, nats; its time counts.
        t_max_s: seconds for thinking and motion.
        evaluation: how long `gain` takes.
        generation: how long the next candidate takes to come; None starts on one whenever there is any time.
        doublings: of the time, at most.
        now: the clock.
    """
    if not t_max_s >= 0:
        raise ValueError(f"Expected t_max_s to be 0 or more, got {t_max_s}")
    if doublings < 0:
        raise ValueError(f"Expected doublings to be 0 or more, got {doublings}")
    deciding = _Decision(gain, evaluation, t_max_s, now)
    source, making = iter(candidates), 0.0 if generation is None else generation.bound()
    waiting: list[Candidate[A]] = []
    generated = tried = done = 0
    while True:
        again, waiting, ended = iter(waiting), [], False
        while deciding.has_time_to_go_on(making):
            candidate = next(again, None)
            if candidate is None:
                candidate = next(source, None)
                if candidate is None:
                    ended = True
                    break
                generated += 1
            if deciding.has_time_for(candidate):
                tried += 1
                deciding.evaluate(candidate)
            else:
                waiting.append(candidate)
                if len(waiting) > 2 * _KEPT:
                    waiting = _quickest(waiting, evaluation)
        waiting += again
        if deciding.best is not None or done == doublings or (ended and not waiting):
            return deciding.result(generated, generated - tried, done, ended)
        done += 1
        deciding.more_time()


class _Decision(Generic[A]):
    """The best so far, against a clock."""

    def __init__(
        self,
        gain: Callable[[A], float],
        evaluation: DurationModel,
        t_max_s: float,
        now: Now,
    ) -> None:
        self._gain, self._evaluation, self._now = gain, evaluation, now
        self._begun, self._t_max_s = now(), t_max_s
        self._deadline = self._begun + t_max_s
        self.best: Candidate[A] | None = None
        self.value = 0.0
        self._history: list[Evaluated] = []
        self._measured: list[tuple[float, float]] = []

    def has_time_to_go_on(self, making_s: float) -> bool:
        """Whether another candidate can be made, and any be evaluated, before the best so far has to begin."""
        left = self._deadline - self._now() - (0.0 if self.best is None else self.best.execution_s)
        return left > making_s and left >= making_s + self._evaluation.bound(0.0)

    def has_time_for(self, candidate: Candidate[A]) -> bool:
        """Whether it can be evaluated, and the slower of it and the best so far carried out after that."""
        needed = self._evaluation.bound(candidate.work)
        motion = candidate.execution_s
        if self.best is not None:
            motion = max(motion, self.best.execution_s)
        return needed + motion <= self._deadline - self._now()

    def evaluate(self, candidate: Candidate[A]) -> None:
        """Work out its gain, and take it if that is more."""
        begun = self._now()
        value = float(self._gain(candidate.action))
        ended = self._now()
        if math.isnan(value):
            raise ValueError("Expected the gain of an action to be a number, got nan")
        taken = value > self.value
        if taken:
            self.best, self.value = candidate, value
        self._measured.append((candidate.work, ended - begun))
        times = (begun - self._begun, ended - self._begun)
        self._history.append(Evaluated(*times, candidate.execution_s, value, taken, candidate.action))

    def more_time(self) -> None:
        """Begin another round, twice as long."""
        self._t_max_s *= 2.0
        self._deadline = self._now() + self._t_max_s

    def result(self, generated: int, skipped: int, doublings: int, exhausted: bool) -> Selection[A]:
        """What came of it."""
        now = self._now()
        motion = 0.0 if self.best is None else self.best.execution_s
        return Selection(
            self.best,
            self.value,
            generated,
            skipped,
            doublings,
            self._t_max_s,
            now - self._begun,
            now + motion - self._deadline,
            "exhausted" if exhausted else "deadline",
            tuple(self._measured),
            tuple(self._history),
        )


def _quickest(waiting: list[Candidate[A]], evaluation: DurationModel) -> list[Candidate[A]]:
    """Those that need the least time, in the order in which they came."""
    needed = [evaluation.bound(candidate.work) + candidate.execution_s for candidate in waiting]
    kept = sorted(range(len(waiting)), key=needed.__getitem__)[:_KEPT]
    return [waiting[index] for index in sorted(kept)]


def in_descending_posterior(
    log_density: Float[Tensor, "N"], of_particle: Callable[[int], Iterable[Candidate[A]]]
) -> Iterator[Candidate[A]]:
    """Candidates of the likeliest particle, then of the next one, made only when asked for (III-C).

    Args:
        log_density: of the particles; those of no weight have no candidates. Equal ones keep their order.
        of_particle: candidates of a particle by index.
    """
    for index in torch.argsort(log_density, descending=True, stable=True).tolist():
        if log_density[index] == -torch.inf:
            return
        yield from of_particle(index)
