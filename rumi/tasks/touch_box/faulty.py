"""A robot before a box with which something goes wrong: what it does and what it reports, changed on the way."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.sim.fault import Fault
from rumi.sim.object_faults import Absent, Knock
from rumi.sim.sensor_faults import Dead, FalseContact, HandOff
from rumi.tasks.touch_box.robot import GoOn, SimulatedBox, Touched
from rumi.tasks.touch_box.scene import BoxTruth

KINDS = ("knock", "absent", "hand", "dead", "false-contact")
"""The faults of this task."""

_AWAY_M = 5.0  # from the table: out of reach
_READINGS = 10  # the first of a poke, one of which a false contact is


class FaultyRobot:
    """A `TouchRobot` whose box is moved or taken away, or whose hand is off, dead, or feels what is not there.

    Args:
        robot: that pokes and grasps.
        faults: of `KINDS`.
    """

    def __init__(self, robot: SimulatedBox, faults: Sequence[Fault]) -> None:
        self.robot, self.faults, self._pokes = robot, tuple(faults), 0

    def reset(self, truth: BoxTruth, seed: int) -> None:
        """Set a run up in which nothing went wrong yet."""
        self._pokes = 0
        self.robot.reset(truth, seed)

    def execute(self, path: Float[Tensor, "K1 3"], go_on: GoOn) -> Touched:
        """Poke along a path, as far as the robot knows."""
        self._pokes += 1
        for fault in self.faults:
            if fault.step == self._pokes:
                self._strike(fault)
        touched = self.robot.execute(path - self._off().to(path), lambda so_far: go_on(self._reported(so_far)))
        return self._reported(touched)

    def grasp(self, pose: Float[Tensor, "3"]) -> bool:
        """Grasp where the robot takes the pose to be."""
        return self.robot.grasp(pose - self._off().to(pose))

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (the rest is the robot's)
        return getattr(self.robot, name)

    def _strike(self, fault: Fault) -> None:
        pose = self.robot.box_pose().clone()
        if isinstance(fault, Absent):
            pose[0] += _AWAY_M
        elif isinstance(fault, Knock):
            pose = fault.struck(pose)
        else:
            return
        self.robot.put_box(pose)

    def _off(self) -> Float[Tensor, "3"]:
        """How far beside itself the hand takes itself to be, (x, y, yaw)."""
        off = torch.zeros(3, dtype=torch.float64)
        for fault in self.faults:
            if isinstance(fault, HandOff) and fault.step <= self._pokes:
                off[:2] += fault.aside()[:2].double()
        return off

    def _reported(self, touched: Touched) -> Touched:
        contact = touched.contact.clone()
        for fault in self.faults:
            if fault.step > self._pokes:
                continue
            if isinstance(fault, Dead):
                contact[:] = False
            elif isinstance(fault, FalseContact):
                chance, when = torch.rand(2, generator=fault.drawn(self._pokes)).tolist()
                at = int(when * _READINGS)
                if chance < fault.size and at < len(contact):
                    contact[at] = True
        return touched._replace(path=touched.path + self._off().to(touched.path), contact=contact)
