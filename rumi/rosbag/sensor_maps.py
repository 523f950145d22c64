"""Tables of a mapping file for wrenches, bubbles, joint torques and the robot."""

import math
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.contact_evidence import SignalSettings
from rumi.errors import UsageError
from sdf import se3, so3
from sdf.bounds import Checked, Count, NotNegative, Positive, ShareBelow1
from sensors.force.tool_parts import rod_tool
from sensors.force.tool_surface import ConvexTool, SphereTool, ToolSurface
from sensors.touch.bubble import BubbleSettings

Vector = tuple[float, float, float]
Rod = tuple[Vector, Vector]


def placed(position_m: Vector, rpy_deg: Vector) -> Float[Tensor, "4 4"]:
    """A transform, float64: roll, pitch and yaw about the parent's x, y and z, in this order, and a position."""
    roll, pitch, yaw = (
        so3.exp(math.radians(angle) * torch.eye(3, dtype=torch.float64)[axis]) for axis, angle in enumerate(rpy_deg)
    )
    return se3.make(yaw @ pitch @ roll, torch.tensor(position_m, dtype=torch.float64))


def check_rod(radius_m: float | None, rod_m: Rod | None) -> None:
    """Check that a rod has a radius and two ends.

    Raises:
        ValueError: it has not.
    """
    if rod_m is not None and (radius_m is None or rod_m[0] == rod_m[1]):
        raise ValueError(f"expected rod_m, two ends of a rod's axis, with radius_m, got {rod_m} and {radius_m}")


@dataclass(frozen=True)
class WrenchMap(Checked):
    """The force-torque sensor's tool, a ball, a rod or a convex mesh, its load, and when a wrench is a touch.

    Attributes:
        radius_m: of a ball, or of a rod.
        rod_m: both ends of the rod's axis, in the sensor's frame.
        mesh: file of another tool's shape; its convex hull is taken.
        scale: metres of one unit of the mesh.
        center_m: of the ball, or the origin of the mesh, in the sensor's frame.
        rpy_deg: roll, pitch and yaw of the mesh about the sensor's x, y and z, in this order.
        bias: forces and moments without contact.
        mass_kg: of all that hangs from the sensor.
        mass_center_m: its centre of mass in the sensor's frame.
        tare_s: seconds at the start, without contact, from which the bias is taken anew; 0 to take it as given.
        tare_above_m: height of the tool's frame over the floor above which it touches nothing: where it gets there,
            the bias is the middle between what `tare_s` gives and the median of the wrenches from there. At the start
            a tool may lean on something, and high up the arm holds the sensor otherwise. None for no such height.
        smooth_s: seconds over which wrenches are averaged, half before and half after each: a tool in motion shakes,
            and what it pushes sticks and slips.
        level: touches of an upright rod are at the height of the tool's frame, on the side that the force comes from:
            where small moments, or those of a tool in motion, do not tell how high they are.
        reaction: the driver reports what the tool does to the world.
        force_n, moment_nm: standard deviations of the noise.
        least_force_n, friction: see `sensors.force.force_torque.WrenchSettings`.
        likelihood: touches count with their normals too, by how sure both are
            (`rumi.belief.contact_evidence.ContactPointEvidence`).
            Beside that a surface point weighs next to nothing; it is what the descent of poses follows.
        most: touches that count so of a reading: the surest in as many parts of them; others are of the same places.
        point_m: standard deviation of what moves a touched point beside the noise: the tool's shape, the arm's
            calibration, how the object moved since.
        normal_rad: the same of its normal.
        outlier: share of touches that tell nothing.
    """

    radius_m: Positive | None = None
    rod_m: Rod | None = None
    mesh: str | None = None
    scale: float = 1.0
    center_m: Vector = (0.0, 0.0, 0.0)
    rpy_deg: Vector = (0.0, 0.0, 0.0)
    bias: tuple[float, float, float, float, float, float] = (0.0,) * 6
    mass_kg: float = 0.0
    mass_center_m: Vector = (0.0, 0.0, 0.0)
    tare_s: float = 0.0
    tare_above_m: Positive | None = None
    smooth_s: NotNegative = 0.0
    level: bool = False
    reaction: bool = False
    force_n: float = 0.1
    moment_nm: float = 0.005
    least_force_n: float = 1.0
    friction: float = 0.6
    likelihood: bool = False
    most: Count = 3
    point_m: Positive = 0.003
    normal_rad: Positive = 0.3
    outlier: ShareBelow1 = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.radius_m is None) == (self.mesh is None):
            raise ValueError("expected either radius_m, of a ball or a rod, or mesh, a file of another tool's shape")
        check_rod(self.radius_m, self.rod_m)
        if self.level and (self.rod_m is None or self.likelihood):
            raise ValueError("expected level with rod_m, the ends of a rod's axis, and without likelihood")

    def tool(self) -> ToolSurface:
        """In the sensor's frame.

        Raises:
            UsageError: the mesh cannot be used.
        """
        if self.mesh is None:
            assert self.radius_m is not None
            if self.rod_m is not None:
                return rod_tool(*self.rod_m, self.radius_m)
            return SphereTool(torch.tensor(self.center_m), self.radius_m)
        from sdf.mesh.convex import hull
        from sdf.mesh.mesh import MeshError, load_mesh

        try:
            shape = hull(load_mesh(self.mesh, scale=self.scale))
        except (OSError, MeshError) as error:
            raise UsageError(f"Cannot use wrench.mesh: {error}") from error
        return ConvexTool.of(shape, placed(self.center_m, self.rpy_deg))


@dataclass(frozen=True)
class BubbleMap:
    """Soft bubbles (`sensors.touch.bubble.BubbleSettings`), at rest as in the mean picture of the first view.

    Attributes:
        contact_m, top, mean_px, still_m, free_stride_px, patch_stride_px: of the settings.
        late_s: by which a picture's stamp is later than what it shows.
    """

    contact_m: float = 0.004
    top: float = 0.1
    mean_px: int = 5
    still_m: float = 0.001
    free_stride_px: int = 4
    patch_stride_px: int = 1
    late_s: float = 0.0

    def __post_init__(self) -> None:
        self.settings()

    def settings(self) -> BubbleSettings:
        """For metres."""
        values = asdict(self)
        values.pop("late_s")
        return BubbleSettings(**values, unit="m")


@dataclass(frozen=True)
class RobotMap:
    """The robot's model, for its dynamics and its body.

    Attributes:
        file: URDF, or MJCF, of the robot alone with a fixed base.
        base: frame of the recording that the model's root stands at; the world's by default.
        remove: leave the robot out of what cameras saw, by the collision shapes of a URDF and the measured joints.
        margin_m: what is this near to those shapes is the robot.
        packages: folders of the packages that a URDF's meshes lie in, each of its package's name.
    """

    file: str
    base: str | None = None
    remove: bool = False
    margin_m: float = 0.01
    packages: tuple[str, ...] = ()


@dataclass(frozen=True)
class TorqueMap(Checked):
    """Joint torques, and when they tell of a touch: see `sensors.force.momentum_observer`.

    Attributes:
        threshold_nm: of the norm of the observer's residual, from what it is at rest.
        joints: names of the model's joints, from the base on; all that are recorded by default.
        counted: how many of them count in the norm.
        gain: of the observer, 1/s.
        rest_s: seconds at the start, without contact, from which the rest is taken; 0 for a rest of 0.
        likelihood: a signal counts as a touch of some point of the gripper
            (`rumi.belief.contact_evidence.ContactSignalEvidence`).
        true_positive, false_positive, decay, most, spacing_m: see `rumi.belief.contact_evidence.SignalSettings`.
    """

    threshold_nm: Positive
    joints: tuple[str, ...] = ()
    counted: Count = 5
    gain: Positive = 25.0
    rest_s: NotNegative = 0.5
    likelihood: bool = False
    true_positive: float = 0.9
    false_positive: float = 0.02
    decay: float = 150.0
    most: int = 2
    spacing_m: float = 0.008

    def __post_init__(self) -> None:
        super().__post_init__()
        self.signals()

    def signals(self) -> SignalSettings:
        """What they count for."""
        return SignalSettings(self.true_positive, self.false_positive, self.decay, self.most, self.spacing_m)
