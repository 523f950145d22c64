"""A recorded log in a robot's place: the belief that the live run had, or the one that other settings would have."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.errors import UsageError
from rumi.loop import rummage
from rumi.planning.policy import Plan, Scene
from rumi.records import RunResult, StepRecord
from rumi.runs.logbook import digest
from rumi.task import StepResult, Task
from rumi.tasks.rummage.agent import Rummager

if TYPE_CHECKING:
    from sensors.log.reader import Taken


@dataclass(frozen=True)
class Replayed:
    """What came of a replay.

    Attributes:
        result: how it ended, as a run does.
        same: of each step, whether the belief is the recorded one bit for bit; None where none was recorded.
        robot_s: seconds that the robot took for the steps replayed, by the readings' stamps.
        wall_s: seconds that the replay took.
        last: the record of the last step.
    """

    result: RunResult
    same: list[bool | None]
    robot_s: float
    wall_s: float
    last: StepRecord


class LogTask:
    """A `rumi.task.Task` that gives back what a log holds, whatever it is asked to do.

    Args:
        taken: what the log holds, the first view first.

    Raises:
        UsageError: nothing is there.
    """

    def __init__(self, taken: "Sequence[Taken]") -> None:
        if not taken:
            raise UsageError("Expected a log with a first reading at least, got none: there is nothing to replay")
        self._taken = taken
        self.step_at = 0

    def reset(self, seed: int) -> StepResult:
        """Go to the first reading; the seed changes nothing."""
        self.step_at = 0
        return self._result()

    def step(self, control: Float[Tensor, "A"]) -> StepResult:
        """The next reading, whatever the control."""
        if self.step_at + 1 >= len(self._taken):
            raise UsageError(f"Expected at most {len(self._taken) - 1} steps: the log has no more")
        self.step_at += 1
        return self._result()

    def close(self) -> None:
        """Nothing to let go of."""

    def _result(self) -> StepResult:
        taken = self._taken[self.step_at]
        return StepResult(taken.reading, taken.truth)


class LogPolicy:
    """A policy that does what was done.

    Args:
        task: tells how far the replay is.
        controls: of each step but the first.
    """

    def __init__(self, task: LogTask, controls: Sequence[Float[Tensor, "A"]]) -> None:
        self._task, self._controls = task, controls

    def act(
        self,
        belief: PoseBelief,
        scene: Scene,
        previous: Plan | None,
        *,
        executed: int,
        budget_s: float | None,
        generator: torch.Generator,
    ) -> Plan:
        """The action that was carried out next."""
        control = self._controls[self._task.step_at].to(scene.configuration)
        return Plan(control[None], scene.configuration[None].expand(2, -1))


def replay(
    taken: "Sequence[Taken]",
    rummager: Rummager,
    *,
    seed: int,
    on_step: Callable[[StepRecord], None] | None = None,
    wrap: Callable[[Task], Task] | None = None,
) -> Replayed:
    """Take in a log's readings by the algorithm that takes in a robot's.

    With the settings, the seed and the machine of the run that was recorded, the beliefs are the same bit for bit on
    the CPU: nothing that is planned reaches a belief but through what is done, and that is recorded.

    Args:
        taken: what the log holds.
        rummager: how; its policy is not used.
        seed: of all randomness.
        on_step: called with the record of every step.
        wrap: makes of the log's task one whose readings are elsewhere (`rumi.tasks.rummage.build.Elsewhere`).
    """
    task = LogTask(taken)
    none = torch.zeros_like(taken[0].reading.configuration)
    controls = [none if one.control is None else one.control for one in taken[1:]]
    doing = replace(rummager, policy=LogPolicy(task, controls), replan_every=1, budget_s=None)
    same: list[bool | None] = []
    steps: list[StepRecord] = []

    def seen(step: StepRecord) -> None:
        recorded = taken[step.step].digest
        same.append(None if recorded is None else digest(step.belief) == recorded)
        steps.append(step)
        if on_step is not None:
            on_step(step)

    start = time.perf_counter()
    source: Task = task if wrap is None else wrap(task)
    result = rummage(source, doing, seed=seed, steps=len(taken) - 1, on_step=seen)
    wall = time.perf_counter() - start
    return Replayed(result, same, steps[-1].reading.stamp - steps[0].reading.stamp, wall, steps[-1])
