"""Whole actions of each task by its own default, the simulator left out: choosing, and taking in what came of it."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from torch import Tensor

from rumi import loop
from rumi.bench.case import Case, Setup, Variant, case, cases, largest_difference
from rumi.clock import Clock
from rumi.records import StepRecord
from rumi.task import StepResult
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset

_SEED = 0
_ACTIONS = 8  # of a run, at most
_FIXED = ("mug-0", "drill-0", "box-0", "shelf-mug", "touch-box", "peg", "handle")
_DRAWN, _WHOLE = ("mug", "drill", "box", "drawn-shelf-mug", "drawn-shelf-box"), 40  # of which whole runs are replayed


class Replay:
    """A task that reports what another one reported before, whatever it is told to do.

    Args:
        results: of the first view and of each action.
        outcome: of the last action.
    """

    def __init__(self, results: Sequence[Any], outcome: object = None) -> None:
        self.results, self.outcome, self._at = tuple(results), outcome, 0

    def reset(self, seed: int) -> Any:  # noqa: ANN401  (the other task's)
        """The first view."""
        self._at = 0
        return self.results[0]

    def step(self, action: object) -> Any:  # noqa: ANN401
        """What came of the next action then."""
        self._at += 1
        return self.results[self._at]

    def finish(self, action: object) -> object:
        """What came of the last action then."""
        return self.outcome

    def close(self) -> None:
        """Nothing to let go of."""


@dataclass
class _Kept:
    """A task that keeps what it reports."""

    task: Any
    results: list[Any] = field(default_factory=list)
    outcome: object = None

    def reset(self, seed: int) -> Any:  # noqa: ANN401  (the task's)
        return self._told(self.task.reset(seed))

    def step(self, action: object) -> Any:  # noqa: ANN401
        return self._told(self.task.step(action))

    def finish(self, action: object) -> object:
        self.outcome = self.task.finish(action)
        return self.outcome

    def close(self) -> None:
        self.task.close()

    def _told(self, result: Any) -> Any:  # noqa: ANN401
        self.results.append(result)
        return result


@dataclass
class _Timed:
    """An agent whose choices and updates, and their stages, are timed by the processor's clock, seconds."""

    agent: Any
    choices: list[float] = field(default_factory=list)
    updates: list[float] = field(default_factory=list)

    def begin(self, result: Any, *, seed: int, clock: Clock) -> Any:  # noqa: ANN401  (the agent's)
        return self.agent.begin(result, seed=seed, clock=Clock(time.process_time))

    def act(self, state: Any) -> Any:  # noqa: ANN401
        return self._timed(self.choices, lambda: self.agent.act(state))

    def update(self, state: Any, action: Any, result: Any) -> Any:  # noqa: ANN401
        return self._timed(self.updates, lambda: self.agent.update(state, action, result))

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self.agent, name)

    @staticmethod
    def _timed(seconds: list[float], do: Callable[[], Any]) -> Any:  # noqa: ANN401
        start = time.process_time()
        try:
            return do()
        finally:
            seconds.append(time.process_time() - start)


@cases(
    {f"actions-{name}": (name, _ACTIONS if name in _FIXED else _WHOLE) for name in (*_FIXED, *_DRAWN)},
    slow=True,
    host=True,
)
def actions(setup: Setup, name: str, most: int) -> Case:
    """A run of a task by its default, and its replay without the simulator."""
    entry = TASKS[name]
    settings = replace(entry.preset(entry.presets[0]), seed=_SEED)
    with entry.build(settings, cache_dir=setup.cache_dir) as parts:
        kept, agent = _Kept(parts.task), parts.agent
        loop.run_to_end(kept, agent, seed=_SEED, steps=setup.size(most, 2))
    task, steps = Replay(kept.results, kept.outcome), len(kept.results) - 1

    def run() -> int:
        records: list[Any] = []
        loop.run_to_end(task, agent, seed=_SEED, steps=steps, on_step=records.append)
        return len(records) - 1

    watched = [_Timed(agent) for _ in range(setup.size(3, 1))]
    stages, touches = list[dict[str, float]](), list[list[float]]()
    for timed in watched:
        records: list[Any] = []
        loop.run_to_end(task, timed, seed=_SEED, steps=steps, on_step=records.append)
        stages.append(_medians([getattr(record, "timings_s", {}) for record in records[1:]]))
        touches.append([record.timings_s.get("belief", 0.0) for record in records[1:] if _touched(record)])
    least = {stage: min(one[stage] for one in stages) for stage in stages[0]}
    facts = {
        "choice, median action, CPU ms": _least_median([timed.choices for timed in watched]),
        "update, median action, CPU ms": _least_median([timed.updates for timed in watched]),
        "update, longest, CPU ms": _ms(max(min(each) for each in zip(*(t.updates for t in watched), strict=True))),
    }
    if touches[0]:
        facts["touches"] = len(touches[0])
        facts["belief after a touch, median, CPU ms"] = _least_median(touches)
        facts["belief after a touch, longest, CPU ms"] = _ms(max(min(each) for each in zip(*touches, strict=True)))
    return Case(
        f"{steps} actions of {name} by its default, replayed: all but the simulator, the first belief included",
        (Variant(setup.versions[-1], run, version=setup.versions[-1]),),
        otherwise=setup.versions[-1],
        items=steps,
        item="action",
        facts=facts | {f"{stage}, median action, CPU ms": _ms(seconds) for stage, seconds in least.items()},
        rounds=3,
    )


def _touched(record: object) -> bool:
    felt = getattr(getattr(record, "reading", None), "in_contact", None)
    return felt is not None and bool(felt.any())


def _medians(timings: Sequence[dict[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for one in timings for name in one)
    return {name: statistics.median(one.get(name, 0.0) for one in timings) for name in names}


def _least_median(runs: Sequence[Sequence[float]]) -> float:
    return _ms(statistics.median(min(each) for each in zip(*runs, strict=True)))


def _ms(seconds: float) -> float:
    return round(1e3 * seconds, 2)


@case("run-mug", slow=True)
def run_mug(setup: Setup) -> Case:
    """All that a run of mug-0 computes, version against version."""
    settings = preset("default", task="mug-0", seed=_SEED, device=setup.device.type)
    steps = 40
    if setup.tiny:
        mppi = replace(settings.planner.mppi, samples=8, warmup_iterations=1)
        small = replace(settings.initialise, particles=12, starts=40, polished=12)
        settings = replace(settings, planner=replace(settings.planner, mppi=mppi, rollouts=1), initialise=small)
        steps = 2
    with build(settings, cache_dir=setup.cache_dir) as parts:
        kept, agent = _Kept(parts.task), parts.agent
        loop.run_to_end(kept, agent, seed=_SEED, steps=steps)
    task, count = (
        Replay([StepResult(StepResult.of(told).reading, None) for told in kept.results]),
        len(kept.results) - 1,
    )

    def run() -> tuple[Tensor, int]:
        records: list[StepRecord] = []
        loop.run_to_end(task, agent, seed=_SEED, steps=count, on_step=records.append)
        return records[-1].belief.mode()[:3, 3], len(records) - 1

    return Case(
        f"whole run of mug-0, its {count} recorded actions replayed: all but the simulator",
        setup.ours(run),
        items=count,
        item="action",
        error=lambda found, reference: largest_difference(found[0], reference[0]),
        tolerance=2e-3,
        facts={"error": "of the likeliest position, m"},
        rounds=3,
    )
