"""Simulated joint torques of the arm that carries the gripper, and contact signals of a momentum observer.

The gripper of the scene flies; the arm is put behind it afterwards. Its joints follow the gripper (inverse kinematics),
the torques are those that the true arm needs for that motion and for the force of contact (inverse dynamics), and what
is measured of them goes through the momentum observer with a model that is a little wrong. Neither a controller nor
friction in the joints is simulated: torques are taken to be measured behind the gears.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.reach_table import STARTS
from rumi.sim.arm_kinematics import ArmKinematics
from rumi.sim.arm_motion import joint_path
from rumi.sim.arm_scene import ARM_JOINTS, ArmPhysics, links_xml
from rumi.sim.force_sensing_world import WrenchTrace
from rumi.sim.robot_dynamics import MujocoDynamics
from rumi.sim.world import _import_mujoco
from sdf.bounds import Checked, NotNegative
from sensors.force.momentum_observer import MomentumObserver, TorqueThreshold, residuals

_KNOT_S = 0.05  # from one solution of the inverse kinematics to the next
_STILL_S = 0.3  # of standing before an action, by the end of which the observer's rest is taken
_LOST_M = 0.05  # error from which on a way is given up
FOLLOWS_M = 0.001
"""Error up to which the arm follows the gripper, metres; radians count a tenth of a metre."""


@dataclass(frozen=True)
class JointSettings(Checked, refusal=UsageError):
    """Sensors, model and reading.

    Attributes:
        torque_noise_nm: white, of each measured torque.
        torque_bias_nm: standard deviation of each joint's constant error.
        velocity_noise: white, of each measured velocity, rad/s.
        mass_error: standard deviation of the model's mass of each link, as a share.
        gain: of the observer, 1/s.
        threshold_nm: of the norm of the mean residual in a mini step, from what it was at rest.
        joints: how many count in the norm.
    """

    torque_noise_nm: NotNegative = 0.15
    torque_bias_nm: NotNegative = 0.1
    velocity_noise: NotNegative = 0.002
    mass_error: NotNegative = 0.03
    gain: float = 25.0
    threshold_nm: float = 0.6
    joints: int = 5

    def without_errors(self) -> Self:
        """Exact sensors and an exact model."""
        return replace(self, torque_noise_nm=0.0, torque_bias_nm=0.0, velocity_noise=0.0, mass_error=0.0)


class LevelKinematics(ArmKinematics):
    """The arm with its tool bent forward, so that it is level where the planner's tool is."""

    def __init__(self, physics: ArmPhysics) -> None:
        self.physics = physics
        high = np.array(physics.geometry.limits_rad)
        super().__init__(_import_mujoco().MjModel.from_xml_string(level_xml(physics)), ARM_JOINTS, -high, high)

    def track(self, poses: np.ndarray, begin: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Joints (n, 7) along (x, y, z, yaw) of the tool (n, 4), and the errors left (n), as those of `solve`.

        It goes on from where the arm is, and where that does not get there, begins with the arm held in another way.

        Args:
            poses: of the tool.
            begin: (7,), the arm's joints; None where it may be held in any way.
        """
        x, y, base = self.physics.base
        azimuth = math.atan2(poses[0, 1] - y, poses[0, 0] - x) - base
        held = [np.array(start) + azimuth * np.eye(7)[0] for start in STARTS]
        best: tuple[np.ndarray, np.ndarray] | None = None
        for joints in held if begin is None else (begin, *held):
            found = self._tracked(poses, joints)
            # the way that goes well for longest, and then the nearest
            if best is None or _merit(found[1]) > _merit(best[1]):
                best = found
            if best[1].max() < FOLLOWS_M:
                break
        assert best is not None
        return best

    def _tracked(self, poses: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found: list[np.ndarray] = []
        errors: list[float] = []
        for pose in poses:
            if not errors or errors[-1] < _LOST_M:
                joints, error = self.solve(pose, joints)
            found.append(joints)
            errors.append(error)
        return np.array(found), np.array(errors)


def _merit(errors: np.ndarray) -> tuple[int, float]:
    return int((errors < FOLLOWS_M).sum()), -float(errors.max())


class JointFeeler:
    """Contact signals of the joints of an arm for what the gripper went through.

    Args:
        base: (x, y, yaw) of the arm's base.
        height_m: of the level tool.
        settings: sensors and reading.
    """

    def __init__(
        self, base: tuple[float, float, float], height_m: float, settings: JointSettings | None = None
    ) -> None:
        self.settings, self.height_m = settings or JointSettings(), height_m
        self.physics = ArmPhysics(base=base)
        self.kinematics = LevelKinematics(self.physics)
        self.arm = MujocoDynamics.load(level_xml(self.physics), ARM_JOINTS)
        self.observer = MomentumObserver(self.settings.gain)
        self.seed(torch.Generator())

    def seed(self, generator: torch.Generator) -> None:
        """Draw what sensors and model have wrong in this run; the noise comes from the same generator."""
        own, size = self.settings, len(ARM_JOINTS)
        self._generator = generator
        factors = 1.0 + own.mass_error * torch.randn(size, generator=generator, dtype=torch.float64)
        text = level_xml(self.physics, tuple(factors.clamp(0.5, 1.5).tolist()))
        self.model = MujocoDynamics.load(text, ARM_JOINTS)
        self._bias = own.torque_bias_nm * torch.randn(size, generator=generator, dtype=torch.float64)
        self._joints: np.ndarray | None = None
        self._follows = torch.zeros(0, dtype=torch.bool)

    def residual(self, felt: WrenchTrace, start: Float[Tensor, "3"]) -> Float[Tensor, "T 7"]:
        """The observer's residual at each step of an action, from its rest before the action, N m.

        Args:
            felt: the action.
            start: (3,), the gripper's x, y, yaw before it.
        """
        step = float(felt.stamp[1] - felt.stamp[0])
        still = round(_STILL_S / step)
        # standing first, as the observer of a robot that has been on for a while
        position, velocity, acceleration = self._followed(felt, start, step, still)
        torque = np.empty_like(position)
        for k, (q, v, a) in enumerate(zip(position, velocity, acceleration, strict=True)):
            mass, bias = self.arm.terms(q, v)
            torque[k] = mass @ a + bias
            if k >= still and felt.wrench[k - still].any():
                torque[k] -= self.kinematics.jacobian(q).T @ felt.wrench[k - still]
        own, shape = self.settings, position.shape

        def noise(scale: float) -> Tensor:
            return scale * torch.randn(shape, generator=self._generator, dtype=torch.float64)

        stamps = step * torch.arange(len(position), dtype=torch.float64)
        found = residuals(
            self.model,
            stamps,
            torch.from_numpy(position),
            torch.from_numpy(velocity) + noise(own.velocity_noise),
            torch.from_numpy(torque) + self._bias + noise(own.torque_noise_nm),
            self.observer,
        )
        return found[still:] - found[still // 2 : still].mean(0)

    def signals(self, felt: WrenchTrace, start: Float[Tensor, "3"]) -> tuple[Bool[Tensor, "K"], Bool[Tensor, "K"]]:
        """Whether the mean residual of each mini step is above the threshold, and whether it tells anything.

        Where the arm cannot follow the gripper, as at the border of its reach, its joints jerk at their limits; until
        the action's end it may then be held in a way for which no rest was taken.
        """
        residual = self.residual(felt, start)
        ends = [0, *(int(end) + 1 for end in felt.ends)]
        mean = torch.stack([residual[a:b].mean(0) for a, b in pairwise(ends)])
        known = torch.stack([self._follows[a:b].all() for a, b in pairwise(ends)])
        return TorqueThreshold(self.settings.threshold_nm, self.settings.joints).contact(mean) & known, known

    def _followed(
        self, felt: WrenchTrace, start: Float[Tensor, "3"], step: float, still: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Joint positions, velocities and accelerations (still + T, 7) at the steps of standing and of the action."""
        first = start.double().numpy()[None]
        every = np.concatenate((np.repeat(first, still + 1, 0), felt.configuration))
        times = step * np.arange(len(every))
        knots = np.arange(0.0, times[-1] + _KNOT_S, _KNOT_S)
        every[:, 2] = np.unwrap(every[:, 2])
        x, y, yaw = (np.interp(knots, times, every[:, axis]) for axis in range(3))
        poses = np.stack((x, y, np.full_like(x, self.height_m), yaw), -1)
        solved, errors = self.kinematics.track(poses, self._joints)
        self._joints = solved[-1]
        lost = errors > FOLLOWS_M
        # the spline goes wrong from the knot before on; found again, the arm may be held in another way, in which the
        # model's masses err by other torques than where the rest was taken
        stirred = np.array([lost[: k + 2].any() for k in range(len(lost))])
        near = np.minimum(np.round(times[still + 1 :] / _KNOT_S).astype(int), len(stirred) - 1)
        self._follows = torch.from_numpy(~stirred[near])
        path = joint_path(solved)
        found = [path.at(time / _KNOT_S) for time in times[1:]]
        position, slope, bend = (np.array(part) for part in zip(*found, strict=True))
        return position, slope / _KNOT_S, bend / _KNOT_S**2


def level_xml(physics: ArmPhysics, mass_factors: tuple[float, ...] = (1.0,) * 7) -> str:
    """The arm alone with its tool bent forward, as MJCF text; where the site `tool` is level it points along +x, z up.

    Args:
        physics: the arm.
        mass_factors: of the links' masses.
    """
    shape = physics.geometry
    half = 0.5 * (-0.5 * math.pi - shape.tool_pitch_rad)
    tool = (
        f'<body name="tool" pos="0 0 {shape.flange_m + shape.tool_m}" quat="{math.cos(half)} 0 {math.sin(half)} 0">'
        '<geom type="box" size="0.045 0.05 0.02" pos="-0.07 0 0" mass="0.5"/><site name="tool"/></body>'
    )
    arm = links_xml(physics, mass_factors, tool=tool)
    return f'<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>{arm}</worldbody></mujoco>'
