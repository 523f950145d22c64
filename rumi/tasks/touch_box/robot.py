"""What the loop asks of a robot that pokes and grasps, and how simulated readings err."""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.dynamics.along_path import Pusher
from rumi.task import StepResult
from rumi.tasks.grasp_table import Grasp
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask, draw_truth


class Touched(NamedTuple):
    """What a poke was and felt.

    Attributes:
        path: (K + 1, 3), measured (x, y, yaw) of the tool at the instants that were reached, the start first.
        contact: (K), the reading at the end of each part.
        blocked: the tool could not come down at the start of the path, since the box stands there; then K = 0. None
            if it did not try, which tells nothing: the start is out of its reach.
        stopped: "end", "belief" (who asked for the poke said so), "force" (the robot's limit), "blocked" or "reach".
    """

    path: Float[Tensor, "K1 3"]
    contact: Bool[Tensor, "K"]
    blocked: bool | None
    stopped: str


GoOn = Callable[[Touched], bool]
"""Asked after every reading with what was felt so far; False ends the poke."""


class Poke(NamedTuple):
    """An action.

    Attributes:
        path: (K + 1, 3), of the tool.
        go_on: asked after every reading whether to go on with it.
    """

    path: Float[Tensor, "K1 3"]
    go_on: GoOn


@runtime_checkable
class TouchRobot(Protocol):
    """A robot before a box, simulated or not."""

    @property
    def pusher(self) -> Pusher:
        """Footprint of what pokes, tool frame."""
        ...

    def reset(self, truth: BoxTruth, seed: int) -> None:
        """Set a run up; a robot that is not simulated takes what is there."""
        ...

    def feasible(self, paths: Float[Tensor, "C K1 3"]) -> Bool[Tensor, "C"]:
        """Which paths the robot can follow."""
        ...

    def execute(self, path: Float[Tensor, "K1 3"], go_on: GoOn) -> Touched:
        """Lift, travel over, come down at the path's start, follow it with a reading at each further instant, lift."""
        ...

    def grasp(self, pose: Float[Tensor, "3"]) -> bool:
        """Grasp a box as if it stood at a pose; whether it was lifted."""
        ...

    def box_pose(self) -> Float[Tensor, "3"]:
        """Where the box is, for judging alone."""
        ...

    def close(self) -> None:
        """Give back what it holds."""
        ...


@runtime_checkable
class SimulatedBox(TouchRobot, Protocol):
    """A robot before a simulated box, which can be put elsewhere."""

    def put_box(self, pose: Float[Tensor, "3"]) -> None:
        """Stand the box at (x, y, yaw)."""
        ...


class SceneRobot:
    """What simulated robots before a box share: closed fingers that poke and that nothing holds."""

    task: TouchTask

    @property
    def pusher(self) -> Pusher:
        """The closed fingers."""
        return self.task.fingers

    def feasible(self, paths: Float[Tensor, "C K1 3"]) -> Bool[Tensor, "C"]:
        """All."""
        return torch.ones(len(paths), dtype=torch.bool)

    def close(self) -> None:
        """Nothing is held."""


class TouchBox:
    """The task: a robot before a box whose place is drawn by the seed.

    Args:
        scene: what the box's place is drawn of.
        robot: that pokes and grasps.
    """

    def __init__(self, scene: TouchTask, robot: TouchRobot) -> None:
        self.scene, self.robot = scene, robot

    def reset(self, seed: int) -> StepResult:
        """Put the box where the seed has it; nothing is felt yet."""
        self.robot.reset(draw_truth(self.scene, seed), seed)
        return StepResult(None, self.robot.box_pose())

    def step(self, poke: Poke) -> StepResult:
        """Carry out a poke."""
        return StepResult(self.robot.execute(*poke), self.robot.box_pose())

    def finish(self, grasp: Grasp) -> bool:
        """Grasp the box where it is taken to stand; whether it was lifted."""
        return self.robot.grasp(grasp.pose)

    def close(self) -> None:
        """Let go of the robot."""
        self.robot.close()


class Readings:
    """Contact readings that err at stated rates, independently or in a row.

    A reading says contact where a uniform number is below the rate that holds: the true positive rate in contact, the
    false positive rate elsewhere. With a correlation the number of the reading before is kept with that chance, so that
    errors last; each reading by itself errs at its rate all the same.

    Args:
        rates: true and false positive rate.
        correlation: chance that the number is kept.
        generator: all randomness.
    """

    def __init__(self, rates: tuple[float, float], correlation: float, generator: torch.Generator) -> None:
        self.rates, self.correlation, self._generator = rates, correlation, generator
        self._number = float(self._uniform())

    def _uniform(self) -> Tensor:
        return torch.rand((), generator=self._generator, dtype=torch.float64)

    def __call__(self, touching: bool) -> bool:
        """The next reading."""
        keep, fresh = float(self._uniform()), float(self._uniform())
        if keep >= self.correlation:
            self._number = fresh
        return self._number < self.rates[0 if touching else 1]
