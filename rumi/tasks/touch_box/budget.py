"""Which poke, within a time: as many candidates as there is time for, one by one."""

import copy
import time

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.trajectory_belief import TrajectoryBelief
from rumi.clock import Now
from rumi.errors import UsageError
from rumi.planning.anytime import Candidate, select
from rumi.planning.duration_model import DurationModel
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.selection import Choice

_REMEMBERED = 500


class BudgetedChoice:
    """Chooses as `Toucher.decide` does, of the candidates that there is time for.

    All draws but those of the candidates are alike for each of them, so that with time for all the choice is the same,
    up to rounding: weighed together, a candidate's sums may be added up otherwise, in the last digits of its worth.
    Where there is no time to weigh any, the first is carried out to its end. How long one takes is learnt on the way;
    before the first decision one is weighed twice for nothing, the first time to load compiled code.

    Args:
        toucher: whose candidates these are, and what they are worth.
        budget_s: seconds for a decision.
        now: the clock.
    """

    def __init__(self, toucher: Toucher, budget_s: float, now: Now = time.perf_counter) -> None:
        if not 0 < budget_s < float("inf"):
            raise UsageError(f"Expected a budget above 0 s and finite, got {budget_s}")
        self._toucher, self._budget_s, self._now = toucher, budget_s, now
        self._seconds: list[float] = []

    def __call__(
        self, belief: TrajectoryBelief, *, generator: torch.Generator
    ) -> tuple[Float[Tensor, "C K1 3"], Choice]:
        """The candidates that were weighed, or else the first, and the choice among them."""
        if not self._seconds:
            self._learn(belief)
        begun = self._now()
        paths = self._toucher.candidates(belief, generator=generator)
        state = generator.get_state()
        weighed: list[Choice] = []

        def gain(index: int) -> float:
            generator.set_state(state)
            weighed.append(self._weighed(belief, paths[index : index + 1], generator))
            return float(weighed[-1].value[0])

        made = select(
            [Candidate(index, 0.0) for index in range(len(paths))],
            gain,
            max(0.0, self._budget_s - (self._now() - begun)),
            evaluation=DurationModel.fit([1.0] * len(self._seconds), self._seconds),
            doublings=0,
            now=self._now,
        )
        self._seconds = [*self._seconds, *(seconds for _, seconds in made.measured)][-_REMEMBERED:]
        if not weighed:
            return paths[:1], Choice(paths.new_zeros(1), torch.tensor([paths.shape[1] - 1]), 0)
        # all take the same time: those that there was time for are the first
        value, steps = (torch.cat(parts) for parts in zip(*((own.value, own.steps) for own in weighed), strict=True))
        return paths[: len(weighed)], Choice(value, steps, int(value.argmax()))

    def _learn(self, belief: TrajectoryBelief) -> None:
        """How long it takes to weigh one."""
        generator = torch.Generator().manual_seed(0)
        path = self._toucher.candidates(belief, generator=generator)[:1]
        for _ in range(2):
            begun = self._now()
            self._weighed(belief, path, generator)
            self._seconds = [self._now() - begun]

    def _weighed(self, belief: TrajectoryBelief, path: Tensor, generator: torch.Generator) -> Choice:
        """What a single candidate is worth: a decision that has no other."""
        alone = copy.copy(self._toucher)
        alone.candidates = lambda belief, *, generator: path  # type: ignore[method-assign]
        return alone.decide(belief, generator=generator)[1]
