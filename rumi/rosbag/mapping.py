"""The tables of a mapping: which topics and frames of a recording mean what (`scripts/docs/reference/mapping.md`)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.robot.gripper import GripperShape, gripper_links
from rumi.robot.tool_shape import SolidTool
from rumi.rosbag.sensor_maps import BubbleMap, RobotMap, Rod, TorqueMap, Vector, WrenchMap, check_rod, placed
from rumi.tasks.rummage.objects import OBJECTS, ObjectSettings
from sdf import se3, so3
from sdf.base import SDF
from sdf.bounds import Checked, Count, NotNegative, OneOf, Positive
from sdf.primitives import Box, Capsule, Placed

Role = Literal[
    "cloud",
    "depth",
    "color",
    "camera",
    "felt",
    "contact",
    "bubble",
    "wrench",
    "joints",
    "torques",
    "tf",
    "pose",
    "sensor",
]


@dataclass(frozen=True)
class Topic:
    """One topic.

    Attributes:
        role: "cloud" of a camera, "depth" image, "color" image, "camera" intrinsics, "felt" points on the object that a
            finger felt, "contact" flags, "bubble": the depth image of a soft bubble's membrane from inside, "wrench",
            "joints", "torques": joints whose efforts are measured torques, "tf" (which /tf and /tf_static are by
            themselves), "pose" of a frame, of a tracker or a tool, or "sensor": the numbers of a further sensor.
        frame: in place of the messages' frame_id.
        child: of the role pose: name of the frame whose pose it is; a TransformStamped and an Odometry name one.
        camera: topic of a depth image's CameraInfo; of a bubble's too.
        color: topic of the colour images that are of a depth image's pixels; needed where several could be.
        unit_m: metres that one unit of a depth image is; by default 0.001 for whole numbers and 1 for floating ones.
        rectified: the lens's distortion has been taken out of a depth image (or a bubble's) already.
        sensor: name of the further sensor, by which its evidence finds the numbers (`Reading.measurements`).
    """

    role: Role
    frame: str | None = None
    child: str | None = None
    camera: str | None = None
    color: str | None = None
    unit_m: float | None = None
    rectified: bool = False
    sensor: str | None = None

    def __post_init__(self) -> None:
        if (self.role == "sensor") != (self.sensor is not None):
            raise ValueError(f"expected sensor, a name, with the role sensor alone, got {self.role} and {self.sensor}")
        if self.child is not None and self.role != "pose":
            raise ValueError(f"expected child, a frame, with the role pose alone, got {self.role} and {self.child}")


@dataclass(frozen=True)
class Fixed:
    """A fixed transform that the recording lacks, or has wrong: a calibration; it takes the place of recorded ones.

    Attributes:
        parent, child: frames.
        position_m: of the child's origin in the parent.
        rpy_deg: roll, pitch and yaw of the child about the parent's x, y and z, in this order.
        quaternion_wxyz: in place of rpy_deg.
    """

    parent: str
    child: str
    position_m: Vector = (0.0, 0.0, 0.0)
    rpy_deg: Vector = (0.0, 0.0, 0.0)
    quaternion_wxyz: tuple[float, float, float, float] | None = None

    def pose(self) -> Float[Tensor, "4 4"]:
        """parent_T_child, float64."""
        if self.quaternion_wxyz is not None:
            return pose_of(self.position_m, self.quaternion_wxyz)
        return placed(self.position_m, self.rpy_deg)


@dataclass(frozen=True)
class Frames:
    """Frames of the recording.

    Attributes:
        world: z up; the belief lives in it.
        tool: of the gripper: between its pads, x forward, z up when it is level.
        floor_z_m: height in `world` of what the object stands on; the belief's own frame has it at 0.
        origin_m: x and y in `world` at which the belief's own frame has its origin; taken off in float64, so that a
            map's frame may be kilometres away.
        longest_gap_s: a frame's pose is interpolated over gaps up to this.
        motion: frame that rides with the object, of a tracker: it measures how the object moved.
        truth: frame that is the object's own, measured by another system: what comes of a replay is judged by it, and
            the belief does not see it.
    """

    world: str
    tool: str
    floor_z_m: float = 0.0
    origin_m: tuple[float, float] = (0.0, 0.0)
    longest_gap_s: float = 0.5
    motion: str | None = None
    truth: str | None = None


@dataclass(frozen=True)
class SceneMap(Checked):
    """Prior knowledge of the object's place; metres in the belief's frame: the world with its floor and origin at 0.

    Attributes:
        builtin: name of one of rumi's objects ("mug", "box", "drill"), where [object] names no mesh.
        search: freedom of the pose.
        within: lower and upper corner of a box that holds the object.
        looks_again: whether views after the first one are used: the camera must not see the robot as the object.
        tool_seen: the camera sees the gripper: what is near its shape is left out of views.
        prior_mean_m, prior_spread_m: x and y that the object's origin is known to be about, and the standard deviation
            along each: where no camera sees it.
        prior_yaw_deg, prior_yaw_spread_deg: the same of its yaw; without it any yaw.
        clear_m: the tool's body is known to be free but for what is this near to a felt point.
    """

    within: tuple[Vector, Vector]
    builtin: Annotated[str, OneOf(OBJECTS)] | None = None
    search: Literal["SE(2)", "SE(3)"] = "SE(2)"
    looks_again: bool = False
    tool_seen: bool = False
    prior_mean_m: tuple[float, float] | None = None
    prior_spread_m: float = 0.05
    prior_yaw_deg: float | None = None
    prior_yaw_spread_deg: Positive = 5.0
    clear_m: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(low < high for low, high in zip(*self.within, strict=True)):
            raise ValueError(f"expected within to be a lower and an upper corner, got {self.within}")
        if self.prior_yaw_deg is not None and self.prior_mean_m is None:
            raise ValueError("expected prior_mean_m, the object's place, with prior_yaw_deg, got none")


@dataclass(frozen=True)
class ToolMap(Checked):
    """The tool's shape: a gripper, or a round rod or a mesh in its place, which feels all over or within a box.

    Attributes:
        palm_m, palm_front_m, pad_m, pad_offset_m: of `rumi.robot.gripper.GripperShape`.
        rod_m: both ends of a rod's axis, in the tool's frame.
        radius_m: of the rod.
        mesh: file of the tool's mesh.
        scale: metres that one unit of the file is.
        position_m, rpy_deg: of the mesh's frame in the tool's.
        feels_m: lower and upper corner of that box, tool frame.
        off_m: standard deviation, along each axis, of where the tool is against the frame in which the object's first
            place and truth are told, the same all the time: of an arm against a tracker that are not well registered.
    """

    palm_m: Vector = (0.09, 0.10, 0.04)
    palm_front_m: float = -0.025
    pad_m: Vector = (0.035, 0.018, 0.022)
    pad_offset_m: float = 0.024
    rod_m: Rod | None = None
    radius_m: Positive | None = None
    mesh: str | None = None
    scale: float = 1.0
    position_m: Vector = (0.0, 0.0, 0.0)
    rpy_deg: Vector = (0.0, 0.0, 0.0)
    feels_m: tuple[Vector, Vector] | None = None
    off_m: NotNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rod(self.radius_m, self.rod_m)
        if self.radius_m is not None and (self.rod_m is None or self.mesh is not None):
            raise ValueError("expected radius_m with rod_m, the ends of a rod's axis, and without mesh")

    def shape(self) -> GripperShape | SolidTool:
        """The tool.

        Raises:
            UsageError: the mesh cannot be used.
        """
        feels: SDF | None = None
        if self.feels_m is not None:
            low, high = torch.tensor(self.feels_m)
            feels = Placed(Box((0.5 * (high - low)).tolist()), se3.make(torch.eye(3), 0.5 * (low + high)))
        if self.rod_m is not None and self.radius_m is not None:
            return SolidTool([Capsule(*self.rod_m, self.radius_m)], feels)
        if self.mesh is None:
            return GripperShape(self.palm_m, self.palm_front_m, self.pad_m, self.pad_offset_m)
        return SolidTool.of_mesh(
            self.mesh, scale=self.scale, tool_T_mesh=placed(self.position_m, self.rpy_deg), feels=feels
        )

    def links(self) -> tuple[SDF, ...]:
        """Its solids, in the tool frame."""
        shape = self.shape()
        return gripper_links(shape) if isinstance(shape, GripperShape) else (shape.body,)


@dataclass(frozen=True)
class ViewMap:
    """Settings of clouds and depth images: see `sensors.vision.view.ViewSettings`."""

    segmentation: Literal["color", "plane"] = "plane"
    hue_deg: tuple[float, float] = (0.0, 360.0)
    saturation: tuple[float, float] = (0.25, 1.0)
    value: tuple[float, float] = (0.15, 1.0)
    clearance_m: float = 0.010
    plane_tolerance_m: float = 0.006
    near_m: float = 0.0
    far_m: float = math.inf
    persist_s: float = 0.0
    persist_gap_s: float = 0.1


@dataclass(frozen=True)
class Actions(Checked):
    """Division of a recording into readings.

    Attributes:
        view_s: seconds from the start within which the first view is taken, while nothing moves.
        every_s: seconds of one reading.
        instants: of a reading, evenly spread, the last one at its end.
    """

    view_s: NotNegative = 0.5
    every_s: Positive = 1.0
    instants: Count = 10


@dataclass(frozen=True)
class BagMap:
    """All that a mapping file says.

    Attributes:
        topics: by name, or by a pattern of names as of a shell's files, whose first that fits counts.
        frames: of world and tool.
        scene: what is known of the object's place.
        fixed: transforms.
        object: a mesh, as the flags of `rumi run` give it.
        tool: its shape.
        view: how a camera is read.
        bubble: how soft bubbles are read.
        wrench: how wrenches are read; None where there are none.
        robot: its model; None where nothing needs it.
        torques: how joint torques are read; None where there are none.
        actions: how the recording is cut.
        settings: of the run, by name, as in a run's settings.json.
        text: the file itself.
    """

    topics: dict[str, Topic]
    frames: Frames
    scene: SceneMap
    fixed: tuple[Fixed, ...] = ()
    object: ObjectSettings = field(default_factory=ObjectSettings)
    tool: ToolMap = field(default_factory=ToolMap)
    view: ViewMap = field(default_factory=ViewMap)
    bubble: BubbleMap = field(default_factory=BubbleMap)
    wrench: WrenchMap | None = None
    robot: RobotMap | None = None
    torques: TorqueMap | None = None
    actions: Actions = field(default_factory=Actions)
    settings: dict[str, Any] = field(default_factory=dict)
    text: str = ""

    def topic(self, name: str) -> Topic | None:
        """What a topic means; None where the mapping does not say."""
        if name in self.topics:
            return self.topics[name]
        return next((topic for pattern, topic in self.topics.items() if fnmatchcase(name, pattern)), None)

    @property
    def touches_count(self) -> bool:
        """Whether wrenches' touches count with their normals, by how sure both are."""
        return self.wrench is not None and self.wrench.likelihood

    @property
    def signals_count(self) -> bool:
        """Whether joint torques' signals count as touches of some point of the gripper."""
        return self.torques is not None and self.torques.likelihood


def pose_of(position: Sequence[float], quaternion_wxyz: Sequence[float]) -> Float[Tensor, "4 4"]:
    """A transform (4, 4), float64, of a position and a quaternion, which is normalised.

    Raises:
        ValueError: the quaternion is of no rotation.
    """
    numbers = torch.tensor([*position, *quaternion_wxyz], dtype=torch.float64)
    length = float(numbers[3:].norm())
    if not (bool(torch.isfinite(numbers).all()) and abs(length - 1.0) < 0.1):
        raise ValueError(f"expected a position and a unit quaternion, got {numbers.tolist()}")
    return se3.make(so3.from_wxyz(numbers[3:]), numbers[:3])
