"""Wall time by stage, and clocks that time is read from: the machine's or a simulated one."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

Now = Callable[[], float]
"""Seconds since some instant, never fewer than before; `time.perf_counter` is one."""


class SimulatedClock:
    """A clock that stands still until it is told how long something took.

    >>> clock = SimulatedClock()
    >>> clock.advance(1.5)
    >>> clock()
    1.5
    """

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def __call__(self) -> float:
        """Seconds now."""
        return self._now_s

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        if not seconds >= 0:
            raise ValueError(f"Expected seconds to be 0 or more, got {seconds}")
        self._now_s += seconds


class Clock:
    """Seconds by stage since the last `take`.

    Args:
        now: the clock that they are read from.
    """

    def __init__(self, now: Now = time.perf_counter) -> None:
        self._now = now
        self._seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start = self._now()
        try:
            yield
        finally:
            self._seconds[stage] = self._seconds.get(stage, 0.0) + self._now() - start

    def take(self) -> dict[str, float]:
        """The seconds so far; starts again from nothing."""
        taken, self._seconds = self._seconds, {}
        return taken

    def put_back(self, taken: Mapping[str, float]) -> None:
        """Go on from what was taken: the same step is not over yet."""
        for stage, seconds in taken.items():
            self._seconds[stage] = self._seconds.get(stage, 0.0) + seconds


class Stopwatch:
    """Seconds by stage since it was made, each stage begun where the one before ended.

    Args:
        now: the clock that they are read from.
    """

    def __init__(self, now: Now) -> None:
        self.laps: dict[str, float] = {}
        self._now = now
        self._last = now()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now = self._now()
        self.laps[stage] = self.laps.get(stage, 0.0) + now - self._last
        self._last = now
