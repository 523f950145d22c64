"""The arm of the touch-alone task: it pokes and grasps under torque control and feels by its joints' torques."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.dynamics.along_path import unwrapped
from rumi.sim.arm_motion import joint_path
from rumi.sim.arm_scene import ArmPhysics
from rumi.sim.torque_arm import Motion, TorqueArm, TorqueSample, TorqueSettings
from rumi.tasks.touch_box.gripper_robot import LIFTED_M
from rumi.tasks.touch_box.mujoco_scene import CLEAR_M, set_truth
from rumi.tasks.touch_box.robot import GoOn, SceneRobot, Touched
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask

THRESHOLD_NM = 0.15
RATES, CORRELATION = (0.97, 0.005), 0.0
"""True and false positive rate of a reading, and the chance that an error repeats (`scripts.torque_rates`)."""

_REST_S, _SETTLE_S, _CLOSE_S, _STOP_S = 0.15, 0.3, 0.5, 0.05
_DOWN, _DOWN_RATE = 9, 10.0  # knots of a way down or up, and how many a second
_DOWN_M = 0.01  # above the height of pokes, where the tool counts as down
_SQUEEZE_M = 0.01  # that closed fingers would be inside of the box
_SLIDE_M = 5e-4  # after the last reading that was asked for, from which on it is told


class ArmRobot(SceneRobot):
    """The arm before a box: a `rumi.tasks.touch_box.robot.TouchRobot`.

    The way from one poke to the next is not simulated: the arm is above all that it could touch. A path that it can
    follow in part it follows as far as it can. The hand may be turned by half a turn, which its fingers do not show.

    Args:
        task: the scene; readings are the arm's own, so that the task's rates are not used.
        settings: control, noise and reading of the arm; by default with the threshold of the stated rates.
    """

    rates, correlation = RATES, CORRELATION

    def __init__(self, task: TouchTask, settings: TorqueSettings | None = None) -> None:
        self.task = task
        own = ArmPhysics(finger_m=task.finger_m)
        settings = settings or TorqueSettings(threshold_nm=THRESHOLD_NM)
        self.arm = TorqueArm(task.half, task.height_m, own, settings)
        self._found: dict[bytes, tuple[np.ndarray, float]] = {}

    def reset(self, truth: BoxTruth, seed: int) -> None:
        """Put the box where it starts, draw what the arm's model has wrong, calibrate it, and let the box settle."""
        arm = self.arm
        set_truth(arm.mujoco, arm.model, self.task, truth)
        arm.mujoco.mj_resetData(arm.model, arm.data)
        arm.seed(seed)
        arm.put_box(truth.pose)
        arm.calibrate()
        x, y, _ = truth.pose.tolist()
        above, _ = arm.kinematics.solve(np.array([x, y, CLEAR_M, 0.0]), arm.kinematics.home(np.array([x, y, 0.0, 0.0])))
        arm.stand(above, self.task.finger_m)
        arm.rest(_SETTLE_S, above)

    def feasible(self, paths: Float[Tensor, "C K1 3"]) -> Bool[Tensor, "C"]:
        """Which paths the arm can come down to and follow to their ends, by inverse kinematics."""
        self._found.clear()
        wanted = paths.shape[1] + _DOWN - 1
        return torch.tensor([len(self._way(path)[0]) == wanted for path in paths], dtype=torch.bool)

    def execute(self, path: Float[Tensor, "K1 3"], go_on: GoOn) -> Touched:
        """Poke along a path; see `rumi.tasks.touch_box.robot.TouchRobot`."""
        arm, none = self.arm, torch.zeros(0, dtype=torch.bool)
        joints, turn = self._way(path)
        if len(joints) < _DOWN + 1:  # it cannot come down there, and does not move
            return Touched(path[:1].clone(), none, None, "reach")
        arm.stand(joints[0], self.task.finger_m)
        arm.rest(_REST_S, joints[0])
        descent = arm.follow(joint_path(joints[:_DOWN]), _DOWN_RATE)
        arm.rest(_REST_S, descent.joints)
        start = self._pose(turn)
        if descent.ended == "force" or arm.tool()[2] > _DOWN_M:
            self._lift(descent)
            return Touched(start[None], none, True, "blocked")

        def asked(parts: tuple[TorqueSample, ...]) -> bool:
            return go_on(self._touched(start, parts, turn, "end"))

        rate = self.task.speed / self.task.spacing_m
        motion = arm.follow(joint_path(joints[_DOWN - 1 :]), rate, asked, _STOP_S)
        self._lift(motion)
        stopped = {"end": "end", "asked": "belief", "force": "force"}[motion.ended]
        return self._touched(start, self._told(motion.parts), turn, stopped)

    def grasp(self, pose: Float[Tensor, "3"]) -> bool:
        """Come down open about the box's narrow sides, close, lift; whether its middle rose by half of the lift."""
        arm, task = self.arm, self.task
        x, y, yaw = pose.tolist()
        opened, closed = 0.5 * task.opening_m + task.finger_m, task.half[0] + task.finger_m - _SQUEEZE_M
        joints = None
        for turn in (0.5 * math.pi, -0.5 * math.pi):
            if joints is None:
                joints = arm.kinematics.follow(_vertical(np.array([x, y, CLEAR_M, yaw + turn]), 0.0))
        if joints is None:
            return False
        arm.stand(joints[0], opened)
        arm.bandwidth = arm.settings.grasp_bandwidth
        arm.rest(_REST_S, joints[0])
        before = arm.box_height()
        descent = arm.follow(joint_path(joints), _DOWN_RATE)
        if descent.ended != "force":
            arm.rest(_REST_S, joints[-1])
            arm.rest(_CLOSE_S, joints[-1], closed)
            arm.rest(_REST_S, joints[-1])
            arm.follow(joint_path(joints[::-1][: 2 * _DOWN // 3 + 1]), _DOWN_RATE)
        lifted = arm.box_height() - before > LIFTED_M
        arm.stand(joints[0], opened)
        return lifted

    def box_pose(self) -> Float[Tensor, "3"]:
        """(x, y, yaw) of the box."""
        return self.arm.box_pose()

    def _way(self, path: Float[Tensor, "K1 3"]) -> tuple[np.ndarray, float]:
        """Joints down to a path's start and along it, as far as the arm can, and by how much the hand is turned."""
        points = path.double().numpy()
        key = points.tobytes()
        if key not in self._found:
            best: tuple[np.ndarray, float] = (np.zeros((0, 7)), 0.0)
            for turn in (0.0, math.pi):
                poses = np.stack((*points.T[:2], np.zeros(len(points)), points[:, 2] + turn), -1)
                above = poses[0] + (0.0, 0.0, CLEAR_M, 0.0)
                joints = self.arm.kinematics.reach(np.concatenate((_vertical(above, 0.0), poses[1:])))
                if len(joints) > len(best[0]):
                    best = joints, turn
                if len(joints) == len(points) + _DOWN - 1:
                    break
            self._found[key] = best
        return self._found[key]

    def _lift(self, motion: Motion) -> None:
        """Straight up from where a motion ended, unless that is out of reach."""
        arm = self.arm
        way = arm.kinematics.follow(_vertical(arm.kinematics.pose(motion.joints), CLEAR_M), motion.joints)
        if way is not None:
            arm.follow(joint_path(np.concatenate((motion.joints[None], way[1:]))), _DOWN_RATE)

    def _pose(self, turn: float) -> Float[Tensor, "3"]:
        return _planar(self.arm.tool(), turn)

    def _told(self, parts: tuple[TorqueSample, ...]) -> tuple[TorqueSample, ...]:
        """Without the last, of the way to a stop, where that is next to none."""
        if len(parts) > 1 and float(np.linalg.norm(parts[-1].pose[:2] - parts[-2].pose[:2])) < _SLIDE_M:
            return parts[:-1]
        return parts

    def _touched(
        self, start: Float[Tensor, "3"], parts: tuple[TorqueSample, ...], turn: float, stopped: str
    ) -> Touched:
        path = torch.stack([start, *(_planar(part.pose, turn) for part in parts)])
        if bool((path[1:, 2] - path[:-1, 2]).abs().gt(math.pi).any()):
            path = unwrapped(path)
        return Touched(path, torch.tensor([part.signal for part in parts], dtype=torch.bool), False, stopped)


def _vertical(pose: np.ndarray, height: float) -> np.ndarray:
    """Poses (9, 4) from one straight to a height."""
    poses = np.repeat(pose[None], _DOWN, 0)
    poses[:, 2] = np.linspace(pose[2], height, _DOWN)
    return poses


def _planar(pose: np.ndarray, turn: float) -> Float[Tensor, "3"]:
    """(x, y, yaw) with the yaw that was asked for, not the one turned by half; within half a turn of 0."""
    x, y, _, yaw = pose.tolist()
    return torch.tensor([x, y, math.remainder(yaw - turn, 2.0 * math.pi)], dtype=torch.float64)
