"""Time budget of a plan, and how much work fits into what is left of it, by the pace of earlier work."""

import math
from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.clock import Now

_MARGIN = 1.25
"""Work is taken to last longer by this than its like did before."""
_FORGET = 0.7
"""Share of a time that is held against a quicker one that came after it: a stall is forgotten in a few turns."""
_LEAST_SAMPLES = 16
_FIRST_SAMPLES = 32
_SLOWER = 8
"""By how much an iteration's samples may be slower than those of the one before (five times was seen)."""


class PlanBudget:
    """The time of one plan; without a budget there is always time.

    Times are kept by the kind of work, a unit of it each: `pace`. A plan hands its own on to the next one, so that
    nothing is kept by the planner.

    Args:
        budget_s: seconds from now on, or None.
        now: the clock.
        pace: seconds for a unit of work by kind, of the plan before.
    """

    def __init__(self, budget_s: float | None, now: Now, pace: Mapping[str, float] | None = None) -> None:
        self.budget_s = budget_s
        self.now = now
        self.pace = dict(pace or {})
        self.samples = 0
        self._evaluated_at: float | None = None
        self._reserved = 0
        self._ends = math.inf if budget_s is None else now() + budget_s

    @property
    def open(self) -> bool:
        """Whether there is no budget."""
        return self.budget_s is None

    def left(self) -> float:
        """Seconds until the plan has to be there, less what is kept for later and what its end is expected to take."""
        later = self.expected("kept", self._reserved) + self.expected("finish") + self.expected("update")
        return self._ends - self.now() - later

    def reserve(self, kept: int) -> None:
        """Keep time for samples that are to be worked out in full after the others, until that begins."""
        self._reserved = kept

    def expected(self, kind: str, work: float = 1.0) -> float:
        """Seconds that work will take, with a margin; 0 for a kind of which nothing is known."""
        return _MARGIN * self.pace.get(kind, 0.0) * work

    def knows(self, kind: str) -> bool:
        """Whether such work was done before."""
        return kind in self.pace

    def took(self, kind: str, work: float, seconds: float) -> None:
        """Remember how long work took: the slowest of late."""
        each = seconds / work
        self.pace[kind] = max(each, _FORGET * self.pace.get(kind, 0.0))

    def ease(self, kind: str) -> None:
        """Take work that there was no time for to be quicker the next time: else one stall could end it for good."""
        if kind in self.pace:
            self.pace[kind] *= _FORGET

    def eased(self) -> dict[str, float]:
        """The pace to go on with where nothing was done: were it kept, one stall could end all planning."""
        return {kind: _FORGET * seconds for kind, seconds in self.pace.items()}

    def timed(self, kind: str, work: float, do: Callable[[], object]) -> None:
        """Do something and remember how long it took."""
        begun = self.now()
        do()
        self.took(kind, work, self.now() - begun)

    def has_time_for(self, kind: str, work: float = 1.0) -> bool:
        """Whether work of a kind will be done in time."""
        return self.open or self.expected(kind, work) <= self.left()

    def affordable(self, kind: str, most: int, share: float) -> int:
        """Units of work, at most `most`, that fit into a share of what is left; `most` where nothing is known."""
        each = self.expected(kind)
        if self.open or each == 0:
            return most
        return max(0, min(most, int(share * self.left() / each)))

    def in_parts(
        self,
        controls: Float[Tensor, "K H A"],
        costs_of: Callable[[Float[Tensor, "k H A"]], Float[Tensor, "k"]],
        kind: str = "sample",
    ) -> Float[Tensor, "K"]:
        """Costs of as many samples as there is time for, first ones first, and infinity for the rest.

        The first few samples are worked out even where there is no time: without any there is nothing to follow. That
        is not so of those that are "kept" of them, whose coarse costs are known.
        """
        if kind == "kept":
            self._reserved = 0
        costs = controls.new_full((len(controls),), torch.inf)
        begun = self.now()
        if self._evaluated_at is not None and kind == "sample":
            self.took("update", 1.0, begun - self._evaluated_at)
        done = 0
        while done < len(controls):
            count = self._next(len(controls) - done, kind, first=done == 0)
            if count == 0:
                break
            begun = self.now()
            costs[done : done + count] = costs_of(controls[done : done + count])
            self._evaluated_at = self.now()
            self.took(kind, count, self._evaluated_at - begun)
            done += count
            self.samples += count if kind == "sample" else 0
        return costs

    def _next(self, rest: int, kind: str, *, first: bool) -> int:
        """How many samples to work out next; 0 where there is no time for any after the first ones."""
        few = min(_LEAST_SAMPLES, rest)
        if not self.knows(kind):
            return min(_FIRST_SAMPLES if kind == "sample" else 1, rest)
        fits = self.affordable(kind, _SLOWER * rest, 1.0)
        if fits < few:
            return few if first and kind == "sample" else 0
        if first and fits < _SLOWER * rest:
            # an iteration's samples may take several times as long as those of the one before: more of them push
            return min(_FIRST_SAMPLES, fits, rest)
        # half of what fits: these may take longer than their like did, and the rest is looked at again
        return min(rest, fits if fits < 2 * few else fits // 2)

    def few_samples(self) -> float:
        """Seconds that the fewest samples of an iteration are expected to take."""
        return self.expected("sample", _LEAST_SAMPLES)

    def no_more_samples(self) -> bool:
        """Whether there is no time for another iteration, of few samples."""
        return not self.has_time_for("sample", 2 * _LEAST_SAMPLES)
