"""A recording in a robot's place: the belief that the live run had, or the one that other settings would have."""

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

from rumi.agent import Agent, StopReason
from rumi.belief.particles import PoseBelief
from rumi.errors import UsageError
from rumi.loop import run
from rumi.task import StepResult, Task
from sensors.log.reader import Taken

_POSES = ("world_T_attached", "attached_T_object", "log_weights", "discrepancy")


@dataclass(frozen=True)
class Replayed:
    """What came of a replay.

    Attributes:
        result: how it ended, as a run does; nothing is grasped or inserted.
        same: of each step, whether the belief is the recorded one bit for bit; None where none was recorded.
        wall_s: seconds that the replay took.
        steps: the records.
    """

    result: Any
    same: list[bool | None]
    wall_s: float
    steps: list[Any]

    @property
    def last(self) -> Any:  # noqa: ANN401  (a record of the task's own kind)
        """The record of the last step."""
        return self.steps[-1]

    @property
    def robot_s(self) -> float:
        """Seconds that the robot took for the steps replayed, by the readings' stamps."""
        return float(self.steps[-1].stamp - self.steps[0].stamp)


class LogTask:
    """A `rumi.task.Task` that gives back what a recording holds, whatever it is asked to do.

    Args:
        recorded: the steps, the first reading first.

    Raises:
        UsageError: nothing is there.
    """

    def __init__(self, recorded: Sequence[Taken]) -> None:
        if not recorded:
            raise UsageError("Expected a log with a first reading at least, got none: there is nothing to replay")
        self._recorded = recorded
        self.step_at = 0

    def reset(self, seed: int) -> StepResult:
        """Go to the first reading; the seed changes nothing."""
        self.step_at = 0
        return self._result()

    def step(self, action: Any) -> StepResult:  # noqa: ANN401  (whatever it is)
        """The next reading, whatever the action."""
        if self.step_at + 1 >= len(self._recorded):
            raise UsageError(f"Expected at most {len(self._recorded) - 1} steps: the log has no more")
        self.step_at += 1
        return self._result()

    def finish(self, action: Any) -> None:  # noqa: ANN401
        """What came of a last action is not replayed."""

    def close(self) -> None:
        """Nothing to let go of."""

    def _result(self) -> StepResult:
        one = self._recorded[self.step_at]
        return StepResult(one.reading, one.truth)


@dataclass(frozen=True)
class Repeat:
    """An agent that does what was done: the belief is the agent's, the actions are a recording's.

    Nothing that is thought of reaches a belief but through what is done, so that the beliefs are those of the run.

    Attributes:
        agent: whose belief follows the readings.
        actions: of each step but the first.
    """

    agent: Agent[Any]
    actions: Sequence[Any]

    def stop(self, state: Any) -> StopReason | None:  # noqa: ANN401
        """Stop where the agent is sure: a recording knows neither its clock nor its number of actions."""
        return "sure" if self.agent.stop(state) == "sure" else None

    def act(self, state: Any) -> tuple[Any, Any]:  # noqa: ANN401
        """The action that was carried out next."""
        return state, self.actions[state.record.step]

    def last(self, state: Any) -> None:  # noqa: ANN401
        """Nothing is done at the end."""

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (the rest is the agent's)
        return getattr(self.agent, name)


def replay(
    recorded: Sequence[Taken],
    agent: Agent[Any],
    *,
    seed: int,
    on_step: Callable[[Any], None] = lambda record: None,
    wrap: Callable[[Task], Task] = lambda task: task,
) -> Replayed:
    """Take in a recording's readings by the algorithm that takes in a robot's.

    With the settings, the seed and the machine of the run that was recorded, the beliefs are the same bit for bit on
    the CPU: nothing that is planned reaches a belief but through what is done, and that is recorded.

    Args:
        recorded: the steps, the first reading first.
        agent: whose belief follows them; what it would do is not asked.
        seed: of all randomness.
        on_step: called with the record of every step.
        wrap: makes of the recording's task one whose readings are elsewhere (`rumi.task.TaskOnDevice`).

    Raises:
        UsageError: nothing is there.
    """
    task = wrap(LogTask(recorded))
    actions = [
        torch.zeros_like(one.reading.configuration) if one.control is None else one.control for one in recorded[1:]
    ]
    same: list[bool | None] = []
    steps: list[Any] = []

    def compared(step: Any) -> None:  # noqa: ANN401  (of the task's own kind)
        theirs = recorded[step.step].digest
        same.append(None if theirs is None else digest(step.belief) == theirs)
        steps.append(step)
        on_step(step)

    start = time.perf_counter()
    repeat: Any = Repeat(agent, actions)
    result = run(task, repeat, seed=seed, steps=len(actions), on_step=compared)
    return Replayed(result, same, time.perf_counter() - start, steps)


def digest(belief: Any) -> bytes:  # noqa: ANN401  (a belief of any task)
    """SHA-256 of a belief: two beliefs have the same if and only if they are the same bit for bit."""
    total = hashlib.sha256()
    for values in _tensors(belief):
        array = values.detach().cpu().contiguous().numpy()
        total.update(f"{array.dtype.str}{array.shape}".encode())
        total.update(array.tobytes())
    return total.digest()


def _tensors(value: Any) -> Iterator[Tensor]:  # noqa: ANN401
    if isinstance(value, PoseBelief):  # what was felt is in the readings
        yield from (getattr(value, name) for name in _POSES)
    elif isinstance(value, Tensor):
        yield value
    elif is_dataclass(value):
        for part in fields(value):
            yield from _tensors(getattr(value, part.name))
    elif isinstance(value, tuple | list):
        for item in value:
            yield from _tensors(item)
