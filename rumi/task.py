"""The border between the algorithm and a robot: a simulator, hardware or a log is a Task."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from sdf.containers import container
from sensors.reading import Reading


@container()
@dataclass(frozen=True)
class StepResult:
    """What came of one action.

    Attributes:
        reading: what the sensors reported; of a robot that pushes things about a `Reading`.
        truth: true pose of the object, (4, 4) world_T_object or (3,) for (x, y, yaw), for metrics alone; None on
            hardware.
    """

    reading: Any
    truth: Tensor | None = None

    @classmethod
    def of(cls, given: "StepResult | Reading") -> "StepResult":
        """What a task gave: a bare reading comes without the truth."""
        return given if isinstance(given, StepResult) else cls(given)


@runtime_checkable
class Task(Protocol):
    """A robot with an object in front of it; runs one scene."""

    def reset(self, seed: int) -> Any:  # noqa: ANN401  (a StepResult or its reading)
        """Put everything at its start and return the first view; a `Reading` of it has one instant."""
        ...

    def step(self, action: Any) -> Any:  # noqa: ANN401
        """Carry out one action, such as a control in [-1, 1]^A, clipped to what the arm reaches, and report."""
        ...

    def finish(self, action: Any) -> Any:  # noqa: ANN401
        """Carry out the last action, such as a grasp, and say what came of it; called where the agent has one."""
        ...

    def close(self) -> None:
        """Let go of the simulator or the robot."""
        ...


class TaskOnDevice:
    """A task whose readings arrive on another device or in another dtype.

    Args:
        task: the robot, whose readings are float32 on the CPU.
        device: of the readings.
        dtype: of their floating numbers.
    """

    def __init__(self, task: Task, device: torch.device, dtype: torch.dtype) -> None:
        self.task, self.device, self.dtype = task, device, dtype

    def reset(self, seed: int) -> StepResult:
        """Put everything at its start and return the first view."""
        return self._moved(self.task.reset(seed))

    def step(self, action: Tensor) -> StepResult:
        """Carry out one control and report."""
        return self._moved(self.task.step(action.to("cpu", torch.float32)))

    def finish(self, action: Any) -> Any:  # noqa: ANN401  (the task's own)
        """Carry out the last action."""
        return self.task.finish(action)

    def close(self) -> None:
        """Let go of the robot."""
        self.task.close()

    def _moved(self, given: StepResult | Reading) -> StepResult:
        result = StepResult.of(given)
        truth = None if result.truth is None else result.truth.to(self.device, self.dtype)
        return StepResult(result.reading.to(self.device, self.dtype), truth)
