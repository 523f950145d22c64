"""Simulated world with the contact wrench at every step of the physics, for wrist and joint sensors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from rumi.sim.world import Guard, Track, World


class WrenchTrace(NamedTuple):
    """Configurations and contact wrenches of an action at every step of the physics.

    Attributes:
        stamp: (T), seconds, at the end of each step.
        configuration: (T, 3), x, y, yaw of the gripper at the end of each step.
        wrench: (T, 6), force (N) of the object on the gripper and its moment (N m) about the origin of the tool frame,
            world axes, in each step.
        ends: (K), the steps at whose end the mini steps of the action end; the last is after the hold.
    """

    stamp: np.ndarray
    configuration: np.ndarray
    wrench: np.ndarray
    ends: np.ndarray


class ForceSensingWorld(World):
    """A world that keeps the contact wrenches of its last `move`; its motions are those of a `World`, to the bit."""

    trace: WrenchTrace | None = None
    _own: int | None = None
    _steps: list[tuple[np.ndarray, np.ndarray]] | None = None

    def move(self, targets: Float[Tensor, "K Q"], action_s: float, hold_s: float, guard: Guard | None = None) -> Track:
        """Drive the gripper as `World.move` does."""
        began, self._steps = float(self.data.time), []
        track = super().move(targets, action_s, hold_s, guard)
        configuration, wrench = (np.stack(rows) for rows in zip(*self._steps, strict=True))
        stamp = began + float(self.model.opt.timestep) * (1.0 + np.arange(len(wrench)))
        ends = np.array(self._ends(len(targets), action_s, hold_s))[: len(track.configuration)] - 1
        ends[-1] = len(wrench) - 1
        self.trace, self._steps = WrenchTrace(stamp, configuration, wrench, ends), None
        return track

    def _advance(self) -> None:
        super()._advance()
        if self._steps is not None:
            configuration = np.array(self.data.qpos[self._gripper])
            self._steps.append((configuration, self._wrench(configuration)))

    def _wrench(self, configuration: np.ndarray) -> np.ndarray:
        """Force of contact on the gripper and its moment about the tool frame's origin, in the last step."""
        total, force = np.zeros(6), np.zeros(6)
        if self.data.ncon == 0:
            return total
        own = self._gripper_body
        bodies = self.model.geom_bodyid
        origin = np.array([configuration[0], configuration[1], self._height])
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            first, second = (int(bodies[geom]) for geom in contact.geom)
            if own not in (first, second):
                continue
            self._mujoco.mj_contactForce(self.model, self.data, index, force)
            frame = np.asarray(contact.frame).reshape(3, 3)
            # the engine gives the force of the first geom on the second
            sign = 1.0 if own == second else -1.0
            push, turn = sign * (frame.T @ force[:3]), sign * (frame.T @ force[3:])
            total[:3] += push
            total[3:] += turn + np.cross(np.asarray(contact.pos) - origin, push)
        return total

    @property
    def _gripper_body(self) -> int:
        if self._own is None:
            self._own = int(self.model.body("gripper").id)
        return self._own

    @property
    def _height(self) -> float:
        return float(self.model.body("gripper").pos[2])

    def contacts(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Points at which the gripper touches the object now, and the normals of contact there, world frame."""
        own, found = self._gripper_body, []
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            if own in (int(self.model.geom_bodyid[geom]) for geom in contact.geom):
                found.append((np.array(contact.pos), np.array(contact.frame[:3])))
        return found
