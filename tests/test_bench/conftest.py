"""What the tests of the benchmarks share: a clock that only goes when told, and cases made up."""

from collections.abc import Callable

import pytest
import torch

from rumi.bench.case import Case, Setup, Target, Variant


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


@pytest.fixture
def made_up(clock: FakeClock) -> Callable[..., Case]:
    """A case whose variants take known times: rumi's two, a peer's and a naive one."""

    def make(quick: float = 0.01, plain: float = 0.05, off: float = 0.0, **more: object) -> Case:
        variants = (
            Variant("torch", clock.work(plain, torch.tensor([1.0, 2.0]))),
            Variant("numba", clock.work(quick, torch.tensor([1.0, 2.0 + off]))),
            Variant("peer", clock.work(0.1, torch.tensor([1.5, 2.0])), "peer"),
            Variant("naive", clock.work(0.02, torch.tensor([1.0])), "naive", share=0.1, note="slow"),
        )
        targets = (
            Target("numba", at_least=8.0, against=("peer", "naive", "not there")),
            Target("numba", at_least=20.0, against=("peer",), goal=True),
            Target("torch", at_most_s=0.04),
            Target("absent", at_most_s=1.0),
        )
        values = {
            "title": "made up",
            "variants": variants,
            "baselines": ("not there", "peer"),
            "items": 1000,
            "item": "pair",
            "targets": targets,
            "error": lambda found, reference: float((found - reference[: len(found)]).abs().max()),
            "tolerance": 1e-3,
        }
        return Case(**values | more)

    return make


@pytest.fixture(scope="session")
def tiny() -> Setup:
    return Setup(tiny=True, quick=True, without_peers="not asked for")
