"""Timing by turns: every variant of some work in one process, one after the other, again and again."""

import gc
import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

SHORTEST_S = 2e-3
"""Work that is done sooner is repeated within one sample, so that the clock's own steps do not show."""


@dataclass(frozen=True)
class Timing:
    """Seconds that one variant took, sample by sample.

    Attributes:
        samples_s: in the order they were taken; at least one.
    """

    samples_s: tuple[float, ...]

    @property
    def median_s(self) -> float:
        """Half of the samples took longer."""
        return statistics.median(self.samples_s)

    @property
    def least_s(self) -> float:
        """The shortest sample, which other processes disturbed least."""
        return min(self.samples_s)

    @property
    def quartiles_s(self) -> tuple[float, float]:
        """A quarter of the samples took less than the first, a quarter more than the second."""
        if len(self.samples_s) == 1:
            return self.samples_s[0], self.samples_s[0]
        low, _, high = statistics.quantiles(self.samples_s, n=4, method="inclusive")
        return low, high

    @property
    def scatters(self) -> bool:
        """Whether the quartiles are further apart than half the median: something else was going on."""
        low, high = self.quartiles_s
        return high - low > 0.5 * self.median_s

    def scaled(self, factor: float) -> "Timing":
        """The same for `factor` times the work."""
        return Timing(tuple(factor * sample for sample in self.samples_s))


def fitting_clock(threads: int) -> Callable[[], float]:
    """The processor's clock for one thread, which stands still while others have the processor; else the wall's."""
    return time.process_time if threads == 1 else time.perf_counter


def time_in_turn(
    calls: Mapping[str, Callable[[], object]],
    *,
    budget_s: float,
    least: int = 3,
    most: int = 100,
    clock: Callable[[], float] = time.perf_counter,
    warm: bool = True,
) -> dict[str, Timing]:
    """Time some calls in turn.

    Each is called twice before anything counts, for caches and compilers, unless told otherwise. Then come rounds, in
    each of which every call has its turn, the first one another in each round, so that a machine that slows down slows
    all of them.

    Args:
        calls: what to time, by name.
        budget_s: seconds that the rounds should take in all; `least` rounds are done even so.
        least: rounds at least.
        most: rounds at most.
        clock: gives seconds.
        warm: whether calls are made before anything counts; without, a sample is one call, and `least` are taken.
    """
    if least < 1 or most < least:
        raise ValueError(f"Expected 1 <= least <= most rounds, got {least} and {most}")
    loops, round_s = dict.fromkeys(calls, 1), 0.0 if warm else math.inf
    for name, call in calls.items() if warm else ():
        call()
        once = _seconds(call, 1, clock)
        loops[name] = max(1, math.ceil(SHORTEST_S / max(once, 1e-9)))
        round_s += loops[name] * once
    rounds = min(most, max(least, int(budget_s / max(round_s, 1e-9))))
    names = list(calls)
    samples: dict[str, list[float]] = {name: [] for name in names}
    gc.collect()
    collecting = gc.isenabled()
    gc.disable()
    try:
        for index in range(rounds):
            first = index % len(names)
            for name in names[first:] + names[:first]:
                samples[name].append(_seconds(calls[name], loops[name], clock))
    finally:
        if collecting:
            gc.enable()
    return {name: Timing(tuple(taken)) for name, taken in samples.items()}


def _seconds(call: Callable[[], object], loops: int, clock: Callable[[], float]) -> float:
    start = clock()
    for _ in range(loops):
        call()
    return (clock() - start) / loops
