"""The MuJoCo model: a floor, an object that stands free on it, and a gripper that flies at one height or at any."""

import math
from dataclasses import dataclass
from functools import singledispatch
from itertools import pairwise

from rumi.errors import UsageError
from rumi.planning.gripper import GripperShape
from sdf.base import SDF
from sdf.primitives import Mug

# who collides with whom: the floor with the object's base, the gripper with the rest of the object
_FLOOR, _SHELL = 1, 2


@dataclass(frozen=True)
class PhysicsSettings:
    """Masses, friction and the gripper's drive.

    Attributes:
        mass_kg: of the object.
        friction: sliding friction of everything.
        gripper_mass_kg: inertia of the drive along x and y.
        gripper_inertia: inertia of the drive about z, kg m^2.
        bandwidth_hz: of the critically damped position servos.
        max_force_n: of the drive along x and y.
        max_lift_n: of the drive along z, for a gripper that moves in space.
        max_torque_nm: of the drive about z.
        lead_m: by how much a command may be ahead of the measured position along an axis; infinite for any.
        wall_boxes: boxes that make up the wall of a cup.
        handle_capsules: capsules that make up its handle.
    """

    mass_kg: float = 0.35
    friction: float = 0.5
    gripper_mass_kg: float = 10.0
    gripper_inertia: float = 0.1
    bandwidth_hz: float = 20.0
    max_force_n: float = 200.0
    max_lift_n: float = 200.0
    max_torque_nm: float = 20.0
    lead_m: float = math.inf
    wall_boxes: int = 24
    handle_capsules: int = 12


@dataclass(frozen=True)
class Piece:
    """One geom of an object: its attributes as XML and its volume (m^3), by which the mass is shared out.

    It meets the gripper, unless it is `on_floor`: then it meets the floor alone. What `tips` meets both.
    """

    xml: str
    volume: float
    on_floor: bool = False
    tips: bool = False


def scene_xml(
    shape: SDF, gripper: GripperShape, height_m: float | None, time_step_s: float, physics: PhysicsSettings
) -> str:
    """The scene as MJCF text.

    Bodies `object` (a free joint) and `gripper` (slides x and y, in space z, then a hinge about z, each with a position
    servo of the same name). Driven joints rather than a mocap body, whose tangential motion friction would not see.

    Args:
        shape: the object's exact shape.
        gripper: the gripper's shape.
        height_m: height of the tool frame; None for a gripper that moves in space.
        time_step_s: of the physics.
        physics: masses, friction, drive.
    """
    return f"""
<mujoco>
  <option timestep="{time_step_s}" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default><geom condim="4" friction="{physics.friction} 0.005 0.0001"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 0.1" contype="{_FLOOR}" conaffinity="0"/>
    <body name="object">
      <freejoint name="object"/>
      {_object_xml(shape, physics)}
    </body>
    {_gripper_xml(gripper, height_m, physics)}
  </worldbody>
  {_drive_xml(physics, spatial=height_m is None)}
</mujoco>"""


def _object_xml(shape: SDF, physics: PhysicsSettings) -> str:
    parts = pieces(shape, physics)
    total = sum(part.volume for part in parts)
    lines = []
    for part in parts:
        # only the base meets the floor, which makes the contacts few and the steps quick
        kind = f'contype="0" conaffinity="{_FLOOR}"' if part.on_floor else f'contype="{_SHELL}" conaffinity="0"'
        if part.tips:
            kind = f'contype="{_SHELL}" conaffinity="{_FLOOR}"'
        lines.append(f'<geom {part.xml} mass="{physics.mass_kg * part.volume / total:.9g}" {kind}/>')
    return "\n      ".join(lines)


def _gripper_xml(gripper: GripperShape, height_m: float | None, physics: PhysicsSettings) -> str:
    palm = " ".join(f"{0.5 * side:.9g}" for side in gripper.palm_m)
    pad = " ".join(f"{side:.9g}" for side in gripper.pad_m)
    kind = f'mass="0.1" contype="0" conaffinity="{_SHELL}" solref="0.01 1"'
    pads = "\n      ".join(
        f'<geom type="ellipsoid" size="{pad}" pos="{x:.9g} {y:.9g} {z:.9g}" {kind}/>' for x, y, z in gripper.pad_centers
    )
    rise = f'\n      <joint name="z" type="slide" axis="0 0 1" armature="{physics.gripper_mass_kg}"/>'
    return f"""<body name="gripper" pos="0 0 {height_m or 0.0:.9g}" gravcomp="1">
      <joint name="x" type="slide" axis="1 0 0" armature="{physics.gripper_mass_kg}"/>
      <joint name="y" type="slide" axis="0 1 0" armature="{physics.gripper_mass_kg}"/>{rise * (height_m is None)}
      <joint name="yaw" type="hinge" axis="0 0 1" armature="{physics.gripper_inertia}"/>
      <geom type="box" size="{palm}" pos="{gripper.palm_center_m:.9g} 0 0" {kind}/>
      {pads}
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


@singledispatch
def pieces(shape: SDF, physics: PhysicsSettings) -> list[Piece]:
    """Geoms that collide as the shape does; one implementation a kind of shape."""
    known = ", ".join(sorted(kind.__name__ for kind in pieces.registry if kind not in (object, SDF)))
    raise UsageError(f"Expected a shape that the simulator can build ({known}), got {type(shape).__name__}")


@pieces.register
def _(shape: Mug, physics: PhysicsSettings) -> list[Piece]:
    count = physics.wall_boxes
    half = math.pi / count
    # the polygon's sides lie as far inside the circle as its corners lie outside, on average
    apothem = shape.outer_radius * (1.0 - half**2 / 6.0)
    middle, tall = apothem - 0.5 * shape.wall, 0.5 * (shape.height - shape.base)
    wide = apothem * math.tan(half)
    parts = [
        Piece(
            f'type="cylinder" size="{shape.outer_radius:.9g} {0.5 * shape.base:.9g}" pos="0 0 {0.5 * shape.base:.9g}"',
            math.pi * shape.outer_radius**2 * shape.base,
            on_floor=True,
        )
    ]
    for index in range(count):
        angle = 2.0 * index * half
        parts.append(
            Piece(
                f'type="box" size="{0.5 * shape.wall:.9g} {wide:.9g} {tall:.9g}" '
                f'pos="{middle * math.cos(angle):.9g} {middle * math.sin(angle):.9g} {shape.base + tall:.9g}" '
                f'euler="0 0 {math.degrees(angle):.9g}"',
                8.0 * 0.5 * shape.wall * wide * tall,
            )
        )
    angles = [shape.half_angle * (2.0 * i / physics.handle_capsules - 1.0) for i in range(physics.handle_capsules + 1)]
    nodes = [
        (shape.outer_radius + shape.ring_radius * math.cos(a), 0.5 * shape.height + shape.ring_radius * math.sin(a))
        for a in angles
    ]
    for (x0, z0), (x1, z1) in pairwise(nodes):
        parts.append(
            Piece(
                f'type="capsule" size="{shape.tube_radius:.9g}" fromto="{x0:.9g} 0 {z0:.9g} {x1:.9g} 0 {z1:.9g}"',
                math.pi * shape.tube_radius**2 * math.hypot(x1 - x0, z1 - z0),
            )
        )
    return parts
