"""The gripper of the touch-alone task in MuJoCo: it pokes with closed fingers, feels at stated rates, and grasps."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.seeding import split
from rumi.sim.world import _import_mujoco
from rumi.tasks.grasp_primitive import DROP_S, LIFT_S, REST_S, grasp_controls
from rumi.tasks.touch_box.mujoco_scene import CLEAR_M, GripperPhysics, scene_xml, set_truth
from rumi.tasks.touch_box.robot import GoOn, Readings, SceneRobot, Touched
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask

TOUCHING_M = 2e-4
"""Distance up to which fingers and box touch: what stiff contacts bounce by."""

_SETTLE_S = 0.3
_REACHED_M = 0.01  # above the height of pokes, where the tool counts as down
_LIFT_M = 0.10
LIFTED_M = 0.5 * _LIFT_M
"""How far a box must rise in a grasp to count as lifted."""
_DRIVES = ("x", "y", "z", "yaw", "left", "right")


class GripperRobot(SceneRobot):
    """A free-flying gripper with simulated contact: a `TouchRobot`.

    Between pokes it is lifted clear of the box and put over the next start, where nothing is in its way.

    Args:
        task: the scene, and the rates at which readings err.
        physics: drive and contact.
    """

    def __init__(self, task: TouchTask, physics: GripperPhysics | None = None) -> None:
        self._mujoco = _import_mujoco()
        self.task, self.physics = task, physics or GripperPhysics()
        texts = [scene_xml(task, self.physics, grasping=grasping) for grasping in (False, True)]
        self.poking, self.grasping = (self._mujoco.MjModel.from_xml_string(text) for text in texts)
        self.data: Any = self._mujoco.MjData(self.poking)
        self._place = [int(self.poking.joint(name).qposadr[0]) for name in _DRIVES]
        self._speed = [int(self.poking.joint(name).dofadr[0]) for name in _DRIVES]
        self._box = int(self.poking.joint("box").qposadr[0])
        self._geoms = [int(self.poking.geom(name).id) for name in ("left", "right", "box")]
        self._readings = Readings(task.rates, task.correlation, split(0, "readings"))

    def reset(self, truth: BoxTruth, seed: int) -> None:
        """Put the box where it starts, the gripper above, and let the box settle."""
        for model in (self.poking, self.grasping):
            set_truth(self._mujoco, model, self.task, truth)
        self._readings = Readings(self.task.rates, self.task.correlation, split(seed, "readings"))
        self._mujoco.mj_resetData(self.poking, self.data)
        self.put_box(truth.pose)
        self._over(truth.pose, self.task.finger_m)
        self._steps(self.poking, _SETTLE_S)

    def put_box(self, pose: Float[Tensor, "3"]) -> None:
        """Stand the box at (x, y, yaw)."""
        x, y, yaw = pose.tolist()
        start = self._box
        self.data.qpos[start : start + 7] = (
            *(x, y, 0.5 * self.task.height_m),
            *(math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)),
        )
        self.data.joint("box").qvel[:] = 0.0

    def execute(self, path: Float[Tensor, "K1 3"], go_on: GoOn) -> Touched:
        """Poke along a path; see `TouchRobot`."""
        self._over(path[0], self.task.finger_m)
        self._descend()
        measured, contact, stopped = [self._tool()], [], "end"
        if float(self.data.qpos[self._place[2]]) > _REACHED_M:
            self._lift()
            return Touched(torch.stack(measured), torch.zeros(0, dtype=torch.bool), True, "blocked")
        for k in range(1, len(path)):
            self._drive(path[k - 1], path[k], last=k == len(path) - 1)
            measured.append(self._tool())
            contact.append(self._readings(self.gap() <= TOUCHING_M))
            so_far = Touched(torch.stack(measured), torch.tensor(contact), False, "end")
            if k < len(path) - 1 and not go_on(so_far):
                stopped = "belief"
                self._steps(self.poking, REST_S)
                break
        self._lift()
        return Touched(torch.stack(measured), torch.tensor(contact, dtype=torch.bool), False, stopped)

    def grasp(self, pose: Float[Tensor, "3"]) -> bool:
        """Come down open about the box's narrow sides, close, lift; whether its middle rose by half of the lift."""
        self.above(pose)
        before = float(self.data.qpos[self.box_height])
        pose = pose + pose.new_tensor([0.0, 0.0, 0.5 * math.pi])
        for control in self.grasp_controls(pose):
            self.data.ctrl[:] = control
            self._mujoco.mj_step(self.grasping, self.data)
        return float(self.data.qpos[self.box_height]) - before > LIFTED_M

    def above(self, pose: Float[Tensor, "3"]) -> None:
        """Stand open above a box at a pose, across it: the fingers close along the tool's y."""
        self._over(pose + pose.new_tensor([0.0, 0.0, 0.5 * math.pi]), self._opened())

    @property
    def box_height(self) -> int:
        """Place of the box's height in the state."""
        return self._box + 2

    def grasp_controls(self, pose: Float[Tensor, "3"]) -> np.ndarray:
        """The grasp primitive (T, 6) at a pose of the tool: down, close, up, hold."""
        x, y, yaw = pose.tolist()
        fingers = self._opened(), self.task.half[0] - 0.01
        return grasp_controls((x, y, yaw), fingers, (CLEAR_M, _LIFT_M), self.physics.time_step_s)[1:]

    def box_pose(self) -> Float[Tensor, "3"]:
        """(x, y, yaw) of the box."""
        x, y, _, w, i, j, k = self.data.qpos[self._box : self._box + 7].tolist()
        yaw = math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))
        return torch.tensor([x, y, yaw], dtype=torch.float64)

    def gap(self) -> float:
        """Distance from the fingers to the box, metres."""
        self._mujoco.mj_kinematics(self.poking, self.data)
        left, right, box = self._geoms
        return min(
            float(self._mujoco.mj_geomDistance(self.poking, self.data, finger, box, 1.0, None))
            for finger in (left, right)
        )

    def _opened(self) -> float:
        return 0.5 * self.task.opening_m + self.task.finger_m

    def _tool(self) -> Float[Tensor, "3"]:
        x, y, _, yaw, _, _ = self.data.qpos[self._place].tolist()
        return torch.tensor([x, y, yaw], dtype=torch.float64)

    def _over(self, pose: Float[Tensor, "3"], finger: float) -> None:
        """Stand above a pose, at rest."""
        x, y, yaw = pose.tolist()
        self.data.qpos[self._place] = (x, y, CLEAR_M, yaw, finger, finger)
        self.data.qvel[self._speed] = 0.0
        self.data.ctrl[:] = self.data.qpos[self._place]

    def _descend(self) -> None:
        self._go(2, 0.0, DROP_S)
        self._steps(self.poking, REST_S)

    def _lift(self) -> None:
        self.data.ctrl[:2] = self.data.qpos[self._place[:2]]
        self._go(2, CLEAR_M, LIFT_S)
        self._steps(self.poking, REST_S)

    def _go(self, axis: int, target: float, seconds: float) -> None:
        count = round(seconds / self.physics.time_step_s)
        for command in np.linspace(float(self.data.ctrl[axis]), target, count + 1)[1:]:
            self.data.ctrl[axis] = command
            self._mujoco.mj_step(self.poking, self.data)

    def _drive(self, begin: Float[Tensor, "3"], end: Float[Tensor, "3"], *, last: bool) -> None:
        """Along one part of a path; at rest at the end of the last."""
        length = float((end - begin)[:2].norm())
        count = max(1, round(length / self.task.speed / self.physics.time_step_s))
        target = [float(self.data.ctrl[axis]) for axis in (0, 1, 3)]
        begin_, way = np.array(target), (end.double().numpy() - np.array(target))
        for share in (np.arange(count) + 1.0) / count:
            self.data.ctrl[[0, 1, 3]] = begin_ + share * way
            self._mujoco.mj_step(self.poking, self.data)
        if last:
            self._steps(self.poking, REST_S)

    def _steps(self, model: Any, seconds: float) -> None:  # noqa: ANN401
        self._mujoco.mj_step(model, self.data, nstep=max(1, round(seconds / self.physics.time_step_s)))
