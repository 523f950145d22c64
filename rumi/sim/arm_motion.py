"""Joint trajectories of the arm for a hand that points down."""

import math
from typing import NamedTuple

import numpy as np

from rumi.sim.arm_kinematics import ArmKinematics
from rumi.sim.arm_scene import ARM_JOINTS, ArmPhysics, arm_xml
from rumi.sim.world import _import_mujoco

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


class HandDownKinematics(ArmKinematics):
    """Kinematics of the arm with its hand pointing down.

    Args:
        physics: the arm.
    """

    def __init__(self, physics: ArmPhysics) -> None:
        self.physics = physics
        high = np.array(physics.geometry.limits_rad) - _MARGIN
        super().__init__(_import_mujoco().MjModel.from_xml_string(arm_xml(physics)), ARM_JOINTS, -high, high)

    def home(self, pose: np.ndarray) -> np.ndarray:
        """Joints from which a search for (x, y, z, yaw) begins: the arm's plane through the goal, the hand turned."""
        x, y, base = self.physics.base
        azimuth = _wrapped(math.atan2(pose[1] - y, pose[0] - x) - base)
        joints = np.array(_HOME)
        joints[0] = azimuth
        # with the hand down, the last joint turns it the other way round
        joints[6] = _wrapped(azimuth + base - pose[3])
        return np.clip(joints, self.low, self.high)


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)
