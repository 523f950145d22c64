"""Simulated world in which an arm carries the gripper: inverse kinematics, then computed torque within limits."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.robot.tool import level_pose
from rumi.sim.arm_kinematics import REACHED_M, ArmKinematics
from rumi.sim.arm_path import ToolPath
from rumi.sim.bodies import Body
from rumi.sim.contact_isolation import unexplained_by_hand
from rumi.sim.hand_limits import HandDynamics
from rumi.sim.robot_arm import RobotArm
from rumi.sim.robot_dynamics import MujocoDynamics
from rumi.sim.scene import compiled, scene_spec
from rumi.sim.settings import PhysicsSettings
from rumi.sim.world import LEVER_M, Guard, Track, World
from sdf.base import SDF
from sdf.bounds import Checked, NotNegative, Positive
from sensors.force.momentum_observer import DynamicsTerms, MomentumObserver, external_torque

_TOLD = 2  # parts on end in which torques tell of a contact elsewhere, at which it stops
_SHARE = 0.25  # of torques that a hand's contact may leave unexplained: shocks and wrong masses leave as much
_LEAP = 0.2  # rad of a joint from where it is
_SPACING_M = 0.01  # of points on the hand


@dataclass(frozen=True)
class ArmControl(Checked, refusal=UsageError):
    """Computed-torque control of an arm, what its model and sensors have wrong, and its contact signal.

    Attributes:
        bandwidth: of the tracking error, critically damped, 1/s.
        tolerance_m: error of inverse kinematics up to which a target is gone to; radians count a tenth of a metre.
        joint_speed: of each joint at most, rad/s; an action takes as long as that needs.
        mass_error: standard deviation of the model's mass of each link, as a share.
        velocity_noise: white, of each measured velocity, rad/s.
        torque_noise_nm: white, of each measured torque.
        gain: of the momentum observer, 1/s.
        threshold_nm: of the norm of the mean residual in a mini step, from what it was when the arm last stood free. In
            free motion 99.9 % are below 1.26 (1440 of them); a box of .6 kg pushed aside makes 1.3 to 1.9.
    """

    bandwidth: Positive = 60.0
    tolerance_m: Positive = 0.006
    joint_speed: Positive = 1.5
    mass_error: NotNegative = 0.03
    velocity_noise: NotNegative = 0.002
    torque_noise_nm: NotNegative = 0.15
    gain: Positive = 25.0
    threshold_nm: Positive = 1.3


class Sample(NamedTuple):
    """Sample of an arm's sensors with its model's terms.

    Attributes:
        mass: (J, J), mass matrix.
        bias: (J), torques of gravity and of velocity, N m.
        speed: (J), measured, rad/s.
        torque: (J), measured, N m.
    """

    mass: np.ndarray
    bias: np.ndarray
    speed: np.ndarray
    torque: np.ndarray


class ArmWorld(World):
    """A world whose gripper a serial arm carries; its links touch too.

    Targets of the tool become joint positions by inverse kinematics, each from the one before; where that fails the arm
    goes no farther. The joints follow by computed torque, M (a + w^2 e + 2 w e') + bias, by a model whose masses are a
    little wrong, cut to the motors' torques and so that along no axis the hand is led farther or presses harder than
    `PhysicsSettings` allows.

    Attributes:
        signals: (K), whether the joints' torques told of a contact in each part of the last action.
        links_touch: (K), whether a link touched the object in it, in truth.

    Args:
        shape: the object's exact shape, or the body that was made of it.
        gripper: the gripper's shape.
        height_m: height of the level tool; None for one that moves in space.
        time_step_s: of the physics and of control.
        physics: mass and friction of the object, forces at most.
        arm: that carries the gripper.
        control: of the arm.
    """

    def __init__(
        self,
        shape: SDF | Body,
        gripper: GripperShape,
        height_m: float | None,
        time_step_s: float,
        physics: PhysicsSettings | None = None,
        *,
        arm: RobotArm,
        control: ArmControl | None = None,
    ) -> None:
        self.arm, self.control, self.height_m = arm, control or ArmControl(), height_m
        super().__init__(shape, gripper, height_m, time_step_s, physics)
        self.kinematics = ArmKinematics(arm.alone(gripper), arm.names, arm.low, arm.high)
        self.path = ToolPath(arm, self.kinematics, self.control.tolerance_m, self.control.joint_speed)
        self._dof = [int(self.model.joint(name).dofadr[0]) for name in arm.names]
        self._links = {
            int(self.model.body(name).id)
            for name in (self.kinematics.model.body(i).name for i in range(1, self.kinematics.model.nbody))
            if name != "gripper"
        }
        self._gripper_shape = gripper
        self._first = np.eye(len(arm.joints))[0]
        own = self.physics
        self._forces = np.array((own.max_force_n, own.max_force_n, own.max_lift_n, own.max_torque_nm))
        self._hand_m = float(gripper.surface(_SPACING_M).norm(dim=-1).max())
        self._lead = own.lead_m * np.array((1.0, 1.0, 1.0, 1.0 / LEVER_M))
        self.signals: Bool[Tensor, "K"] = torch.zeros(0, dtype=torch.bool)
        self.links_touch: Bool[Tensor, "K"] = torch.zeros(0, dtype=torch.bool)
        self.seed(0)

    def seed(self, seed: int) -> None:
        """Draw what the controller's model has wrong, and begin the sensors' noise anew."""
        self._random = np.random.default_rng((seed, 2))
        model = self.arm.alone(self._gripper_shape)
        factors = np.clip(1.0 + self.control.mass_error * self._random.standard_normal(model.nbody), 0.5, 1.5)
        model.body_mass[:] *= factors
        model.body_inertia[:] *= factors[:, None]
        self.dynamics = MujocoDynamics(model, self.arm.names)
        self._residual = self._rest = torch.zeros(len(self.arm.joints), dtype=torch.float64)
        self._last: list[Sample] = []

    def _compiled(self, gripper: GripperShape, height_m: float | None, time_step_s: float) -> Any:  # noqa: ANN401
        spec = scene_spec(self._mujoco, self.body, time_step_s, self.physics)
        self.arm.attach(spec, gripper, self.physics.friction)
        return compiled(spec, self.physics)

    def _axes(self, height_m: float | None) -> tuple[str, ...]:  # type: ignore[override]
        return self.arm.names

    def _stand(self, configuration: Float[Tensor, "Q"]) -> None:
        ways, errors = self.path.ways(self._level(configuration))
        reached = np.flatnonzero(errors <= self.control.tolerance_m)
        if not len(reached):
            raise UsageError(
                f"Expected the arm to reach the tool's start {[round(x, 3) for x in configuration.tolist()]}, its "
                f"inverse kinematics ends {1000 * errors.min():.0f} mm off (a radian counts a tenth of a metre)"
            )
        # the first way to hold it in which no link is in the floor
        self.path.posture = next((k for k in reached.tolist() if self._is_clear(ways[k])), int(reached[0]))
        self.data.qpos[self._gripper] = self._wanted = ways[self.path.posture]

    def _is_clear(self, joints: np.ndarray) -> bool:
        """Whether no link meets the floor."""
        self.data.qpos[self._gripper] = joints
        self._mujoco.mj_forward(self.model, self.data)
        pairs = np.asarray(self.model.geom_bodyid)[np.asarray(self.data.contact.geom).reshape(-1, 2)]
        return not any(0 in pair and self._links & set(pair) for pair in pairs.tolist())

    def _hold(self, steps: int) -> None:
        zero = np.zeros(len(self._dof))
        samples = [self._step(self._wanted, zero, zero) for _ in range(steps)]
        self._felt(samples, float(self.model.opt.timestep))
        self._rest, self._last = self._residual, samples[-1:]

    def move(self, targets: Float[Tensor, "K Q"], action_s: float, hold_s: float, guard: Guard | None = None) -> Track:
        """Move the tool through targets spread evenly over `action_s` as far as the arm can, then hold.

        It stops where its torques tell in two parts on end of a contact that is against its way and not at the hand:
        what the hand pushes is known. They tell by what differs from when it last stood free: by what it felt while it
        pressed on something it would feel a contact where it draws back.
        """
        step_s, poses = float(self.model.opt.timestep), self._level(targets)
        way = self.path.through(self._wanted, poses, action_s)
        ends = np.maximum(1, np.round(way.ends / step_s).astype(int))
        ends[-1] += max(1, round(hold_s / step_s)) if hold_s > 0 else 0
        position, velocity, acceleration = way.sampled(step_s, int(ends[-1]))
        tools, signals, links = [], [], []
        samples, touched, against = self._last, False, 0
        over, late, hold = self._ending(guard, hold_s)
        stopped: np.ndarray | None = None
        zero = np.zeros(len(self._dof))

        def drive(step: int | None) -> None:
            nonlocal touched, stopped
            if stopped is None and step is not None:
                samples.append(self._step(position[step], velocity[step], acceleration[step]))
            else:
                stopped = self._joints_now() if stopped is None else stopped
                samples.append(self._step(stopped, zero, zero))
            touched = touched or self._link_touches()

        def ended(index: int, steps: int) -> bool:
            nonlocal samples, touched, against, stopped
            external, samples = self._felt(samples, step_s).mean(0) - self._rest, samples[-1:]
            tools.append(self._world_T_tool())
            signals.append(float(external.norm()) > self.control.threshold_nm)
            links.append(touched)
            touched = False
            resisted = signals[-1] and float(external.numpy() @ velocity[steps - 1]) < 0.0
            against = against + 1 if resisted and self._elsewhere(external.numpy()) else 0
            if stopped is None and against == _TOLD:
                stopped = self._joints_now()
            return over is not None and over(index, steps)

        states = self._through(ends.tolist(), drive, ended, late, hold)
        guarded = len(states) < len(ends)
        if guarded:
            tools[-1] = self._world_T_tool()  # after the hold, as the state
        self._last = samples
        if not signals[-1]:
            self._rest = self._residual
        wanted = way.joints[-1] if stopped is None else stopped
        whole = guarded or (way.arrived == len(ends) and stopped is None)
        place = torch.from_numpy(self.kinematics.place(wanted)[0])
        refused = 0.0 if whole else float((place - poses[-1, :3, 3]).norm())
        self._wanted = self._led(wanted, self._joints_now())
        self.signals, self.links_touch = torch.tensor(signals), torch.tensor(links)
        pose = torch.from_numpy(np.stack(tools))
        return Track(self._configurations(pose), self._object_poses(states), pose, refused)

    def _elsewhere(self, external: np.ndarray) -> bool:
        """Whether torques (J) tell of a contact that is not at the hand."""
        jacobian = self.kinematics.jacobian(self._joints_now())
        least = max(self.control.threshold_nm, _SHARE * float(np.linalg.norm(external)))
        return unexplained_by_hand(external, jacobian, self._hand_m) > least

    def configuration(self) -> Float[Tensor, "Q"]:
        """Measured x, y, in space z, and yaw of the gripper, by forward kinematics."""
        return self._configurations(torch.from_numpy(self._world_T_tool())[None])[0]

    def now(self) -> Track:
        """The present instant, with the tool as it hangs."""
        pose = torch.from_numpy(self._world_T_tool())[None]
        return Track(self._configurations(pose), self.world_T_object()[None], pose)

    def _configurations(self, world_T_tool: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K Q"]:
        yaw = torch.atan2(world_T_tool[:, 1, 0], world_T_tool[:, 0, 0])[:, None]
        return torch.cat((world_T_tool[:, : 2 if self.height_m is not None else 3, 3], yaw), -1)

    def _joints(self, configuration: Float[Tensor, "Q"]) -> np.ndarray:
        return self.path.solve(self._level(configuration)[None])[0][0]

    def _level(self, configuration: Float[Tensor, "*b Q"]) -> Float[Tensor, "*b 4 4"]:
        """world_T_tool of level tools."""
        return level_pose(configuration.double(), self.height_m)

    def _step(self, position: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Sample:
        """One control step: measure, command, let the engine step."""
        own, data, size = self.control, self.data, len(self._dof)
        joints = self._joints_now()
        speed = data.qvel[self._dof] + own.velocity_noise * self._random.standard_normal(size)
        mass, bias = self.dynamics.terms(joints, speed)
        hand, w = HandDynamics.of(mass, self.kinematics.jacobian(joints)), own.bandwidth
        servo = w * w * (self._led(position, joints) - joints) + 2.0 * w * (velocity - speed)
        torque = mass @ (acceleration + hand.pressed(servo, self._forces)) + bias
        limits = self.arm.torques
        data.ctrl[:] = torque = np.clip(torque, -limits, limits)
        self._mujoco.mj_step(self.model, data)
        return Sample(mass, bias, speed, torque + own.torque_noise_nm * self._random.standard_normal(size))

    def _led(self, wanted: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Joint positions for those asked for that lead the hand no farther than they may along each axis, level.

        Where the arm would have to leap for that, as where it is stretched out, a part of what was asked for.
        """
        here = self.kinematics.pose(joints)
        ahead = self.kinematics.pose(wanted) - here
        ahead[3] = math.remainder(ahead[3], 2.0 * math.pi)
        cut = np.clip(ahead, -self._lead, self._lead)
        if np.array_equal(cut, ahead):
            return wanted
        found, error = self.kinematics.solve(here + cut, wanted)
        if error <= REACHED_M and np.abs(found - joints).max() <= max(_LEAP, np.abs(wanted - joints).max()):
            return found
        return joints + (wanted - joints) * float((self._lead / np.maximum(np.abs(ahead), self._lead)).min())

    def _joints_now(self) -> np.ndarray:
        """Measured joint positions."""
        return np.array(self.data.qpos[self._gripper])

    def _felt(self, samples: list[Sample], step_s: float) -> Float[Tensor, "T J"]:
        """Residuals of the momentum observer over samples, the first of which is the last of those before."""
        mass, bias, speed, torque = (torch.from_numpy(np.stack(part)) for part in zip(*samples, strict=True))
        if len(samples) < 2:
            return self._residual[None]
        before, after = DynamicsTerms(mass[:-1], bias[:-1]), DynamicsTerms(mass[1:], bias[1:])
        raw = external_torque(before, speed[:-1], after, speed[1:], torque[:-1], step_s)
        steps = torch.full((len(raw),), step_s, dtype=raw.dtype)
        found = MomentumObserver(self.control.gain).run(raw, steps, self._residual)
        self._residual = found[-1]
        return found

    def _link_touches(self) -> bool:
        """Whether a link of the arm touches the object."""
        for pair in np.asarray(self.data.contact.geom):
            bodies = {int(self.model.geom_bodyid[geom]) for geom in pair}
            if self._object_body in bodies and bodies & self._links:
                return True
        return False

    def _world_T_tool(self) -> np.ndarray:
        place, turn = self.kinematics.place(self.data.qpos[self._gripper])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, place
        return pose
