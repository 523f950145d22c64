"""The border between the algorithm and a robot: a simulator or hardware is a Task."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from sensors.reading import Reading


@dataclass(frozen=True)
class StepResult:
    """What came of one action.

    Attributes:
        reading: what the sensors reported.
        truth: (4, 4) true world_T_object, for metrics alone; None on hardware.
    """

    reading: Reading
    truth: Float[Tensor, "4 4"] | None


@runtime_checkable
class Task(Protocol):
    """A robot with an object in front of it; runs one scene."""

    def reset(self, seed: int) -> StepResult:
        """Put everything at its start and return the first view; its reading has one instant."""
        ...

    def step(self, control: Float[Tensor, "A"]) -> StepResult:
        """Carry out one control in [-1, 1]^A, clipped to what the arm reaches, and report."""
        ...

    def close(self) -> None:
        """Let go of the simulator or the robot."""
        ...
