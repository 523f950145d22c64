"""Grasping a mug by its handle from above, in MuJoCo: a free-flying gripper of two round fingers, and the true mug.

The fingers come down on both sides of the handle, close across it, and lift. A vertical finger touches the ring's tube
high and low, so that the cup, whose weight hangs beside, does not turn in the grip.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.sim.bodies import Body
from rumi.sim.scene import object_xml
from rumi.sim.settings import PhysicsSettings
from rumi.sim.world import _import_mujoco
from rumi.tasks.grasp_primitive import grasp_controls
from rumi.tasks.touch_box.mujoco_scene import six_servos, two_fingers_xml
from sdf import se3
from sdf.primitives import Mug

_DRIVES = ("x", "y", "z", "yaw", "left", "right")
_SETTLE_S = 0.1


@dataclass(frozen=True)
class HandleGrasp:
    """The gripper and its primitive.

    Attributes:
        opening_m: between the fingers when they are open.
        finger_m: radius of a finger.
        tip_m: height of the finger tips above the floor when they close.
        clear_m: height of the tips above the floor before and after.
        out_m: from the middle of the handle's ring outward to where the fingers close.
        lift_m: how far it lifts.
        lifted_m: how far the mug must have risen at the end to count as lifted.
        grip_n: force of a finger, at most.
        stiffness: of the drives along x and y, N/m: low, so that the fingers centre themselves on the handle.
        friction: between fingers and mug.
        time_step_s: of the physics.
    """

    opening_m: float = 0.08
    finger_m: float = 0.008
    tip_m: float = 0.012
    clear_m: float = 0.15
    out_m: float = 0.016
    lift_m: float = 0.10
    lifted_m: float = 0.05
    grip_n: float = 40.0
    stiffness: float = 2e3
    friction: float = 0.5
    time_step_s: float = 0.002


class HandleGripper:
    """Grasps a mug by its handle.

    Args:
        shape: the mug, whose handle's ring is known.
        body: it in the simulator (`rumi.sim.bodies.body_of`).
        physics: its mass, and its friction on the floor.
        believed: the mug that it is taken to be, by which the primitive goes; None for the mug that it is.

    Raises:
        UsageError: the object has no handle that is known.
    """

    def __init__(self, shape: object, body: Body, physics: PhysicsSettings, believed: object = None) -> None:
        believed = shape if believed is None else believed
        for mug in (shape, believed):
            if not isinstance(mug, Mug):
                raise UsageError(f"Expected a mug to grasp by its handle, got {type(mug).__name__}")
        assert isinstance(shape, Mug) and isinstance(believed, Mug)
        self.believed = believed
        self._mujoco = _import_mujoco()
        self.shape, self.body, self.physics, self.settings = shape, body, physics, HandleGrasp()
        self.model: Any = self._mujoco.MjModel.from_xml_string(grasp_xml(shape, body, physics, self.settings))
        self.data: Any = self._mujoco.MjData(self.model)
        self._place = [int(self.model.joint(name).qposadr[0]) for name in _DRIVES]
        self._object = int(self.model.joint("object").qposadr[0])

    @property
    def object_T_grasp(self) -> Float[Tensor, "4 4"]:
        """Where the fingers are to close, in the mug's frame; they close along y."""
        place = (self.believed.outer_radius + self.settings.out_m, 0.0, 0.0)
        return se3.make(torch.eye(3, dtype=torch.float64), torch.tensor(place, dtype=torch.float64))

    @property
    def object_height(self) -> int:
        """Place of the object's height in the positions."""
        return self._object + 2

    def stand(self, believed: Float[Tensor, "3"], world_T_object: Float[Tensor, "4 4"]) -> None:
        """Put the mug where it is and the open gripper over where its handle is believed to be, at rest."""
        self._mujoco.mj_resetData(self.model, self.data)
        quaternion = np.empty(4)
        self._mujoco.mju_mat2Quat(quaternion, world_T_object[:3, :3].double().reshape(-1).numpy())
        start = self._object
        self.data.qpos[start : start + 7] = (*world_T_object[:3, 3].tolist(), *quaternion)
        first = self.controls(believed)[0]
        self.data.qpos[self._place] = first
        self.data.ctrl[:] = first
        self._mujoco.mj_step(self.model, self.data, nstep=round(_SETTLE_S / self.settings.time_step_s))
        self.data.qvel[:] = 0.0

    def grasp(self, believed: Float[Tensor, "3"], world_T_object: Float[Tensor, "4 4"]) -> bool:
        """Carry the primitive out where the mug is believed to stand, (x, y, yaw); whether the mug was lifted."""
        self.stand(believed, world_T_object)
        before = float(self.data.qpos[self.object_height])
        for control in self.controls(believed):
            self.data.ctrl[:] = control
            self._mujoco.mj_step(self.model, self.data)
        return float(self.data.qpos[self.object_height]) - before > self.settings.lifted_m

    def controls(self, believed: Float[Tensor, "3"]) -> np.ndarray:
        """The primitive (T, 6) for a mug at (x, y, yaw): down, close, up, hold."""
        own = self.settings
        pose = se3.from_planar(believed.double()) @ self.object_T_grasp
        x, y, yaw = se3.to_planar(pose).tolist()
        opened, high = 0.5 * own.opening_m + own.finger_m, own.clear_m - own.tip_m
        # closed to 0: the handle is in between, and the force is limited
        return grasp_controls((x, y, yaw), (opened, 0.0), (high, own.lift_m), own.time_step_s)


def grasp_xml(shape: Mug, body: Body, physics: PhysicsSettings, settings: HandleGrasp) -> str:
    """The scene: a floor, the mug with a free joint, and a gripper that slides x, y, z, turns, and closes."""
    own = settings
    r, top = own.finger_m, shape.height + 0.03
    finger = (
        f'type="capsule" size="{r}" fromto="0 0 {own.tip_m + r} 0 0 {top}" mass="0.05" contype="0" conaffinity="2" '
        f'friction="{own.friction} 0.005 0.0001" solref="0.005 1" solimp="0.95 0.99 0.001"'
    )
    drives = six_servos(own.stiffness, (10.0, 0.1), push_n=200.0, press_n=60.0, grip_n=own.grip_n)
    return f"""
<mujoco>
  <option timestep="{own.time_step_s}" integrator="implicitfast" cone="elliptic" impratio="100"/>
  <default><geom condim="4" friction="{physics.friction} 0.005 0.0001"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 0.1" contype="1" conaffinity="0"/>
    <body name="object">
      <freejoint name="object"/>
      {object_xml(body, physics)}
    </body>
    {two_fingers_xml(finger, top, 10, 0.1)}
  </worldbody>
  <actuator>{drives}</actuator>
</mujoco>"""
