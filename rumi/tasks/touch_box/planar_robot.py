"""A robot whose truth is the quasi-static model itself: what an error of the model costs shows against it."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import distance_to, push_along_path
from rumi.dynamics.sliding import Sliding
from rumi.seeding import split
from rumi.tasks.grasp_table import GraspTable
from rumi.tasks.touch_box.robot import GoOn, Readings, SceneRobot, Touched
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask

_TOUCHING_M = 2e-4  # up to which tool and box touch
_SUBSTEP_M = 0.00125  # finer than a filter's, whose readings fall on the same instants


class PlanarRobot(SceneRobot):
    """Quasi-static pushes of a box with a friction and a limit surface of its own: a `TouchRobot`.

    Args:
        task: the scene, and the rates at which readings err.
        table: of grasps' success, out of which a grasp is drawn.
        levers: range of the limit surface's c, as multiples of that of even pressure.
    """

    def __init__(self, task: TouchTask, table: GraspTable, levers: tuple[float, float] = (1.22, 2.2)) -> None:
        self.task, self.table, self.levers = task, table, levers
        self._generator = split(0, "planar")
        self._readings = Readings(task.rates, task.correlation, split(0, "readings"))
        self._pose = torch.zeros(3, dtype=torch.float64)
        self._sliding = self._slides(0.4, 1.0)

    def _slides(self, friction: float, ratio: float) -> Sliding:
        lever = torch.tensor(ratio * self.task.even_lever_m, dtype=torch.float64)
        return Sliding(torch.zeros(2, dtype=torch.float64), lever, torch.tensor(friction, dtype=torch.float64))

    def reset(self, truth: BoxTruth, seed: int) -> None:
        """Stand the box where it starts."""
        self._generator = split(seed, "planar")
        self._readings = Readings(self.task.rates, self.task.correlation, split(seed, "readings"))
        low, high = self.levers
        ratio = low + (high - low) * float(torch.rand((), generator=self._generator))
        self._pose, self._sliding = truth.pose.clone(), self._slides(truth.friction, ratio)

    def execute(self, path: Float[Tensor, "K1 3"], go_on: GoOn) -> Touched:
        """Poke along a path; see `TouchRobot`."""
        path = path.double()
        outline, contact, stopped = self.task.outline, [], "end"
        substeps = math.ceil(self.task.spacing_m / _SUBSTEP_M - 1e-9)
        if float(distance_to(self._pose[None], path[:1], self.pusher, outline)) < 0:
            return Touched(path[:1], torch.zeros(0, dtype=torch.bool), True, "blocked")
        for k in range(1, len(path)):
            way = path[None, k - 1 : k + 1]
            carried = push_along_path(self._pose[None], way, self.pusher, outline, self._sliding, substeps=substeps)
            self._pose = carried.track[0, -1]
            contact.append(self._readings(float(carried.distance) <= _TOUCHING_M))
            so_far = Touched(path[: k + 1], torch.tensor(contact), False, "end")
            if k < len(path) - 1 and not go_on(so_far):
                stopped = "belief"
                break
        return Touched(path[: len(contact) + 1], torch.tensor(contact), False, stopped)

    def grasp(self, pose: Float[Tensor, "3"]) -> bool:
        """Whether a grasp succeeds, drawn at the table's odds."""
        odds = float(self.table(pose.double(), self._pose))
        return float(torch.rand((), generator=self._generator)) < odds

    def box_pose(self) -> Float[Tensor, "3"]:
        """(x, y, yaw) of the box."""
        return self._pose.clone()

    def put_box(self, pose: Float[Tensor, "3"]) -> None:
        """Stand the box at (x, y, yaw)."""
        self._pose = pose.double()
