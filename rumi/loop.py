"""The algorithm, top to bottom: read, believe, and until sure choose, act, read; then one last action (RUMI, Alg 1)."""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any

from rumi.agent import Agent, State, StopReason
from rumi.clock import Clock
from rumi.task import Task

Episode = Generator[Any, Any, tuple[StopReason, Any]]
"""A run that gives its actions, takes what came of them, and ends with why and the agent's result."""


@dataclass(frozen=True)
class Last:
    """The last action of a run, such as a grasp: what comes of it is no reading, but the outcome.

    Attributes:
        action: to carry out.
    """

    action: Any


def episode(agent: Agent[Any], *, seed: int, steps: int | None, on_step: Callable[[Any], None]) -> Episode:
    """One run as a generator, whose first action is None, for the first reading.

    Args:
        agent: what it believes and does.
        seed: of all randomness.
        steps: actions at most; None for as many as the agent allows itself.
        on_step: called with the record of every step, the first reading's included.
    """
    clock = Clock()
    state: State | None = None
    stopped_by: StopReason | None = None
    outcome = None
    try:
        with clock("simulate"):
            reading = yield None
        state = agent.begin(reading, seed=seed, clock=clock)
        on_step(state.record)
        while (stopped_by := agent.stop(state)) is None:
            if steps is not None and state.record.step >= steps:
                stopped_by = "steps"
                break
            state, action = agent.act(state)
            if action is None:
                stopped_by = "nothing to do"
                break
            with clock("simulate"):
                reading = yield action
            state = agent.update(state, action, reading)
            on_step(state.record)
        last = agent.last(state)
        outcome = None if last is None else (yield Last(last))
    except KeyboardInterrupt:
        if state is None:
            raise
        stopped_by = "interrupted"
    return stopped_by, agent.result(state, stopped_by, outcome)


def run(
    task: Task,
    agent: Agent[Any],
    *,
    seed: int,
    steps: int | None = None,
    on_step: Callable[[Any], None] = lambda record: None,
) -> Any:  # noqa: ANN401  (the agent's own result)
    """Let an agent do a task.

    Same seed, same task, same device and no budget: the same run, byte for byte. Ctrl-C ends it with what it has.

    Args:
        task: a simulator, hardware or a log.
        agent: what it believes and does.
        seed: of all randomness.
        steps: actions at most; None for as many as the agent allows itself.
        on_step: called with the record of every step, the first reading's included.

    Returns:
        the agent's `result`.
    """
    _, result = _ended(task, agent, seed, steps, on_step)
    return result


def run_to_end(
    task: Task,
    agent: Agent[Any],
    *,
    seed: int,
    steps: int | None = None,
    on_step: Callable[[Any], None] = lambda record: None,
) -> Any:  # noqa: ANN401  (the agent's own result)
    """Let an agent do a task as `run` does, for whoever keeps or counts the result: one that was cut off is none.

    Args:
        task: as in `run`.
        agent: as in `run`.
        seed: as in `run`.
        steps: as in `run`.
        on_step: as in `run`.

    Raises:
        KeyboardInterrupt: Ctrl-C ended the run.
    """
    stopped_by, result = _ended(task, agent, seed, steps, on_step)
    if stopped_by == "interrupted":
        raise KeyboardInterrupt
    return result


def _ended(
    task: Task, agent: Agent[Any], seed: int, steps: int | None, on_step: Callable[[Any], None]
) -> tuple[StopReason, Any]:
    """Why a run ended, and the agent's result."""
    course = episode(agent, seed=seed, steps=steps, on_step=on_step)
    next(course)
    try:
        try:
            reading = task.reset(seed)
            while True:
                reading = carry_out(task, course.send(reading))
        except KeyboardInterrupt:
            course.throw(KeyboardInterrupt)
    except StopIteration as ended:
        stopped_by, result = ended.value
    return stopped_by, result


def carry_out(task: Task, action: Any) -> Any:  # noqa: ANN401  (of the task)
    """What comes of an action of an episode: a reading, or the outcome of the last."""
    return task.finish(action.action) if isinstance(action, Last) else task.step(action)
