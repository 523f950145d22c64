"""Forward and inverse kinematics of an arm by MuJoCo, for a tool whose z axis points up."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rumi.sim.world import _import_mujoco

_STEPS, _DAMPING = 60, 1e-3
_CLOSE_M = 1e-5  # error at which a search ends; radians count a tenth of a metre
_SCALE = 0.1
REACHED_M = 1e-3
"""Error up to which a pose counts as reached, metres; radians count a tenth of a metre."""

_LEAP = 0.4  # radians


class ArmKinematics:
    """Forward and inverse kinematics of a serial arm, for poses (x, y, z, yaw) of a tool whose z axis points up.

    Args:
        model: MuJoCo model of the arm, whose site `tool` is the tool frame.
        joints: names of its joints, J of them.
        low: (J), lower limits of the joints, rad, or metres of a slide.
        high: (J), upper limits.
    """

    def __init__(self, model: Any, joints: Sequence[str], low: np.ndarray, high: np.ndarray) -> None:  # noqa: ANN401
        self._mujoco = _import_mujoco()
        self.model, self.joints = model, tuple(joints)
        self.data: Any = self._mujoco.MjData(model)
        self._place = [int(model.joint(name).qposadr[0]) for name in self.joints]
        self._dof = [int(model.joint(name).dofadr[0]) for name in self.joints]
        self._site = int(model.site("tool").id)
        self._move, self._turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        self.low, self.high = low, high

    def place(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (3) and rotation (3, 3) of the tool."""
        self.data.qpos[self._place] = joints
        self._mujoco.mj_kinematics(self.model, self.data)
        return self.data.site_xpos[self._site].copy(), self.data.site_xmat[self._site].reshape(3, 3).copy()

    def pose(self, joints: np.ndarray) -> np.ndarray:
        """(x, y, z, yaw) of the tool."""
        place, turn = self.place(joints)
        return np.array([*place, math.atan2(turn[1, 0], turn[0, 0])])

    def jacobian(self, joints: np.ndarray) -> np.ndarray:
        """(6, J): the tool's velocity and turning, world frame."""
        self.data.qpos[self._place] = joints
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_comPos(self.model, self.data)
        self._mujoco.mj_jacSite(self.model, self.data, self._move, self._turn, self._site)
        return np.concatenate((self._move[:, self._dof], self._turn[:, self._dof]))

    def solve(self, pose: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, float]:
        """Joints for (x, y, z, yaw) from a start by damped least squares, within the limits; and the error left.

        Nothing moves beyond what is needed: what the joints leave free stays about where it began. The error
        is in metres, a radian counting a tenth.
        """
        joints, goal = start.copy(), _rotation(pose[3])
        error = math.inf
        for _ in range(_STEPS):
            jacobian = self.jacobian(joints)
            place = self.data.site_xpos[self._site]
            turn = self.data.site_xmat[self._site].reshape(3, 3)
            off = np.concatenate((pose[:3] - place, _SCALE * _rotation_vector(goal @ turn.T)))
            error = float(np.linalg.norm(off))
            if error < _CLOSE_M:
                break
            jacobian[3:] *= _SCALE
            # joints at their limit that would go on are left out
            slope = jacobian.T @ off
            blocked = ((joints >= self.high - 1e-9) & (slope > 0)) | ((joints <= self.low + 1e-9) & (slope < 0))
            jacobian[:, blocked] = 0.0
            damping = _DAMPING**2 + 0.01 * error**2
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), off)
            joints = np.clip(joints + np.clip(step, -0.3, 0.3), self.low, self.high)
        return joints, error

    def home(self, pose: np.ndarray) -> np.ndarray:
        """Joints (J) from which a search for (x, y, z, yaw) begins: the middle of their limits, 0 without any."""
        middle = 0.5 * (self.low + self.high)
        return np.where(np.isfinite(middle), middle, 0.0)

    def follow(self, poses: np.ndarray, start: np.ndarray | None = None) -> np.ndarray | None:
        """Joints (n, J) along (x, y, z, yaw) of the tool (n, 4), each from the one before; None where it cannot go.

        Nor can it where a joint would have to leap from one pose to the next.
        """
        found = self.reach(poses, start)
        return found if len(found) == len(poses) else None

    def reach(self, poses: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """The same (m, J), as far as it can go: m <= n."""
        joints = self.home(poses[0]) if start is None else start
        found: list[np.ndarray] = []
        for pose in poses:
            before = joints
            joints, error = self.solve(pose, before)
            if error > REACHED_M or (found and float(np.abs(joints - before).max()) > _LEAP):
                break
            found.append(joints)
        return np.array(found).reshape(-1, len(self.joints))


def _rotation(yaw: float) -> np.ndarray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Of a turn of less than half; of nearly half it has the right direction and about the right length."""
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    sine, cosine = 0.5 * float(np.linalg.norm(skew)), 0.5 * (float(np.trace(rotation)) - 1.0)
    angle = math.atan2(sine, cosine)
    if sine > 1e-9:
        return 0.5 * angle / sine * skew
    if cosine > 0:
        return 0.5 * skew
    # half a turn: about the column that is longest
    axis = rotation + np.eye(3)
    column = axis[:, int(np.argmax(np.abs(np.diag(axis))))]
    return math.pi * column / float(np.linalg.norm(column))
