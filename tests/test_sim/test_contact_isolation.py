"""Torques of a force on the hand are explained by the hand; those of one far behind it are not."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from rumi.robot.gripper import GripperShape
from rumi.sim.arm_kinematics import ArmKinematics
from rumi.sim.contact_isolation import unexplained_by_hand
from rumi.sim.robot_arm import RobotArm

HAND_M = 0.13
POSTURE = np.array((0.2, 0.9, 0.1, 1.3, -0.3, 0.7, 0.4))


@pytest.fixture(scope="module")
def jacobian() -> np.ndarray:
    arm = RobotArm.standard((0.0, 0.0, 0.0))
    kinematics = ArmKinematics(arm.alone(GripperShape()), arm.names, arm.low, arm.high)
    return kinematics.jacobian(POSTURE)


def torques(jacobian: np.ndarray, at: tuple[float, float, float], force: tuple[float, float, float]) -> np.ndarray:
    """Of a force at a point seen from the tool frame's origin, world axes."""
    return jacobian.T @ np.concatenate((force, np.cross(at, force)))


@pytest.mark.parametrize("at", [(0.03, 0.02, 0.0), (-0.1, 0.05, 0.02), (0.0, -0.05, -0.1)])
@pytest.mark.parametrize("force", [(10.0, 0.0, 0.0), (0.0, -8.0, 3.0), (2.0, 2.0, 15.0)])
def test_a_force_on_the_hand_is_explained(jacobian, at, force):
    external = torques(jacobian, at, force)
    assert np.linalg.norm(external) > 1.0
    assert unexplained_by_hand(external, jacobian, HAND_M) < 0.1


@pytest.mark.parametrize("force", [(0.0, 20.0, 0.0), (15.0, 15.0, 0.0)])
def test_one_far_above_it_is_not(jacobian, force):
    assert unexplained_by_hand(torques(jacobian, (-0.1, 0.0, 0.5), force), jacobian, HAND_M) > 1.3


def test_no_torques_leave_nothing(jacobian):
    assert unexplained_by_hand(np.zeros(7), jacobian, HAND_M) == 0.0
