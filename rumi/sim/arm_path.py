"""Joint paths of an arm for paths of its tool: inverse kinematics from one posture, and the time they take."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.robot.arm import IKResult
from rumi.sim.arm_kinematics import ArmKinematics
from rumi.sim.arm_motion import joint_path
from rumi.sim.robot_arm import RobotArm
from sdf import se3

_APART = 0.15  # rad between solutions, above which others in between are asked for
_ROTATION_SCALE_M = 0.1


class TimedJoints(NamedTuple):
    """A joint path in time.

    Attributes:
        joints: (n, J), n >= 1.
        times: (n), seconds from its start, rising.
        ends: (K), when the tool is at each target; of those that it does not get to, when it would be.
        arrived: how many of the targets it gets to.
    """

    joints: np.ndarray
    times: np.ndarray
    ends: np.ndarray
    arrived: int

    def sampled(self, step_s: float, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, velocities and accelerations (steps, J) at the end of each step; at rest after its end."""
        position = np.repeat(self.joints[-1:], steps, 0)
        velocity, acceleration = np.zeros_like(position), np.zeros_like(position)
        if len(self.joints) > 1:
            path = joint_path(self.joints)
            for index in range(steps):
                time = (index + 1) * step_s
                if time >= self.times[-1]:
                    break
                knot = int(np.searchsorted(self.times, time, side="right")) - 1
                rate = 1.0 / (self.times[knot + 1] - self.times[knot])
                position[index], first, second = path.at(knot + (time - self.times[knot]) * rate)
                velocity[index], acceleration[index] = first * rate, second * rate * rate
        return position, velocity, acceleration


class ToolPath:
    """Inverse kinematics of an arm along paths of its tool.

    Each target is solved from the same posture of the arm, its first joint turned to where the target is: what the arm
    can do does not hang on its way so far, and where the table of reach has a solution, this is one. Where the
    solutions of two targets are far apart, the arm goes from one to the other by solutions in between; where there are
    none, on from where it is, held otherwise; else no farther.

    Attributes:
        posture: number of the posture that targets are solved from.

    Args:
        arm: the arm.
        kinematics: of the arm, forward.
        tolerance_m: error up to which a target is gone to; radians count a tenth of a metre.
        joint_speed: of each joint at most, rad/s or m/s.
    """

    def __init__(self, arm: RobotArm, kinematics: ArmKinematics, tolerance_m: float, joint_speed: float) -> None:
        self.arm, self.kinematics, self.tolerance_m, self.joint_speed = arm, kinematics, tolerance_m, joint_speed
        self.posture = 0

    def ways(self, world_T_tool: Float[Tensor, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
        """Joints (S, J) from each of the arm's postures for a pose of the tool, and the errors left (S), metres."""
        goals = self._from_root(world_T_tool[None]).expand(len(self.arm.starts), 4, 4)
        found = self.arm.kinematics.solve(goals, self._turned(self.arm.starts.copy(), goals))
        return found.joints.numpy(), _error(found).numpy()

    def solve(self, world_T_tool: Float[Tensor, "K 4 4"]) -> tuple[np.ndarray, np.ndarray]:
        """Joints (K, J) and errors (K), metres, for poses of the tool."""
        goals = self._from_root(world_T_tool)
        found = self.arm.kinematics.solve(goals, self._turned(self.arm.starts[[self.posture] * len(goals)], goals))
        return found.joints.numpy(), _error(found).numpy()

    def through(self, begin: np.ndarray, targets: Float[Tensor, "K 4 4"], duration_s: float) -> TimedJoints:
        """From joints (J) through poses of the tool, evenly in time unless a joint would be too fast."""
        solved, errors = self.solve(targets)
        part, joints, times, ends = duration_s / len(targets), [begin], [0.0], []
        at = self._pose(begin)
        for target, goal, error in zip(targets, solved, errors.tolist(), strict=True):
            way = None if error > self.tolerance_m else self._between(joints[-1], goal, at, target)
            way = way or self._onwards(joints[-1], target)
            if way is None:
                break
            for each in way:
                turn = float(np.abs(each - joints[-1]).max())
                times.append(times[-1] + max(part / len(way), turn / self.joint_speed))
                joints.append(each)
            ends.append(times[-1])
            at = target
        arrived = len(ends)
        ends += [times[-1] + part * (index + 1) for index in range(len(targets) - arrived)]
        return TimedJoints(np.array(joints), np.array(times), np.array(ends), arrived)

    def _between(
        self, begin: np.ndarray, end: np.ndarray, at: Float[Tensor, "4 4"], to: Float[Tensor, "4 4"]
    ) -> list[np.ndarray] | None:
        """Joints on the way from one solution to another, that one included; None where they hang together by none."""
        count = math.ceil(float(np.abs(end - begin).max()) / _APART)
        if count <= 1:
            return [end]
        share = torch.arange(1, count, dtype=torch.float64)[:, None] / count
        starts = torch.from_numpy(begin) + share * torch.from_numpy(end - begin)
        poses = at @ se3.exp(share * se3.log(se3.inverse(at) @ to))
        found = self.arm.kinematics.solve(self._from_root(poses), starts)
        way = [*found.joints.numpy(), end]
        steps = np.abs(np.diff(np.stack((begin, *way)), axis=0)).max()
        return way if float(_error(found).max()) <= self.tolerance_m and steps <= 2.0 * _APART else None

    def _onwards(self, begin: np.ndarray, to: Float[Tensor, "4 4"]) -> list[np.ndarray] | None:
        """Joints for a target from those before it, the arm held otherwise than usual; None where they are not near."""
        found = self.arm.kinematics.solve(self._from_root(to[None]), torch.from_numpy(begin)[None])
        joints = found.joints[0].numpy()
        near = float(np.abs(joints - begin).max()) <= 2.0 * _APART
        return [joints] if near and float(_error(found)) <= self.tolerance_m else None

    def _pose(self, joints: np.ndarray) -> Float[Tensor, "4 4"]:
        place, turn = self.kinematics.place(joints)
        return se3.make(torch.from_numpy(turn), torch.from_numpy(place))

    def _from_root(self, world_T_tool: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 4 4"]:
        return se3.inverse(self.arm.world_T_root) @ world_T_tool.double() @ se3.inverse(self.arm.end_T_tool)

    @staticmethod
    def _turned(postures: np.ndarray, goals: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K J"]:
        """Postures (K, J), the first joint of each turned to where its goal is."""
        starts = torch.from_numpy(postures)
        starts[:, 0] += torch.atan2(goals[:, 1, 3], goals[:, 0, 3])
        return starts


def _error(found: IKResult) -> Float[Tensor, "K"]:
    return (found.position_error.square() + (_ROTATION_SCALE_M * found.rotation_error).square()).sqrt()
