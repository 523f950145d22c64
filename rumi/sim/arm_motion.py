"""Joint trajectories of the arm for a hand that points down."""

import math
from typing import Any, NamedTuple

import numpy as np

from rumi.sim.arm_scene import ARM_JOINTS, ArmPhysics, arm_xml
from rumi.sim.world import _import_mujoco

_STEPS, _DAMPING = 60, 1e-3
_CLOSE_M = 1e-5  # error at which a search ends; radians count a tenth of a metre
_SCALE = 0.1
REACHED_M = 1e-3
"""Error up to which a pose counts as reached, metres; radians count a tenth of a metre."""

_LEAP = 0.4  # radians
_MARGIN = 0.03  # radians that are kept from the limits
# elbow up, hand down, about the middle of the reach
_HOME = (0.0, 0.45, 0.0, 1.75, 0.0, 0.95, 0.0)


class JointPath(NamedTuple):
    """A path in joint space by a parameter that rises by one from one knot to the next.

    Attributes:
        position: (n, 7), on a lattice of `fine` points a knot, rad.
        first: (n, 7), derivative by the parameter.
        second: (n, 7), second derivative.
        fine: points from one knot to the next.
    """

    position: np.ndarray
    first: np.ndarray
    second: np.ndarray
    fine: int

    @property
    def end(self) -> float:
        """The last value of the parameter."""
        return (len(self.position) - 1) / self.fine

    def at(self, place: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position and derivatives at a place."""
        x = min(max(place, 0.0), self.end) * self.fine
        index = min(int(x), len(self.position) - 2)
        share = x - index
        near, far = 1.0 - share, share
        return (
            near * self.position[index] + far * self.position[index + 1],
            near * self.first[index] + far * self.first[index + 1],
            near * self.second[index] + far * self.second[index + 1],
        )


def joint_path(knots: np.ndarray, fine: int = 10) -> JointPath:
    """A smooth path (natural cubic spline) through joint positions (n, 7), n >= 2."""
    count = len(knots) - 1
    second = np.zeros_like(knots)
    if count > 1:
        matrix = 4.0 * np.eye(count - 1) + np.eye(count - 1, k=1) + np.eye(count - 1, k=-1)
        second[1:-1] = np.linalg.solve(matrix, 6.0 * (knots[2:] - 2.0 * knots[1:-1] + knots[:-2]))
    place = np.arange(count * fine + 1) / fine
    piece = np.minimum(place.astype(int), count - 1)
    s = (place - piece)[:, None]
    a, b, ma, mb = knots[piece], knots[piece + 1], second[piece], second[piece + 1]
    t = 1.0 - s
    position = t * a + s * b + ((t**3 - t) * ma + (s**3 - s) * mb) / 6.0
    first = b - a + ((1.0 - 3.0 * t**2) * ma + (3.0 * s**2 - 1.0) * mb) / 6.0
    return JointPath(position, first, t * ma + s * mb, fine)


class ArmKinematics:
    """Forward and inverse kinematics of the arm with its hand pointing down.

    Args:
        physics: the arm.
    """

    def __init__(self, physics: ArmPhysics) -> None:
        self._mujoco = _import_mujoco()
        self.physics = physics
        self.model: Any = self._mujoco.MjModel.from_xml_string(arm_xml(physics))
        self.data: Any = self._mujoco.MjData(self.model)
        self._place = [int(self.model.joint(name).qposadr[0]) for name in ARM_JOINTS]
        self._dof = [int(self.model.joint(name).dofadr[0]) for name in ARM_JOINTS]
        self._site = int(self.model.site("tool").id)
        self._move, self._turn = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        self.limits = np.array(physics.geometry.limits_rad) - _MARGIN

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
        """(6, 7): the tool's velocity and turning, world frame."""
        self.data.qpos[self._place] = joints
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_comPos(self.model, self.data)
        self._mujoco.mj_jacSite(self.model, self.data, self._move, self._turn, self._site)
        return np.concatenate((self._move[:, self._dof], self._turn[:, self._dof]))

    def home(self, pose: np.ndarray) -> np.ndarray:
        """Joints from which a search for (x, y, z, yaw) begins: the arm's plane through the goal, the hand turned."""
        x, y, base = self.physics.base
        azimuth = _wrapped(math.atan2(pose[1] - y, pose[0] - x) - base)
        joints = np.array(_HOME)
        joints[0] = azimuth
        # with the hand down, the last joint turns it the other way round
        joints[6] = _wrapped(azimuth + base - pose[3])
        return np.clip(joints, -self.limits, self.limits)

    def solve(self, pose: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, float]:
        """Joints for (x, y, z, yaw) from a start by damped least squares, within the limits; and the error left.

        Nothing moves beyond what is needed: what the seventh joint leaves free stays about where it began. The error
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
            blocked = np.abs(joints) >= self.limits - 1e-9
            blocked &= (jacobian.T @ off) * joints > 0
            jacobian[:, blocked] = 0.0
            damping = _DAMPING**2 + 0.01 * error**2
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), off)
            joints = np.clip(joints + np.clip(step, -0.3, 0.3), -self.limits, self.limits)
        return joints, error

    def follow(self, poses: np.ndarray, start: np.ndarray | None = None) -> np.ndarray | None:
        """Joints (n, 7) along (x, y, z, yaw) of the tool (n, 4), each from the one before; None where it cannot go.

        Nor can it where a joint would have to leap from one pose to the next.
        """
        found = self.reach(poses, start)
        return found if len(found) == len(poses) else None

    def reach(self, poses: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """The same (m, 7), as far as it can go: m <= n."""
        joints = self.home(poses[0]) if start is None else start
        found: list[np.ndarray] = []
        for pose in poses:
            before = joints
            joints, error = self.solve(pose, before)
            if error > REACHED_M or (found and float(np.abs(joints - before).max()) > _LEAP):
                break
            found.append(joints)
        return np.array(found).reshape(-1, len(ARM_JOINTS))


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)


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
