"""The touch-alone scene in MuJoCo: a box on the floor, and a free-flying gripper of two round fingers.

Contacts are stiff and their friction is that of pairs: soft ones let a finger sink millimetres into a box's edge and
slip round a corner that a rigid one pushes.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch

from rumi.sim.path_push import PathScene
from rumi.sim.world import _import_mujoco
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask

CLEAR_M, TIP_M = 0.15, 0.01
"""How far the gripper is lifted between pokes, and how far above the floor its finger tips poke."""

_FRICTIONS = 5  # that particles are pushed with, the nearest each: a model of the engine has one


@dataclass(frozen=True)
class GripperPhysics:
    """Drive and contact of the simulated gripper.

    Attributes:
        time_step_s: of the physics.
        stiffness: of the servos along x and y while poking, N/m.
        grasp_stiffness: the same while grasping: lower, so that the fingers centre themselves on the box.
        mass_kg: inertia along x, y and z.
        inertia: about z, kg m^2.
        grip_n: force of a finger, at most.
        push_n: force of the drive along x and y, at most.
        press_n: force of the drive along z, at most.
        contact_s: time constant of contacts (MuJoCo's solref).
    """

    time_step_s: float = 0.001
    stiffness: float = 1e6
    grasp_stiffness: float = 2e3
    mass_kg: float = 10.0
    inertia: float = 0.1
    grip_n: float = 40.0
    push_n: float = 200.0
    press_n: float = 30.0
    contact_s: float = 0.002


def scene_xml(task: TouchTask, physics: GripperPhysics, *, grasping: bool) -> str:
    """The scene; `box` has a free joint, the gripper slides x, y, z, a hinge yaw, and slides left and right."""
    r, own = task.finger_m, physics
    half = (*task.half, 0.5 * task.height_m)
    stiffness = own.grasp_stiffness if grasping else own.stiffness
    top = task.height_m + 0.03
    finger = f'type="capsule" size="{r}" fromto="0 0 {TIP_M + r} 0 0 {top}" mass="0.05" contype="0" conaffinity="0"'
    contact = f'solref="{own.contact_s} 1" solimp="0.99 0.999 0.0005" condim="4"'
    drives = six_servos(
        stiffness, (own.mass_kg, own.inertia), push_n=own.push_n, press_n=own.press_n, grip_n=own.grip_n
    )
    return f"""
<mujoco>
  <option timestep="{own.time_step_s}" integrator="implicitfast" cone="elliptic" impratio="100"/>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 0.1" contype="0" conaffinity="0"/>
    <body name="box" pos="0 0 {half[2]}">
      <freejoint name="box"/>
      <geom name="box" type="box" size="{half[0]} {half[1]} {half[2]}" mass="0.5" contype="0" conaffinity="0"/>
    </body>
    {two_fingers_xml(finger, top, own.mass_kg, own.inertia)}
  </worldbody>
  <contact>
    <pair name="floor" geom1="floor" geom2="box" friction="0.4 0.4 0.002 0.0001 0.0001" {contact}/>
    <pair name="left" geom1="left" geom2="box" friction="0.4 0.4 0.002 0.0001 0.0001" {contact}/>
    <pair name="right" geom1="right" geom2="box" friction="0.4 0.4 0.002 0.0001 0.0001" {contact}/>
  </contact>
  <actuator>{drives}</actuator>
</mujoco>"""


def six_servos(stiffness: float, inertias: tuple[float, float], *, push_n: float, press_n: float, grip_n: float) -> str:
    """Actuators of a gripper's x, y, z, yaw, left and right.

    Args:
        stiffness: of x and y, newtons a metre; a hundredth of yaw's.
        inertias: that every slide moves, kg, and that the hinge turns, kg m^2.
        push_n: of x and y at most.
        press_n: of z.
        grip_n: of each finger.
    """
    mass_kg, inertia = inertias
    drives = (
        ("x", stiffness, mass_kg, push_n),
        ("y", stiffness, mass_kg, push_n),
        ("z", 2e4, mass_kg, press_n),
        ("yaw", 0.01 * stiffness, inertia, 20.0),
        ("left", 2e4, 0.5, grip_n),
        ("right", 2e4, 0.5, grip_n),
    )
    return "".join(servo(name, name, *limits) for name, *limits in drives)


def two_fingers_xml(finger: str, top_m: float, mass_kg: float, inertia: float) -> str:
    """A gripper that slides x, y, z, turns, and closes two fingers along y.

    Args:
        finger: attributes of a finger's geom.
        top_m: where fingers end and the palm begins, above the gripper's frame.
        mass_kg: that every slide moves.
        inertia: that the turn moves, kg m^2.
    """
    return f"""<body name="gripper" gravcomp="1">
      <joint name="x" type="slide" axis="1 0 0" armature="{mass_kg}"/>
      <joint name="y" type="slide" axis="0 1 0" armature="{mass_kg}"/>
      <joint name="z" type="slide" axis="0 0 1" armature="{mass_kg}"/>
      <joint name="yaw" type="hinge" axis="0 0 1" armature="{inertia}"/>
      <geom type="box" size="0.02 0.06 0.01" pos="0 0 {top_m + 0.03}" mass="0.1" contype="0" conaffinity="0"/>
      <body name="left" gravcomp="1">
        <joint name="left" type="slide" axis="0 1 0" armature="0.5"/>
        <geom name="left" {finger}/>
      </body>
      <body name="right" gravcomp="1">
        <joint name="right" type="slide" axis="0 -1 0" armature="0.5"/>
        <geom name="right" {finger}/>
      </body>
    </body>"""


def servo(name: str, joint: str, stiffness: float, inertia: float, limit: float) -> str:
    """A position servo of a joint, critically damped, with a limit of its force, as MJCF text."""
    damping = 2.0 * math.sqrt(stiffness * inertia)
    return (
        f'<position name="{name}" joint="{joint}" kp="{stiffness:.9g}" kv="{damping:.9g}" '
        f'forcerange="{-limit} {limit}"/>'
    )


def set_truth(mujoco: Any, model: Any, task: TouchTask, truth: BoxTruth) -> None:  # noqa: ANN401
    """Give a model the mass and friction of one run."""
    for name, friction in (("floor", truth.floor_friction), ("left", truth.friction), ("right", truth.friction)):
        model.pair_friction[model.pair(name).id][:2] = friction
    body = model.body("box").id
    sides = (*(2.0 * half for half in task.half), task.height_m)
    squares = [side * side for side in sides]
    model.body_mass[body] = truth.mass_kg
    model.body_inertia[body] = [truth.mass_kg / 12.0 * (sum(squares) - square) for square in squares]
    mujoco.mj_setConst(model, mujoco.MjData(model))


def path_scene(task: TouchTask) -> PathScene:
    """Boxes and the task's gripper for pushes along paths; needs MuJoCo.

    Mass and the floor's friction are the middles of the task's ranges.

    Args:
        task: the scene.
    """
    mujoco = _import_mujoco()
    physics = GripperPhysics(time_step_s=0.002, contact_s=0.004)
    text = scene_xml(task, physics, grasping=False)
    low, high = task.friction
    frictions = tuple(low + (high - low) * (k + 0.5) / _FRICTIONS for k in range(_FRICTIONS))
    floor, mass = (0.5 * sum(ends) for ends in (task.floor_friction, task.mass_kg))
    models = []
    for friction in frictions:
        model = mujoco.MjModel.from_xml_string(text)
        set_truth(mujoco, model, task, BoxTruth(torch.zeros(3), friction, floor, mass))
        models.append(model)
    drives, posture = ("x", "y", "z", "yaw", "left", "right"), (0.0, 0.0, 0.0, 0.0, task.finger_m, task.finger_m)
    return PathScene(tuple(models), frictions, "box", drives, (0, 1, 3), posture, task.speed, physics.time_step_s)
