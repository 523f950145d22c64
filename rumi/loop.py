"""The algorithm, top to bottom: read, believe, and until sure choose, act, read; then one last action (RUMI, Alg 1)."""

from collections.abc import Callable
from typing import Any

from rumi.agent import Agent, State, StopReason
from rumi.clock import Clock
from rumi.task import Task


def run(
    task: Task,
    agent: Agent[Any],
    *,
    seed: int,
    steps: int | None = None,
    on_step: Callable[[Any], None] = lambda record: None,
) -> Any:  # noqa: ANN401  (the agent's own result)
    """Let an agent do a task.

    Same seed, same task, same device and no budget: the same run, byte for byte. Ctrl-C ends the run with what it has.

    Args:
        task: a simulator, hardware or a log.
        agent: what it believes and does.
        seed: of all randomness.
        steps: actions at most; None for as many as the agent allows itself.
        on_step: called with the record of every step, the first reading's included.

    Returns:
        the agent's `result`.
    """
    clock = Clock()
    state: State | None = None
    stopped_by: StopReason | None = None
    outcome = None
    try:
        with clock("simulate"):
            reading = task.reset(seed)
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
                reading = task.step(action)
            state = agent.update(state, action, reading)
            on_step(state.record)
        last = agent.last(state)
        outcome = None if last is None else task.finish(last)
    except KeyboardInterrupt:
        if state is None:
            raise
        stopped_by = "interrupted"
    return agent.result(state, stopped_by, outcome)
