"""Serial arm that carries the tool in simulation: its MJCF or URDF, where it stands, and its joints' limits."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.arm import Arm
from rumi.robot.gripper import GripperShape
from rumi.robot.mjcf import urdf_of_mjcf
from rumi.robot.reach_table import STARTS
from rumi.robot.robot_file import read_robot
from rumi.sim.arm_scene import ARM_JOINTS, ArmPhysics, links_xml
from rumi.sim.scene import FLOOR, SHELL, UNSEEN_GROUP, quaternion
from rumi.sim.world import _import_mujoco
from sdf import se3, so3

_FRICTION = 0.005, 0.0001  # torsional and rolling, m
_PREFIX = "arm/"  # of the arm's names in a scene
_ARMATURE = 0.1  # kg m^2, of joints whose file says nothing of their motors
_HELD = 24  # ways of holding the arm that a search begins with, where none are known


@dataclass(frozen=True)
class RobotArm:
    """A serial arm under torque control, and the tool's mount on it.

    Attributes:
        text: MJCF or URDF of the arm alone.
        tip: body that carries the tool.
        joints: names of the joints from the root to the tip, J of them; others are held.
        low: (J), lower limits, rad, or metres of a slide; infinite where there is none.
        high: (J), upper limits.
        torques: (J), largest torques of the motors, N m, or N of a slide.
        world_T_root: (4, 4), where the arm stands.
        tip_T_tool: (4, 4), the tool frame (x forward, z up when level) in the tip's.
        starts: (S, J), joints from which inverse kinematics begins, turned about the first by where the goal is.
        kinematics: of the arm from its root.
        end_T_tool: (4, 4), the tool frame in that at the end of `kinematics`.
        folder: where files that the text names are looked for.
    """

    text: str
    tip: str
    joints: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    torques: np.ndarray
    world_T_root: Float[Tensor, "4 4"]
    tip_T_tool: Float[Tensor, "4 4"]
    starts: np.ndarray
    kinematics: Arm
    end_T_tool: Float[Tensor, "4 4"]
    folder: Path | None = None

    @classmethod
    def standard(cls, base: tuple[float, float, float], below_m: float = 0.0) -> Self:
        """The arm that the tasks' reach is of, at (x, y, yaw), its base so far below the floor."""
        physics = ArmPhysics(base=(0.0, 0.0, 0.0))
        shape = physics.geometry
        half = 0.5 * (-0.5 * math.pi - shape.tool_pitch_rad)
        text = f"<mujoco><worldbody>{links_xml(physics)}</worldbody></mujoco>"
        high = np.array(shape.limits_rad)
        mount = _transform((0.0, 0.0, shape.flange_m + shape.tool_m), (math.cos(half), 0.0, math.sin(half), 0.0))
        root = se3.from_planar(torch.tensor(base, dtype=torch.float64), -below_m)
        return cls(
            text, f"link_{len(ARM_JOINTS)}", ARM_JOINTS, -high, high, np.array(physics.torques_nm), root, mount,
            np.array(STARTS), Arm(shape.urdf()), torch.eye(4, dtype=torch.float64),
        )  # fmt: skip

    @classmethod
    def load(
        cls,
        robot: str | Path,
        tip: str,
        *,
        base: tuple[float, float, float] | Float[Tensor, "4 4"] = (0.0, 0.0, 0.0),
        tip_T_tool: Float[Tensor, "4 4"] | None = None,
    ) -> Self:
        """Any arm, from a file of MJCF or URDF or from its text; the arguments are those of `rumi.ArmReach.of_urdf`.

        Limits are the file's; torques those of its motors (MJCF) or efforts (URDF).

        Raises:
            UsageError: it cannot be read, has no such tip, or a joint on the way to it has no largest torque.
        """
        text, folder = read_robot(robot)
        spec = _spec(text, folder)
        model = _compiled(spec, folder)
        joints = _chain(model, tip)
        rows = [int(model.joint(name).id) for name in joints]
        limited = np.asarray(model.jnt_limited)[rows].astype(bool)
        ranges = np.where(limited[:, None], np.asarray(model.jnt_range)[rows], (-math.inf, math.inf))
        pose = base if isinstance(base, Tensor) else se3.from_planar(torch.tensor(base, dtype=torch.float64))
        if pose.shape != (4, 4):
            raise UsageError(f"Expected base to be (x, y, yaw) or world_T_root (4, 4), got {tuple(pose.shape)}")
        mount = torch.eye(4, dtype=torch.float64) if tip_T_tool is None else tip_T_tool.double()
        low, high = ranges[:, 0], ranges[:, 1]
        kinematics = Arm(text, tip) if "<robot" in text else Arm(urdf_of_mjcf(robot, tip), "tip")
        if kinematics.joints != joints:
            raise UsageError(f"Expected every joint up to {tip!r} to have a name, got {', '.join(kinematics.joints)}")
        torques, starts = _torques(model, joints), _starts(low, high)
        return cls(text, tip, joints, low, high, torques, pose.double(), mount, starts, kinematics, mount, folder)

    def alone(self, gripper: GripperShape) -> Any:  # noqa: ANN401  (of MuJoCo)
        """The arm with its tool and nothing else as a MuJoCo model, for a controller."""
        spec = _import_mujoco().MjSpec()
        self.attach(spec, gripper)
        return spec.compile()

    def attach(self, scene: Any, gripper: GripperShape, friction: float = 0.5) -> None:  # noqa: ANN401  (of MuJoCo)
        """Put the arm into a scene, with the gripper as body `gripper` on it, a site `tool`, and a motor a joint.

        Links meet the floor and the object, not each other, and hide nothing from rays.

        Args:
            scene: MuJoCo's specification of the scene.
            gripper: the tool.
            friction: sliding friction of the links and the tool.
        """
        mujoco, arm = _import_mujoco(), _spec(self.text, self.folder)
        for actuator in list(arm.actuators):
            arm.delete(actuator)
        for joint in list(arm.joints):
            if joint.name not in self.joints:
                arm.delete(joint)
            elif joint.armature == 0.0:
                joint.armature = _ARMATURE
        first = self._within_base(arm)
        for geom in arm.geoms:
            touches = bool(geom.contype or geom.conaffinity)
            # what stands about the first joint may go through a shelf, which the floor is then
            floor = 0 if geom.parent.name in first else FLOOR
            geom.contype, geom.conaffinity = 0, (SHELL | floor) if touches else 0
            geom.group, geom.condim, geom.friction = UNSEEN_GROUP, 4, (friction, *_FRICTION)
        scene.attach(arm, frame=scene.worldbody.add_frame(**_place(self.world_T_root)), prefix=_PREFIX)
        hand = scene.body(_PREFIX + self.tip).add_body(name="gripper", **_place(self.tip_T_tool))
        hand.add_site(name="tool")
        kind = {"mass": 0.1, "contype": 0, "conaffinity": SHELL, "solref": (0.01, 1.0), "condim": 4}
        kind["friction"] = (friction, *_FRICTION)
        palm = [0.5 * side for side in gripper.palm_m]
        box, ellipsoid = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID
        hand.add_geom(type=box, size=palm, pos=(gripper.palm_center_m, 0.0, 0.0), **kind)
        for center in gripper.pad_centers:
            hand.add_geom(type=ellipsoid, size=gripper.pad_m, pos=center, **kind)
        for name, limit in zip(self.names, self.torques.tolist(), strict=True):
            motor = scene.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.ctrlrange, motor.ctrllimited = (-limit, limit), True

    @property
    def names(self) -> tuple[str, ...]:
        """The joints' names in a scene."""
        return tuple(_PREFIX + name for name in self.joints)

    def _within_base(self, arm: Any) -> set[str]:  # noqa: ANN401  (of MuJoCo)
        """Bodies up to the one that the second joint moves."""
        found, bodies = set(), [body for body in arm.bodies if body.name != "world"]
        second = self.joints[min(1, len(self.joints) - 1)]
        for body in bodies:
            found.add(body.name)
            if any(joint.name == second for joint in body.joints):
                break
        return found


def _spec(text: str, folder: Path | None) -> Any:  # noqa: ANN401  (of MuJoCo)
    """MuJoCo's specification of MJCF or URDF text; of a URDF links on fixed joints stay bodies of their own."""
    mujoco = _import_mujoco()
    try:
        if "<robot" in text:
            root = ElementTree.fromstring(text)
            extension = root.find("mujoco")
            extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
            compiler = extension.find("compiler")
            compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
            compiler.set("fusestatic", "false")
            text = ElementTree.tostring(root, encoding="unicode")
        spec = mujoco.MjSpec.from_string(text)
    except (ValueError, ElementTree.ParseError) as error:
        raise UsageError(f"Expected MJCF or URDF that MuJoCo can read: {error}") from error
    if folder is not None:
        spec.modelfiledir = str(folder)
    return spec


def _compiled(spec: Any, folder: Path | None) -> Any:  # noqa: ANN401  (of MuJoCo)
    try:
        return spec.compile()
    except ValueError as error:
        where = "" if folder is None else f" (its meshes are looked for from {folder})"
        raise UsageError(f"Expected MJCF or URDF that MuJoCo can read{where}: {error}") from error


def _chain(model: Any, tip: str) -> tuple[str, ...]:  # noqa: ANN401  (of MuJoCo)
    """Names of the joints from the root to the tip."""
    names = [model.body(index).name for index in range(1, model.nbody)]
    if tip not in names:
        raise UsageError(f"There is no body {tip!r} in the robot; its bodies are {', '.join(names) or 'none'}")
    mujoco = _import_mujoco()
    simple = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    found: list[str] = []
    at = int(model.body(tip).id)
    while at > 0:
        first, count = int(model.body_jntadr[at]), int(model.body_jntnum[at])
        for index in reversed(range(first, first + count)):
            if int(model.jnt_type[index]) not in simple:
                raise UsageError(
                    f"Expected an arm with a fixed base of hinges and slides, got another kind of joint, "
                    f"{model.joint(index).name!r}"
                )
            found.append(str(model.joint(index).name))
        at = int(model.body_parentid[at])
    if not found:
        raise UsageError(f"Expected joints that move between the robot's root and {tip!r}, got none")
    return tuple(reversed(found))


def _torques(model: Any, joints: tuple[str, ...]) -> np.ndarray:  # noqa: ANN401  (of MuJoCo)
    """Largest torque of each joint's motor."""
    found = []
    for name in joints:
        joint = int(model.joint(name).id)
        limits = []
        if bool(model.jnt_actfrclimited[joint]):
            limits.append(float(np.abs(model.jnt_actfrcrange[joint]).max()))
        for index in range(model.nu):
            if int(model.actuator_trnid[index, 0]) == joint and bool(model.actuator_forcelimited[index]):
                limits.append(float(np.abs(model.actuator_forcerange[index]).max()))
        if not limits or not min(limits) > 0:
            raise UsageError(
                f"Expected a largest torque of the joint {name!r}, got none: give it an effort (URDF), or an "
                "actuatorfrcrange or an actuator with a forcerange (MJCF)"
            )
        found.append(min(limits))
    return np.array(found)


def _starts(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Ways of holding an arm that nothing is known of, spread over its joints' range (Sobol)."""
    low, high = np.maximum(low, -math.pi), np.minimum(high, math.pi)
    share = torch.quasirandom.SobolEngine(len(low), scramble=False).draw(_HELD + 1)[1:].double().numpy()
    # the middle first: an arm that is bent by half is far from its limits
    return np.concatenate((0.5 * (low + high)[None], low + (0.15 + 0.7 * share) * (high - low)))


def _transform(place: tuple[float, ...], turn: tuple[float, ...]) -> Float[Tensor, "4 4"]:
    return se3.make(so3.from_wxyz(torch.tensor(turn, dtype=torch.float64)), torch.tensor(place, dtype=torch.float64))


def _place(pose: Float[Tensor, "4 4"]) -> dict[str, list[float]]:
    return {"pos": pose[:3, 3].tolist(), "quat": quaternion(pose).tolist()}
