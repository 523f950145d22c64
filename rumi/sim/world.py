"""Simulated world: MuJoCo behind a few plain calls."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.sim.bodies import Body, body_of
from rumi.sim.scene import RAY_GROUPS, scene_model
from rumi.sim.settings import PhysicsSettings
from sdf import se3, so3
from sdf.base import SDF
from sdf.extras import optional

_SETTLE_S = 1.0
_STANDS_DEG = 10.0
LEVER_M = 0.1
"""Of a turn of the gripper, by which angles are measured against lengths."""


class Track(NamedTuple):
    """Track of gripper and object: their poses at the end of each mini step.

    Attributes:
        configuration: (K, Q), measured x, y, in space z, and yaw of the gripper.
        world_T_object: (K, 4, 4).
        world_T_tool: (K, 4, 4), of a tool that a robot carries as well as it can; None where it is level.
        refused_m: part of the way, metres, that the robot did not begin.
    """

    configuration: Float[Tensor, "K Q"]
    world_T_object: Float[Tensor, "K 4 4"]
    world_T_tool: Float[Tensor, "K 4 4"] | None = None
    refused_m: float = 0.0


class Guard(NamedTuple):
    """What ends a motion before its end: a guarded move.

    Attributes:
        touched: asked after each mini step, by its number, whether the motion is to end with it.
        late_s: how much longer it goes on at its speed.
    """

    touched: Callable[[int], bool]
    late_s: float = 0.0


class World:
    """One scene of MuJoCo; float64.

    Args:
        shape: the object's exact shape, or the body that was made of it.
        gripper: the gripper's shape.
        height_m: height of the tool frame; None for a gripper that moves in space.
        time_step_s: of the physics.
        physics: masses, friction, drive.
    """

    def __init__(
        self,
        shape: SDF | Body,
        gripper: GripperShape,
        height_m: float | None,
        time_step_s: float,
        physics: PhysicsSettings | None = None,
    ) -> None:
        self._mujoco = _import_mujoco()
        self.physics = physics or PhysicsSettings()
        self.body = shape if isinstance(shape, Body) else body_of(shape, self.physics)
        self.model: Any = self._compiled(gripper, height_m, time_step_s)
        self.data: Any = self._mujoco.MjData(self.model)
        self._object = int(self.model.joint("object").qposadr[0])
        self._object_speed = int(self.model.joint("object").dofadr[0])
        self._gripper = [int(self.model.joint(name).qposadr[0]) for name in self._axes(height_m)]
        self._object_body = int(self.model.body("object").id)
        self._apart: Any = None

    def _compiled(self, gripper: GripperShape, height_m: float | None, time_step_s: float) -> Any:  # noqa: ANN401
        """The scene as a MuJoCo model."""
        return scene_model(self._mujoco, self.body, gripper, height_m, time_step_s, self.physics)

    @staticmethod
    def _axes(height_m: float | None) -> tuple[str, ...]:
        return ("x", "y", "z", "yaw") if height_m is None else ("x", "y", "yaw")

    def seed(self, seed: int) -> None:
        """Draw what the robot's own model and sensors have wrong; of a gripper that flies, nothing."""

    def reset(self, configuration: Float[Tensor, "Q"], object_pose: Float[Tensor, "*p"]) -> None:
        """Put the gripper and the object where they start, and let both settle.

        The object's pose is (x, y, yaw) upright on the floor, or a transform (4, 4) from its frame to the world's.

        A resting object sinks into the floor's soft contact by a tenth of a millimetre and tilts by a milliradian; if
        that were left to the first action, a slip sensor would report it as a move.

        Raises:
            UsageError: the object tips over.
        """
        self._mujoco.mj_resetData(self.model, self.data)
        self._stand(configuration)
        start = self._object
        if object_pose.ndim == 1:
            x, y, yaw = object_pose.tolist()
            half = 0.5 * yaw
            self.data.qpos[start : start + 7] = (x, y, -self.body.low_m, math.cos(half), 0.0, 0.0, math.sin(half))
        else:
            quaternion = np.empty(4)
            self._mujoco.mju_mat2Quat(quaternion, object_pose[:3, :3].double().reshape(-1).numpy())
            self.data.qpos[start : start + 7] = (*object_pose[:3, 3].tolist(), *quaternion)
        standing = self.world_T_object()[2, :3].clone()
        self._hold(round(_SETTLE_S / float(self.model.opt.timestep)))
        self.data.qvel[:] = 0.0
        self.data.time = 0.0
        self._mujoco.mj_forward(self.model, self.data)
        up = self.world_T_object()[2, :3]
        tilt = math.degrees(math.acos(max(-1.0, min(1.0, float(up @ standing)))))
        if tilt > _STANDS_DEG:
            raise UsageError(
                f"Expected the object to stand by itself, but it tipped by {tilt:.0f} degrees: say how it stands "
                "(--upright ROLL PITCH YAW)"
            )

    def _stand(self, configuration: Float[Tensor, "Q"]) -> None:
        """Put the gripper somewhere, at rest."""
        self.data.qpos[self._gripper] = configuration.double().numpy()
        self.data.ctrl[:] = configuration.double().numpy()

    def _hold(self, steps: int) -> None:
        """Let time pass while the gripper stays where it is."""
        self._mujoco.mj_step(self.model, self.data, nstep=steps)

    def move(self, targets: Float[Tensor, "K Q"], action_s: float, hold_s: float, guard: Guard | None = None) -> Track:
        """Drive the gripper through targets spread evenly over `action_s`, then hold; the last entry is after that.

        Args:
            targets: (K, Q), the last of each mini step.
            action_s: how long that takes.
            hold_s: of standing still after it.
            guard: ends it earlier: there are as many entries then as mini steps were begun.
        """
        count, steps = len(targets), round(action_s / float(self.model.opt.timestep))
        knots = np.concatenate((np.asarray(self.data.ctrl)[None], targets.double().numpy()))
        # the commands in between go along straight lines
        phase = (np.arange(steps) + 1.0) * (count / steps)
        commands = np.stack(
            [np.interp(phase, np.arange(count + 1.0), knots[:, axis]) for axis in range(knots.shape[1])], -1
        )
        control, position, lead, gripper = self.data.ctrl, self.data.qpos, self.physics.lead_m, self._gripper
        ahead = np.array([lead] * (len(gripper) - 1) + [lead / LEVER_M])
        held = math.isfinite(lead)

        def drive(step: int | None) -> None:
            if step is not None and step < steps:
                control[:] = commands[step]
                if held:
                    np.clip(control, position[gripper] - ahead, position[gripper] + ahead, out=control)
            self._advance()

        states = self._through(self._ends(count, action_s, hold_s), drive, *self._ending(guard, hold_s))
        return Track(torch.from_numpy(states[:, gripper]), self._object_poses(states))

    def _ends(self, count: int, action_s: float, hold_s: float) -> list[int]:
        """How many steps of the physics have been taken at the end of each mini step; the last is after the hold."""
        step_s = float(self.model.opt.timestep)
        steps = round(action_s / step_s)
        ends = [max(1, round((k + 1) * steps / count)) for k in range(count)]
        ends[-1] += max(1, round(hold_s / step_s)) if hold_s > 0 else 0
        return ends

    def _ending(self, guard: Guard | None, hold_s: float) -> tuple[Callable[[int, int], bool] | None, int, int]:
        """Whether a motion ends with a mini step, and for how many steps it goes on and is held then."""
        if guard is None:
            return None, 0, 0
        step_s, touched = float(self.model.opt.timestep), guard.touched
        return lambda index, _: touched(index), round(guard.late_s / step_s), max(1, round(hold_s / step_s))

    def _through(
        self,
        ends: Sequence[int],
        drive: Callable[[int | None], None],
        ended: Callable[[int, int], bool] | None = None,
        late: int = 0,
        hold: int = 0,
    ) -> np.ndarray:
        """Go through mini steps; the state (K, N) at the end of each.

        Args:
            ends: how many steps of the physics have been taken at the end of each.
            drive: commands and takes a step; None to stand still.
            ended: told of each mini step's number and of the steps taken, once it is over; whether nothing follows.
            late: steps for which the motion goes on all the same.
            hold: steps of standing still after that.
        """
        states = np.empty((len(ends), len(self.data.qpos)))
        for index, (first, last) in enumerate(pairwise((0, *ends))):
            for step in range(first, last):
                drive(step)
            states[index] = self.data.qpos
            if ended is not None and ended(index, last) and last < ends[-1]:
                for step in range(last, min(last + late, ends[-1])):
                    drive(step)
                for _ in range(hold):
                    drive(None)
                states[index] = self.data.qpos
                return states[: index + 1]
        return states

    def _advance(self) -> None:
        """Let the physics take a step."""
        self._mujoco.mj_step(self.model, self.data)

    def place(self, world_T_object: Float[Tensor, "4 4"]) -> None:
        """Put the object somewhere else, at rest."""
        posed, start, speed = self._posed(self.configuration(), world_T_object), self._object, self._object_speed
        self.data.qpos[start : start + 7] = posed.qpos[start : start + 7]
        self.data.qvel[speed : speed + 6] = 0.0
        self._mujoco.mj_forward(self.model, self.data)

    def make_heavier(self, factor: float) -> None:
        """Scale the object's mass and inertia, with what the engine has worked out from them.

        Contacts are scaled by inverse masses that are part of the model: with those of a light object a heavy one is
        flung about.
        """
        self.model.body_mass[self._object_body] *= factor
        self.model.body_inertia[self._object_body] *= factor
        self._mujoco.mj_setConst(self.model, self._mujoco.MjData(self.model))  # of the reference pose, in a state apart

    def configuration(self) -> Float[Tensor, "Q"]:
        """Measured x, y, in space z, and yaw of the gripper."""
        return torch.from_numpy(np.array(self.data.qpos[self._gripper]))

    def now(self) -> Track:
        """The present instant."""
        return Track(self.configuration()[None], self.world_T_object()[None])

    def world_T_object(self) -> Float[Tensor, "4 4"]:
        """Where the object is."""
        return self._object_poses(np.asarray(self.data.qpos)[None])[0]

    def cast(
        self,
        origin: Float[Tensor, "3"],
        directions: Float[Tensor, "n 3"],
        *,
        at: tuple[Float[Tensor, "Q"], Float[Tensor, "4 4"]] | None = None,
        through_gripper: bool = False,
    ) -> tuple[Float[Tensor, "n"], Tensor]:
        """Cast rays into the scene.

        Args:
            origin: (3,), metres.
            directions: (n, 3), of any length.
            at: configuration of the gripper and world_T_object, for the scene as it was; None for as it is.
            through_gripper: whether rays go through the gripper as if it were not there.

        Returns:
            how many times each direction's length the ray goes to what it meets first (n; infinite if nothing),
            and whether that is the object (n).
        """
        count = len(directions)
        geom, distance = np.empty(count, np.int32), np.empty(count)
        data = self.data if at is None else self._posed(*at)
        # positions follow the state only after the kinematics of the next step
        self._mujoco.mj_kinematics(self.model, data)
        self._mujoco.mj_multiRay(
            self.model,
            data,
            origin.double().numpy(),
            directions.double().reshape(-1).numpy(),
            np.array(RAY_GROUPS, dtype=np.uint8),
            True,
            int(self.model.body("gripper").id) if through_gripper else -1,
            geom,
            distance,
            None,
            count,
            1e10,
        )
        missed = geom < 0
        bodies = np.asarray(self.model.geom_bodyid)[np.where(missed, 0, geom)]
        distance[missed] = np.inf
        return torch.from_numpy(distance), torch.from_numpy(~missed & (bodies == self._object_body))

    def _posed(self, configuration: Float[Tensor, "Q"], world_T_object: Float[Tensor, "4 4"]) -> Any:  # noqa: ANN401
        """A state apart, for looking at."""
        if self._apart is None:
            self._apart = self._mujoco.MjData(self.model)
        position = self._apart.qpos
        quaternion = np.empty(4)
        self._mujoco.mju_mat2Quat(quaternion, world_T_object[:3, :3].double().reshape(-1).numpy())
        position[self._gripper] = self._joints(configuration)
        start = self._object
        position[start : start + 7] = (*world_T_object[:3, 3].tolist(), *quaternion)
        return self._apart

    def _joints(self, configuration: Float[Tensor, "Q"]) -> np.ndarray:
        """Positions of the robot's joints at a configuration of the tool."""
        return configuration.double().numpy()

    def _object_poses(self, states: np.ndarray) -> Float[Tensor, "K 4 4"]:
        pose = torch.from_numpy(states[:, self._object : self._object + 7].copy())
        return se3.make(so3.from_wxyz(pose[:, 3:]), pose[:, :3])


def _import_mujoco() -> Any:  # noqa: ANN401
    return optional("mujoco", "The simulator")
