"""MuJoCo scene of the arm under torque control: links with mass, motors, two fingers, and a box on the floor."""

import math
from dataclasses import dataclass, field

from rumi.errors import UsageError
from rumi.robot.arm import ArmGeometry

ARM_JOINTS = tuple(f"joint_{index + 1}" for index in range(7))
FINGERS = ("left", "right")


@dataclass(frozen=True)
class ArmPhysics:
    """Physical parameters of the arm.

    Attributes:
        geometry: lengths, axes and limits; its bent tool is left out, the hand points down.
        base: (x, y, yaw) of the base.
        masses_kg: of the links, the hand in the last.
        radii_m: of the links.
        armature: inertia of the motors as the joints feel it, kg m^2.
        torques_nm: of the motors, at most.
        hand_m: from the flange to the tool frame's origin, which is below the finger tips: where the floor is when the
            arm pokes.
        tip_m: height of the finger tips above that.
        finger_m: radius of a finger.
        grip_n: force of a finger, at most.
        time_step_s: of the physics, of control and of the torque sensors.
        contact_s: time constant of contacts (MuJoCo's solref).
    """

    geometry: ArmGeometry = field(default_factory=ArmGeometry)
    base: tuple[float, float, float] = (-0.1, 0.0, 0.0)
    masses_kg: tuple[float, ...] = (3.5, 3.5, 4.0, 3.5, 2.2, 2.3, 1.2)
    radii_m: tuple[float, ...] = (0.06, 0.06, 0.055, 0.055, 0.05, 0.05, 0.04)
    armature: tuple[float, ...] = (0.15, 0.15, 0.15, 0.15, 0.1, 0.1, 0.1)
    torques_nm: tuple[float, ...] = (176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0)
    hand_m: float = 0.17
    tip_m: float = 0.01
    finger_m: float = 0.01
    grip_n: float = 40.0
    time_step_s: float = 0.001
    contact_s: float = 0.002

    def __post_init__(self) -> None:
        """Refuse an arm with another number of links."""
        for name in ("masses_kg", "radii_m", "armature", "torques_nm"):
            if len(getattr(self, name)) != len(ARM_JOINTS):
                raise UsageError(f"Expected {name} to be {len(ARM_JOINTS)} numbers, got {len(getattr(self, name))}")


def arm_xml(physics: ArmPhysics, *, mass_factors: tuple[float, ...] = (1.0,) * 7) -> str:
    """The arm alone as MJCF text, for a controller and an observer.

    Args:
        physics: the arm.
        mass_factors: of the links' masses: what a model has wrong.
    """
    return _document(physics, links_xml(physics, mass_factors, 0.0, _hand(physics)), "")


def scene_xml(physics: ArmPhysics, half: tuple[float, float], height_m: float, friction_nm: float = 0.0) -> str:
    """The arm and a box (half its footprint, its height) on a floor as MJCF text.

    Bodies `box` (a free joint of that name) and `left` and `right` (fingers, slides); contact pairs `floor`, `left` and
    `right` with the box. Links and palm are above the box and touch nothing.
    """
    size = f"{half[0]} {half[1]} {0.5 * height_m}"
    friction = 'friction="0.4 0.4 0.002 0.0001 0.0001"'
    contact = f'{friction} solref="{physics.contact_s} 1" solimp="0.99 0.999 0.0005" condim="4"'
    world = f"""<geom name="floor" type="plane" size="3 3 0.1" contype="0" conaffinity="0"/>
    <body name="box" pos="0 0 {0.5 * height_m}"><freejoint name="box"/>
      <geom name="box" type="box" size="{size}" mass="0.5" contype="0" conaffinity="0"/></body>
    {links_xml(physics, friction_nm=friction_nm, tool=_hand(physics))}"""
    pairs = "".join(f'<pair name="{name}" geom1="{name}" geom2="box" {contact}/>' for name in ("floor", *FINGERS))
    return _document(physics, world, f"<contact>{pairs}</contact>")


def _document(physics: ArmPhysics, world: str, contact: str) -> str:
    # reported torques are those that act with an explicit integrator alone
    motors = "".join(
        f'<motor name="{name}" joint="{name}" ctrlrange="{-limit} {limit}" ctrllimited="true"/>'
        for name, limit in zip(ARM_JOINTS, physics.torques_nm, strict=True)
    )
    grips = "".join(
        f'<motor name="{name}" joint="{name}" ctrlrange="{-physics.grip_n} {physics.grip_n}" ctrllimited="true"/>'
        for name in FINGERS
    )
    return f"""<mujoco>
  <option timestep="{physics.time_step_s}" integrator="Euler" cone="elliptic" impratio="100"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    {world}
  </worldbody>
  {contact}
  <actuator>{motors}{grips}</actuator>
</mujoco>"""


def links_xml(
    physics: ArmPhysics, mass_factors: tuple[float, ...] = (1.0,) * 7, friction_nm: float = 0.0, tool: str = ""
) -> str:
    """Base and links of the arm as an MJCF body, with joints of the names `ARM_JOINTS`.

    Args:
        physics: the arm.
        mass_factors: of the links' masses.
        friction_nm: dry friction of every joint.
        tool: MJCF of what the last link carries.
    """
    own, shape = physics, physics.geometry
    x, y, yaw = own.base
    lengths = (*shape.offsets_m[1:], shape.flange_m)
    text = f'<body name="base" pos="{x} {y} 0" quat="{math.cos(0.5 * yaw)} 0 0 {math.sin(0.5 * yaw)}">'
    for index, name in enumerate(ARM_JOINTS):
        mass = own.masses_kg[index] * mass_factors[index]
        loss = f' frictionloss="{friction_nm}"' if friction_nm > 0 else ""
        text += (
            f'<body name="link_{index + 1}" pos="0 0 {shape.offsets_m[index]}">'
            f'<joint name="{name}" axis="{shape.axes[index]}" armature="{own.armature[index]}"{loss}/>'
            f'<geom type="capsule" size="{own.radii_m[index]}" fromto="0 0 0 0 0 {lengths[index]}" mass="{mass:.9g}"/>'
        )
    return text + tool + "</body>" * (len(ARM_JOINTS) + 1)


def _hand(physics: ArmPhysics) -> str:
    """In the tool frame, whose z is up where the flange points down."""
    r, top = physics.finger_m, physics.hand_m - 0.04
    shape = f'type="capsule" size="{r}" fromto="0 0 {physics.tip_m + r} 0 0 {top}" mass="0.05"'
    fingers = "".join(
        f'<body name="{name}"><joint name="{name}" type="slide" axis="0 {sign} 0" armature="0.5"/>'
        f'<geom name="{name}" {shape}/></body>'
        for name, sign in zip(FINGERS, (1, -1), strict=True)
    )
    return (
        f'<body name="tool" pos="0 0 {physics.geometry.flange_m + physics.hand_m}" quat="0 1 0 0">'
        f'<geom type="box" size="0.02 0.06 0.01" pos="0 0 {physics.hand_m - 0.02}" mass="0.3"/>'
        f'<site name="tool"/>{fingers}</body>'
    )
