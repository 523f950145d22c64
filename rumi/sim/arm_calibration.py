"""Calibration of an arm's dynamics by least squares: masses of links and friction of joints from free motions."""

from typing import NamedTuple

import numpy as np

from rumi.sim.arm_motion import HandDownKinematics, JointPath, joint_path
from rumi.sim.robot_dynamics import MujocoDynamics

_CLEAR_M = 0.2  # of the tool above the floor in all of the motion
_STEP = 0.01  # share of a mass by which derivatives are taken; they are exact, since torques are linear in masses
# about how wrong masses are (a share), how large friction is that the model does not know, and the torque sensors' bias
_PRIOR_SDS = (0.05, 0.5, 0.3)
_NOISE_SD = 0.2  # of a window's external torque, N m
# joints through which the arm goes: (the last six, about the middle of their reach; the first turns from side to side)
_KNOTS = np.array(
    [
        (0.0, 0.2, 0.0, 1.6, 0.0, 1.0, 0.0),
        (0.5, 0.5, 0.3, 1.1, 0.4, 0.6, 0.6),
        (0.2, -0.2, -0.3, 1.9, -0.4, 1.3, -0.6),
        (-0.5, 0.4, -0.4, 1.4, 0.6, 0.4, 0.8),
        (-0.2, 0.0, 0.4, 1.0, -0.6, 1.5, -0.8),
        (0.4, 0.6, 0.0, 0.8, 0.5, 0.9, 0.3),
        (0.0, 0.2, 0.0, 1.6, 0.0, 1.0, 0.0),
    ]
)


class Window(NamedTuple):
    """Means over some samples of a motion without contact.

    Attributes:
        position: (7,), rad.
        velocity: (7,), rad/s.
        acceleration: (7,), rad/s^2.
        sign: (7,), of the commanded velocity, -1 to 1.
        external: (7,), torque that the model does not explain, N m.
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    sign: np.ndarray
    external: np.ndarray


class Correction(NamedTuple):
    """Correction of an arm's dynamics model.

    Attributes:
        factors: (7,), of the links' masses.
        friction_nm: (7,), dry friction to add.
        rest_nm: (7,), what is left of the external torque without contact: the sensors' bias.
    """

    factors: np.ndarray
    friction_nm: np.ndarray
    rest_nm: np.ndarray


def free_motion(kinematics: HandDownKinematics) -> JointPath:
    """There and back through configurations that tell masses apart, well above all that stands on the floor.

    Raises:
        RuntimeError: for an arm of which the hand would come down too far.
    """
    path = joint_path(np.concatenate((_KNOTS, _KNOTS[-2::-1])))
    lowest = min(float(kinematics.place(joints)[0][2]) for joints in path.position)
    if lowest < _CLEAR_M:
        raise RuntimeError(f"Expected the hand to stay {_CLEAR_M} m above the floor, got {lowest:.3f} m")
    return path


def correction(dynamics: MujocoDynamics, windows: list[Window]) -> Correction:
    """Shares of masses and friction that explain the windows best, by ridge regression.

    The torque that a model does not explain is linear in its masses' errors, in dry friction and in the torque sensors'
    bias. What a motion cannot tell (the first link's mass, about a vertical axis) stays as it is.

    Args:
        dynamics: the model, whose masses are left as they are.
        windows: of a motion without contact.
    """
    count = len(dynamics.joints)
    rows = np.zeros((len(windows), count, 3 * count))
    for index, window in enumerate(windows):
        usual = _torque(dynamics, window)
        for link in range(count):
            with_more = _scaled(dynamics, link, 1.0 + _STEP, window)
            rows[index, :, link] = (with_more - usual) / _STEP
        rows[index, :, count : 2 * count] = np.diag(window.sign)
        rows[index, :, 2 * count :] = np.eye(count)
    matrix = rows.reshape(-1, 3 * count)
    # what is not explained is what the model lacks, with the other sign
    lacking = -np.concatenate([window.external for window in windows])
    prior = np.repeat(_PRIOR_SDS, count)
    normal = matrix.T @ matrix / _NOISE_SD**2 + np.diag(prior**-2.0)
    found = np.linalg.solve(normal, matrix.T @ lacking / _NOISE_SD**2)
    return Correction(1.0 + found[:count], found[count : 2 * count], -found[2 * count :])


def scale_masses(dynamics: MujocoDynamics, factors: np.ndarray) -> None:
    """Change the masses of a model's links, and their inertia with them."""
    for name, factor in zip(dynamics.joints, factors, strict=True):
        body = int(dynamics.model.jnt_bodyid[dynamics.model.joint(name).id])
        dynamics.model.body_mass[body] *= factor
        dynamics.model.body_inertia[body] *= factor


def _torque(dynamics: MujocoDynamics, window: Window) -> np.ndarray:
    mass, bias = dynamics.terms(window.position, window.velocity)
    return np.asarray(mass @ window.acceleration + bias)


def _scaled(dynamics: MujocoDynamics, link: int, factor: float, window: Window) -> np.ndarray:
    factors = np.ones(len(dynamics.joints))
    factors[link] = factor
    scale_masses(dynamics, factors)
    found = _torque(dynamics, window)
    scale_masses(dynamics, 1.0 / factors)
    return found
