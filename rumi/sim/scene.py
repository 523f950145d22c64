"""MuJoCo scene: a floor, an object that stands free on it, and a gripper that flies at one height or at any."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.robot.gripper import GripperShape, gripper_xml
from rumi.sim.bodies import Body, Piece
from rumi.sim.settings import PhysicsSettings
from sdf import so3
from sdf.mesh.mesh import TriangleMesh

# who collides with whom: the floor with what it bears of the object, the gripper with what it pushes
FLOOR, SHELL = 1, 2
RAY_GROUPS = (1, 1, 1, 0, 0, 0)
"""Which groups of geoms rays meet."""
UNSEEN_GROUP = 3


def scene_model(
    mujoco: Any,  # noqa: ANN401  (a module without types)
    body: Body,
    gripper: GripperShape,
    height_m: float | None,
    time_step_s: float,
    physics: PhysicsSettings,
) -> Any:  # noqa: ANN401
    """The scene with a gripper that flies as a MuJoCo model.

    Bodies `object` (a free joint) and `gripper` (slides x and y, in space z, then a hinge about z, each with a position
    servo of the same name). Driven joints rather than a mocap body, whose tangential motion friction would not see.

    Args:
        mujoco: the module.
        body: the object.
        gripper: the gripper's shape.
        height_m: height of the tool frame; None for a gripper that moves in space.
        time_step_s: of the physics.
        physics: masses, friction, drive.
    """
    drive = _drive_xml(physics, spatial=height_m is None)
    return compiled(
        scene_spec(mujoco, body, time_step_s, physics, _gripper_xml(gripper, height_m, physics), drive), physics
    )


def compiled(spec: Any, physics: PhysicsSettings) -> Any:  # noqa: ANN401
    """A scene's specification as a model, the object's centre of mass where the settings have it."""
    model = spec.compile()
    return _off_centre(spec, model, physics.com_m) if any(physics.com_m) else model


def _off_centre(spec: Any, model: Any, com_m: tuple[float, float, float]) -> Any:  # noqa: ANN401
    """The model compiled once more, with the object's centre of mass elsewhere and its inertia about that the same."""
    own, body = spec.body("object"), model.body("object")
    own.explicitinertial = True
    own.mass, own.inertia, own.iquat = float(body.mass[0]), body.inertia.copy(), body.iquat.copy()
    own.ipos = body.ipos + com_m
    own.fullinertia = np.full(6, np.nan)  # given in place of the above where the solid is summed up
    return spec.compile()


def scene_spec(
    mujoco: Any,  # noqa: ANN401
    body: Body,
    time_step_s: float,
    physics: PhysicsSettings,
    robot: str = "",
    actuators: str = "",
) -> Any:  # noqa: ANN401
    """MuJoCo's specification of the floor, the object as body `object`, and the robot and its actuators in MJCF."""
    spec = mujoco.MjSpec.from_string(_scene_xml(body, time_step_s, physics, robot, actuators))
    for name, mesh in _meshes(body):
        added = spec.add_mesh(
            name=name, uservert=mesh.vertices.reshape(-1).tolist(), userface=mesh.faces.reshape(-1).tolist()
        )
        # that of the body is given; the engine's own sums refuse surfaces that are not quite closed
        added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return spec


def _scene_xml(body: Body, time_step_s: float, physics: PhysicsSettings, robot: str, actuators: str) -> str:
    """As MJCF text; meshes are named in it."""
    return f"""
<mujoco>
  <option timestep="{time_step_s}" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default><geom condim="4" friction="{physics.friction} 0.005 0.0001"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 0.1" contype="{FLOOR}" conaffinity="0"/>
    <body name="object">
      <freejoint name="object"/>
      {object_xml(body, physics)}
    </body>
    {robot}
  </worldbody>
  {actuators}
</mujoco>"""


def _meshes(body: Body) -> list[tuple[str, TriangleMesh]]:
    return [(f"mesh{index}", part.mesh) for index, part in enumerate(body.pieces) if part.mesh is not None]


def object_xml(body: Body, physics: PhysicsSettings) -> str:
    """The geoms of the object's pieces, with its mass and friction, as MJCF text."""
    lines = []
    if body.solid is not None:
        mass, inertia = physics.mass_kg, physics.mass_kg * body.solid.inertia
        place = " ".join(f"{x:.9g}" for x in body.solid.center.tolist())
        entries = " ".join(f"{float(inertia[i, j]):.9g}" for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        lines.append(f'<inertial pos="{place}" mass="{mass:.9g}" fullinertia="{entries}"/>')
    total = sum(part.volume or 0.0 for part in body.pieces)
    for index, part in enumerate(body.pieces):
        mass = 0.0 if body.solid is not None else physics.mass_kg * (part.volume or 0.0) / total
        lines.append(_framed(part, _geom(index, part, mass)))
    return "\n      ".join(lines)


def _geom(index: int, part: Piece, mass: float) -> str:
    shape = part.xml if part.mesh is None else f'type="mesh" mesh="mesh{index}"'
    group = "" if part.seen else f' group="{UNSEEN_GROUP}"'
    kind = f'contype="{SHELL if part.gripper else 0}" conaffinity="{FLOOR if part.floor else 0}"'
    return f'<geom {shape} mass="{mass:.9g}" {kind}{group}/>'


def _framed(part: Piece, geom: str) -> str:
    if part.object_T_piece is None:
        return geom
    pose = part.object_T_piece.double()
    place, turn = (" ".join(f"{x:.12g}" for x in row) for row in (pose[:3, 3].tolist(), quaternion(pose).tolist()))
    return f'<frame pos="{place}" quat="{turn}">{geom}</frame>'


def _gripper_xml(gripper: GripperShape, height_m: float | None, physics: PhysicsSettings) -> str:
    kind = f'mass="0.1" contype="0" conaffinity="{SHELL}" solref="0.01 1"'
    rise = f'\n      <joint name="z" type="slide" axis="0 0 1" armature="{physics.gripper_mass_kg}"/>'
    return f"""<body name="gripper" pos="0 0 {height_m or 0.0:.9g}" gravcomp="1">
      <joint name="x" type="slide" axis="1 0 0" armature="{physics.gripper_mass_kg}"/>
      <joint name="y" type="slide" axis="0 1 0" armature="{physics.gripper_mass_kg}"/>{rise * (height_m is None)}
      <joint name="yaw" type="hinge" axis="0 0 1" armature="{physics.gripper_inertia}"/>
      {gripper_xml(gripper, kind)}
    </body>"""


def _drive_xml(physics: PhysicsSettings, *, spatial: bool) -> str:
    square = (2.0 * math.pi * physics.bandwidth_hz) ** 2
    axes = (
        ("x", physics.gripper_mass_kg, physics.max_force_n),
        ("y", physics.gripper_mass_kg, physics.max_force_n),
        *((("z", physics.gripper_mass_kg, physics.max_lift_n),) * spatial),
        ("yaw", physics.gripper_inertia, physics.max_torque_nm),
    )
    servos = "".join(
        f'<position name="{name}" joint="{name}" kp="{square * inertia:.9g}" dampratio="1" '
        f'forcerange="{-limit} {limit}"/>'
        for name, inertia, limit in axes
    )
    return f"<actuator>{servos}</actuator>"


def quaternion(pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4"]:
    """w, x, y, z of a pose's rotation."""
    turn = so3.log(pose[:3, :3])
    half = 0.5 * turn.norm()
    return torch.cat((half.cos()[None], turn * 0.5 * torch.sinc(half / math.pi)))
