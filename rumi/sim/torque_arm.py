"""Arm under torque control that senses contact by its joints: computed torque, noisy sensors, observer, force limit."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.sim.arm_calibration import Correction, Window, correction, free_motion, scale_masses
from rumi.sim.arm_motion import HandDownKinematics, JointPath
from rumi.sim.arm_scene import ARM_JOINTS, FINGERS, ArmPhysics, arm_xml, scene_xml
from rumi.sim.robot_dynamics import MujocoDynamics
from rumi.sim.world import _import_mujoco
from sdf.bounds import Checked, NotNegative, Positive
from sensors.force.momentum_observer import DynamicsTerms, MomentumObserver, TorqueThreshold, external_torque

_BATCH = 10  # samples that the observer takes in at once, after which the force limit is looked at
_WINDOW = 5  # such batches that are one row of a calibration
_FREE_RATE = 1.25  # knots a second of the motion for that
_CREEP = 0.02  # rad/s, about which known friction turns its sign
_FINGER = 2e4, 200.0  # stiffness and damping of a finger, N/m and N s/m


@dataclass(frozen=True)
class TorqueSettings(Checked, refusal=UsageError):
    """Control, what its model and sensors have wrong, and the reading.

    Attributes:
        bandwidth: of the tracking error, critically damped, 1/s.
        grasp_bandwidth: the same while grasping: lower, so that the fingers centre themselves.
        torque_noise_nm: white, of each measured torque.
        torque_bias_nm: standard deviation of each joint's constant error.
        velocity_noise: white, of each measured velocity, rad/s.
        mass_error: standard deviation of the model's mass of each link, as a share.
        friction_nm: dry friction of each joint.
        friction_known: share of it that the controller knows of.
        motor_side: torques are measured before the gears, by the motors' currents, so that friction is in them; else
            behind the gears, by sensors in the joints.
        gain: of the observer, 1/s.
        threshold_nm: of the norm of the mean residual from one reading to the next, from what it was at rest before the
            motion. The mean, since the largest of a part, or the last, errs more often.
        joints: how many count in the norm.
        force_limit_n: estimated force on the hand at which an action ends.
    """

    bandwidth: Positive = 40.0
    grasp_bandwidth: Positive = 15.0
    torque_noise_nm: NotNegative = 0.15
    torque_bias_nm: NotNegative = 0.1
    velocity_noise: NotNegative = 0.002
    mass_error: NotNegative = 0.03
    friction_nm: NotNegative = 0.5
    friction_known: float = 0.8
    motor_side: bool = False
    gain: Positive = 25.0
    threshold_nm: Positive = 0.3
    joints: int = 5
    force_limit_n: Positive = 25.0


class TorqueSample(NamedTuple):
    """Joint-torque reading of one part of a motion, from one knot of its path to the next.

    Attributes:
        pose: (4,), measured (x, y, z, yaw) of the tool at the end.
        norm_nm: norm of the mean residual in this part, from its rest.
        force_n: largest estimated force on the hand, from its rest.
        signal: whether the norm was above the threshold.
        touching: whether a finger touched the box, in truth.
    """

    pose: np.ndarray
    norm_nm: float
    force_n: float
    signal: bool
    touching: bool


class Motion(NamedTuple):
    """Joint-torque readings of a motion, and how it ended.

    Attributes:
        parts: one a knot that was reached, and one for what the arm took to stop where that was between knots.
        ended: "end", "asked" or "force".
        tracking_m: (T,), distance of the tool from where it should have been, at each part's end.
        joints: (7,), where the joints should be at the end, rad.
    """

    parts: tuple[TorqueSample, ...]
    ended: str
    tracking_m: np.ndarray
    joints: np.ndarray


class TorqueArm:
    """The arm before a box in MuJoCo.

    Joint positions are measured exactly, velocities and torques with noise. The torque of the motors is that of the
    controller: M (a + w^2 e + 2 w e') + bias, by a model whose masses are a little wrong.

    Args:
        half: half of the box's footprint, metres.
        height_m: of the box.
        physics: the arm.
        settings: control, noise and reading.
    """

    def __init__(
        self,
        half: tuple[float, float],
        height_m: float,
        physics: ArmPhysics | None = None,
        settings: TorqueSettings | None = None,
    ) -> None:
        self.mujoco = _import_mujoco()
        self.physics, self.settings = physics or ArmPhysics(), settings or TorqueSettings()
        self.height_m = height_m
        text = scene_xml(self.physics, half, height_m, self.settings.friction_nm)
        self.model: Any = self.mujoco.MjModel.from_xml_string(text)
        self.data: Any = self.mujoco.MjData(self.model)
        self.kinematics = HandDownKinematics(self.physics)
        self._place, self._dof = self._addresses(ARM_JOINTS)
        self._finger, self._finger_dof = self._addresses(FINGERS)
        self._box = int(self.model.joint("box").qposadr[0])
        self._geoms = {int(self.model.geom(name).id) for name in FINGERS}
        self._box_geom = int(self.model.geom("box").id)
        self.observer = MomentumObserver(self.settings.gain)
        self._limits = np.array(self.physics.torques_nm)
        self.opened = self.physics.finger_m
        self.bandwidth = self.settings.bandwidth
        self.tare = self._residual = torch.zeros(len(ARM_JOINTS), dtype=torch.float64)
        self._samples: list[tuple[np.ndarray, ...]] = []
        self._windows: list[Window] | None = None
        self._known_rest: Tensor | None = None
        self._between = np.zeros(0), np.zeros(0)
        self.seed(0)

    def _addresses(self, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        joints = [self.model.joint(name) for name in names]
        return np.array([int(j.qposadr[0]) for j in joints]), np.array([int(j.dofadr[0]) for j in joints])

    def seed(self, seed: int) -> None:
        """Draw what sensors and model have wrong in this run, and begin the noise anew."""
        own = self.settings
        self._random = np.random.default_rng(seed)
        factors = np.clip(1.0 + own.mass_error * self._random.standard_normal(len(ARM_JOINTS)), 0.5, 1.5)
        text = arm_xml(self.physics, mass_factors=tuple(factors.tolist()))
        self.dynamics = MujocoDynamics.load(text, ARM_JOINTS)
        self.friction = np.full(len(ARM_JOINTS), own.friction_known * own.friction_nm)
        self._known_rest = None
        self._bias = own.torque_bias_nm * self._random.standard_normal(len(ARM_JOINTS))
        self._forget()

    def renew(self, seed: int) -> None:
        """Begin the noise anew; what sensors and model have wrong stays."""
        self._random = np.random.default_rng((seed, 1))

    def calibrate(self) -> Correction:
        """Move in free air, well above the box, and mend the model's masses and friction by what is felt there.

        What is left is the rest from then on: a rest that is taken while the arm stands has in it what friction holds
        then, which is not what it holds in motion.
        """
        path = free_motion(self.kinematics)
        self.stand(path.position[0], self.physics.finger_m)
        self.rest(_BATCH * self.physics.time_step_s, path.position[0])
        self._windows = []
        self.follow(path, _FREE_RATE, ramp_s=0.3)
        windows, self._windows = self._windows, None
        found = correction(self.dynamics, [_mean(windows[i : i + _WINDOW]) for i in range(0, len(windows), _WINDOW)])
        scale_masses(self.dynamics, found.factors)
        self.friction = self.friction + found.friction_nm
        self._known_rest = torch.from_numpy(found.rest_nm)
        self._forget()
        return found

    def put_box(self, pose: Float[Tensor, "3"]) -> None:
        """Stand the box at rest at (x, y, yaw)."""
        x, y, yaw = pose.tolist()
        turn = (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))
        self.data.qpos[self._box : self._box + 7] = (x, y, 0.5 * self.height_m, *turn)
        self.data.joint("box").qvel[:] = 0.0

    def box_pose(self) -> Float[Tensor, "3"]:
        """(x, y, yaw) of the box."""
        x, y, _, w, i, j, k = self.data.qpos[self._box : self._box + 7].tolist()
        return torch.tensor([x, y, math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))], dtype=torch.float64)

    def box_height(self) -> float:
        """Of the box's middle."""
        return float(self.data.qpos[self._box + 2])

    def stand(self, joints: np.ndarray, opened: float) -> None:
        """Put the arm at rest somewhere with its fingers this far from the middle, as if it had travelled there."""
        self.data.qpos[self._place], self.data.qpos[self._finger] = joints, opened
        self.data.qvel[self._dof], self.data.qvel[self._finger_dof] = 0.0, 0.0
        self.opened = opened
        self._forget()

    def tool(self) -> np.ndarray:
        """Measured (x, y, z, yaw) of the tool."""
        return self.kinematics.pose(self.data.qpos[self._place])

    def touching(self) -> bool:
        """Whether a finger touches the box, in truth."""
        for geom in np.asarray(self.data.contact.geom):
            pair = {int(geom[0]), int(geom[1])}
            if self._box_geom in pair and pair & self._geoms:
                return True
        return False

    def rest(self, seconds: float, joints: np.ndarray, opened: float | None = None) -> None:
        """Hold a place, while the fingers open or close; unless calibrated, what is felt at its end is the rest."""
        zero, begun = np.zeros_like(joints), self.opened
        steps = max(_BATCH, round(seconds / self.physics.time_step_s / _BATCH) * _BATCH)
        last = []
        for index in range(steps):
            if opened is not None:
                self.opened = begun + (opened - begun) * (index + 1) / steps
            self._step(joints, zero, zero)
            if (index + 1) % _BATCH == 0:
                last.append(self._observed()[-1])
        if self._known_rest is None:
            self.tare = torch.stack(last[len(last) // 2 :]).mean(0)

    def follow(
        self,
        path: JointPath,
        rate: float,
        on_part: Callable[[tuple[TorqueSample, ...]], bool] | None = None,
        ramp_s: float = 0.1,
    ) -> Motion:
        """Go along a path to its end, or until a part was felt after which `on_part` says no, or a force is too high.

        Args:
            path: from where the arm is at rest.
            rate: knots a second.
            on_part: asked after each part with all parts so far.
            ramp_s: in which the rate is reached and left.
        """
        step, place, now, ended = self.physics.time_step_s, 0.0, 0.0, "end"
        hold = round(0.1 / step)
        parts: list[TorqueSample] = []
        tracking: list[float] = []
        force, felt = 0.0, []
        touched, stopping, counted = False, False, 0
        threshold = TorqueThreshold(self.settings.threshold_nm, self.settings.joints, tuple(self.tare.tolist()))
        while True:
            # as quick as lets it stop at the end
            wanted = 0.0 if stopping else min(rate, math.sqrt(2.0 * rate / ramp_s * max(0.0, path.end - place)))
            pace = min(wanted, now + rate / ramp_s * step) if wanted > now else max(wanted, now - rate / ramp_s * step)
            slope, now = (pace - now) / step, pace
            place = min(place + now * step, path.end)
            position, first, second = path.at(place)
            self._step(position, first * now, second * now * now + first * slope)
            touched = touched or self.touching()
            counted += 1
            if counted % _BATCH:
                continue
            residual = self._observed()
            felt.append(residual)
            force = max(force, self._force(residual[-1]))
            if not stopping and force > self.settings.force_limit_n:
                stopping, ended = True, "force"
            done = now < 1e-6 * rate + rate / ramp_s * step and (stopping or path.end - place < 1e-3)
            hold -= _BATCH * done
            reached = place >= len(parts) + 1 - 1e-3 and not stopping
            if reached or hold <= 0:
                pose = self.tool()
                norm = float(threshold.norm(torch.cat(felt).mean(0)))
                parts.append(TorqueSample(pose, norm, force, norm > threshold.threshold_nm, touched))
                tracking.append(float(np.linalg.norm(pose[:3] - self.kinematics.pose(position)[:3])))
                force, felt, touched = 0.0, [], False
                if hold <= 0:
                    break
                if len(parts) < round(path.end) and on_part is not None and not on_part(tuple(parts)):
                    stopping, ended = True, "asked"
        return Motion(tuple(parts), ended, np.array(tracking), position)

    def _step(self, position: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> None:
        """One control step: measure, command, let the engine step."""
        own, data = self.settings, self.data
        joints = data.qpos[self._place].copy()
        speed = data.qvel[self._dof] + own.velocity_noise * self._random.standard_normal(len(ARM_JOINTS))
        mass, bias = self.dynamics.terms(joints, speed)
        sign = np.tanh(velocity / _CREEP)
        friction = self.friction * sign
        w = self.bandwidth
        torque = mass @ (acceleration + w * w * (position - joints) + 2.0 * w * (velocity - speed)) + bias + friction
        torque = np.clip(torque, -self._limits, self._limits)
        data.ctrl[: len(ARM_JOINTS)] = torque
        stiffness, damping = _FINGER
        data.ctrl[len(ARM_JOINTS) :] = (
            stiffness * (self.opened - data.qpos[self._finger]) - damping * data.qvel[self._finger_dof]
        )
        self.mujoco.mj_step(self.model, data)
        measured = torque + self._bias + own.torque_noise_nm * self._random.standard_normal(len(ARM_JOINTS))
        if own.motor_side:
            bias = bias + friction
        elif own.friction_nm > 0:
            # the engine's rows of friction come first, a joint each
            measured = measured + data.efc_force[: len(ARM_JOINTS)]
            sign = np.zeros_like(sign)
        self._samples.append((mass, bias, speed, measured))
        if self._windows is not None and len(self._samples) == _BATCH // 2:
            self._between = joints, sign

    def _observed(self) -> Float[Tensor, "K J"]:
        """Residuals of the samples since the last call; the last sample stays, for the next."""
        mass, bias, speed, torque = (torch.from_numpy(np.stack(part)) for part in zip(*self._samples, strict=True))
        step = self.physics.time_step_s
        before, after = DynamicsTerms(mass[:-1], bias[:-1]), DynamicsTerms(mass[1:], bias[1:])
        raw = external_torque(before, speed[:-1], after, speed[1:], torque[:-1], step)
        if self._windows is not None:
            joints, sign = self._between
            change = (speed[-1] - speed[0]).numpy() / (step * len(raw))
            self._windows.append(Window(joints, speed.mean(0).numpy(), change, sign, raw.mean(0).numpy()))
        found = self.observer.run(raw, torch.full((len(raw),), step, dtype=raw.dtype), self._residual)
        self._samples, self._residual = self._samples[-1:], found[-1]
        return found

    def _force(self, residual: Float[Tensor, "J"]) -> float:
        """Estimated force on the hand, N: the one at the tool's frame that best makes the residual."""
        jacobian = self.kinematics.jacobian(self.data.qpos[self._place])[:3]
        felt = (residual - self.tare).numpy()
        return float(np.linalg.norm(np.linalg.solve(jacobian @ jacobian.T + 1e-6 * np.eye(3), jacobian @ felt)))

    def _forget(self) -> None:
        self._samples = []
        rest = self._known_rest
        self._residual = torch.zeros(len(ARM_JOINTS), dtype=torch.float64) if rest is None else rest
        self.tare = self._residual
        self.bandwidth = self.settings.bandwidth


def _mean(windows: list[Window]) -> Window:
    return Window(*(np.mean(part, 0) for part in zip(*windows, strict=True)))
