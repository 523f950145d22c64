"""A clock that only goes when told."""

from collections.abc import Callable

import pytest


class FakeClock:
    """Seconds that pass only where `work` says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def work(self, seconds: float, result: object = None) -> Callable[[], object]:
        """A call that takes some seconds of this clock."""

        def call() -> object:
            self.now += seconds
            return result

        return call


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()
