"""Whole actions of a task, replayed without its simulator."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from rumi.agent import Parts
from rumi.bench.case import CASES, Setup
from rumi.bench.cases import actions
from rumi.clock import Clock


class Counting:
    """A task that reports numbers."""

    asked = 0

    def reset(self, seed: int) -> int:
        return self._next()

    def step(self, action: int) -> int:
        return self._next()

    def finish(self, action: object) -> str:
        return "done"

    def close(self) -> None:
        """Nothing to let go of."""

    def _next(self) -> int:
        self.asked += 1
        return self.asked


@dataclass
class Listening:
    """An agent that keeps what it was told."""

    told: list[list[int]] = field(default_factory=list)

    def begin(self, result: int, *, seed: int, clock: Clock) -> Any:
        self.told.append([result])
        return SimpleNamespace(record=SimpleNamespace(step=0, timings_s={}), clock=clock)

    def stop(self, state: Any) -> None:
        return None

    def act(self, state: Any) -> tuple[Any, int]:
        return state, 1

    def update(self, state: Any, action: int, result: int) -> Any:
        with state.clock("belief"):
            self.told[-1].append(result)
        step = state.record.step + 1
        reading = SimpleNamespace(in_contact=torch.tensor([False, step == 2]))
        record = SimpleNamespace(step=step, timings_s=state.clock.take(), reading=reading)
        return SimpleNamespace(record=record, clock=state.clock)

    def last(self, state: Any) -> int:
        return 0

    def result(self, state: Any, stopped_by: str, outcome: object) -> object:
        return outcome


@dataclass(frozen=True)
class Seeded:
    """Settings of a task."""

    seed: int = 5


def test_actions_are_replayed_without_the_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    task, agent = Counting(), Listening()
    entry = SimpleNamespace(
        presets=("default",), preset=lambda name: Seeded(), build=lambda settings, cache_dir: Parts(task, agent)
    )
    monkeypatch.setattr(actions, "TASKS", {"peg": entry})
    case = CASES["actions-peg"](Setup(torch.device("cpu"), tiny=True))
    assert case.items == 2
    assert case.variants[0]() == 2
    assert task.asked == 3
    assert agent.told == [[1, 2, 3]] * 3  # once by the task, once timed, once more
    assert {"choice, median action, CPU ms", "belief, median action, CPU ms"} <= set(case.facts)
    assert case.facts["touches"] == 1
    assert case.facts["belief after a touch, longest, CPU ms"] >= case.facts["belief after a touch, median, CPU ms"]
