"""Decisions on a simulated clock, by the thousand: how often deadlines are missed, and what more time finds."""

from collections.abc import Iterator
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from rumi.clock import SimulatedClock
from rumi.planning.anytime import Candidate, select
from rumi.planning.duration_model import DurationModel
from scripts.store import Figures, Store

Noise = Literal["exact", "lognormal", "exponential", "stalls"]
NOISES: tuple[Noise, ...] = ("exact", "lognormal", "exponential", "stalls")
BUDGETS_S = tuple(float(f"{0.02 * 1000 ** (k / 9):.3g}") for k in range(10))
"""From 20 ms to 20 s."""

LEVELS = (0.9, 0.99)
_PROBLEMS = 25
_CANDIDATES = 400
_MEASURED = 500


class Seconds(NamedTuple):
    """Evaluation times with a mean.

    Attributes:
        noise: their distribution.
        mean_s: of them.
    """

    noise: Noise
    mean_s: float

    def draw(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Seconds (count,)."""
        if self.noise == "exact":
            return np.full(count, self.mean_s)
        if self.noise == "lognormal":
            return np.asarray(self.mean_s * random.lognormal(-0.125, 0.5, count))
        if self.noise == "exponential":
            return np.asarray(random.exponential(self.mean_s, count))
        # one in fifty takes twenty times as long
        return np.where(random.random(count) < 0.02, 20.0, 1.0) * (self.mean_s / 1.38)


def simulated(noise: Noise, level: float, seed: int) -> Figures:
    """Decisions on a simulated clock: the same problems at every budget, each with a fit of its own.

    Motions and evaluations of a problem are drawn about a scale of its own between milliseconds and seconds.

    Returns:
        by budget: decisions that were late, by what share of the time allowed at most, the mean of what was found
        (nats), and decisions whose time was doubled.
    """
    late, doubled = ({str(budget): 0 for budget in BUDGETS_S} for _ in range(2))
    latest, found = ({str(budget): 0.0 for budget in BUDGETS_S} for _ in range(2))
    for problem in range(_PROBLEMS):
        random = np.random.default_rng([seed, problem])
        scale = 10 ** random.uniform(-2.0, 0.7)
        seconds = Seconds(noise, scale * 10 ** random.uniform(-2.5, -0.5))
        motions, values = scale * random.lognormal(0.0, 0.7, _CANDIDATES), random.exponential(1.0, _CANDIDATES)
        known = seconds.draw(random, _MEASURED)
        fitted = DurationModel.fit(np.ones(_MEASURED), known, level)
        evaluation = DurationModel.known(seconds.mean_s) if noise == "exact" else fitted
        for budget in BUDGETS_S:
            clock, own = SimulatedClock(), iter(seconds.draw(random, _CANDIDATES).tolist())

            def gain(value: float, clock: SimulatedClock = clock, own: Iterator[float] = own) -> float:
                clock.advance(next(own))
                return value

            pairs = zip(values.tolist(), motions.tolist(), strict=True)
            candidates = [Candidate(value, motion) for value, motion in pairs]
            made = select(candidates, gain, budget, evaluation=evaluation, now=clock)
            name, share = str(budget), made.late_s / made.t_max_s
            late[name] += share > 1e-9
            latest[name] = max(latest[name], share)
            found[name] += made.gain / _PROBLEMS
            doubled[name] += made.doublings > 0
    return {"decisions": _PROBLEMS, "late": late, "latest": latest, "gain": found, "doubled": doubled}


def measure_simulated(store: Store, *, decisions: int = 10_000) -> Iterator[bool]:
    """Do what is missing of the simulated decisions: so many of each noise and level."""
    for noise in NOISES:
        for level in LEVELS[:1] if noise == "exact" else LEVELS:
            for seed in range(decisions // (_PROBLEMS * len(BUDGETS_S))):
                about = {"part": "simulated", "noise": noise, "level": level, "seed": seed}
                yield store.measure(about, partial(simulated, noise, level, seed))
