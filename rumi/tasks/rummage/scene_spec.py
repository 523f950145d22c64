"""What a scene of the rummaging tasks is: what stands where, and what the robot knows of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch

from rumi.seeding import split
from rumi.sim.settings import PhysicsSettings
from sdf.object_model import ObjectModel


@dataclass(frozen=True)
class CameraSpec:
    """A fixed depth camera.

    Attributes:
        position: of its eye, metres.
        target: point that it looks at, metres.
        field_of_view_rad: vertical.
        height: rows of the image.
        width: columns.
    """

    position: tuple[float, float, float] = (-0.25, 0.0, 0.30)
    target: tuple[float, float, float] = (0.45, 0.0, 0.04)
    field_of_view_rad: float = math.radians(45.0)
    height: int = 240
    width: int = 320


@dataclass(frozen=True)
class PriorSpec:
    """Where the object is known to be about before anything is sensed.

    Attributes:
        mean_m: x and y of the object's origin.
        spread_m: standard deviation along x and along y.
        yaw_rad: its yaw and the standard deviation of that; None for any.
    """

    mean_m: tuple[float, float]
    spread_m: float = 0.05
    yaw_rad: tuple[float, float] | None = None


@dataclass(frozen=True)
class DrawSpec:
    """Ranges of a scene that each seed draws anew, evenly; neither filter nor planner is told them or what came.

    Attributes:
        distance_m: of the object's origin from the arm's base.
        bearing_rad: of the object from ahead of the base, to either side at most.
        turn_rad: of the object's x axis from pointing straight away from the camera, without one from ahead, to either
            side at most.
        mass_kg: of the object.
        friction: sliding friction of everything.
    """

    distance_m: tuple[float, float]
    bearing_rad: float
    turn_rad: float
    mass_kg: tuple[float, float]
    friction: tuple[float, float] = (0.3, 0.7)


@dataclass(frozen=True)
class TaskSpec:
    """One task: an object to be found, where it stands, and the robot about it; metres and radians.

    Attributes:
        name: by which it is asked for.
        description: one line for people.
        object_factory: makes the object's model.
        start: (x, y, yaw) of the object; the robot does not know it.
        up: axes of the object one of which points up where it lies on the floor; the robot knows no more than these.
        start_up: the one that does.
        prior: where the object is known to be about; None where a camera sees it.
        bounds: lower and upper corner of the workspace, x and y.
        height_m: of the plane in which the tool works.
        heights_m: lowest and highest of a tool that moves in space, actions (dx, dy, dz, dyaw); None for the plane.
        workspace_top_m: height up to which the workspace's lattice goes where the tool moves in space.
        field_spacing_m: of the workspace's lattice (RUMI's r_w).
        search: freedom of the object's pose, "SE(2)" or "SE(3)".
        nll_threshold: nll at or below which the paper counts the object as found.
        position_tolerance_m: error of the pose that still counts as right.
        rotation_tolerance_rad: the same for its rotation.
        camera: the fixed camera; None where it sees nothing of the object.
        looks_again: whether the camera is looked at after every action too, not at the start alone.
        measures_motion: whether a slip sensor reports the object's motion; where none does, it is estimated.
        action_m: metres that a control of 1 asks for; None for the simulator's.
        action_rad: radians that a control of 1 asks for; None for the simulator's.
        tool_start: (x, y, yaw) of the tool, in space (x, y, z, yaw).
        base: (x, y, yaw) of the arm's base.
        base_below_m: how far that is below the floor that the object stands on.
        motion_noise_m: standard deviation of the measured motion's error along x and y, for an action that moved
            the object.
        motion_noise_rad: the same for its yaw.
        felt_ahead_m: distance in front of the pads at which felt points are reported; half of the simulator's
            `contact_m` is the middle of the layer in which the surface then is, none the pads' own surface.
        depth_noise_m: standard deviation of the camera's depth.
        steps: actions at most.
        apc_ratio: of the object's diagonal, below which the paper's rule stops; None for the setting's.
        physics: the object's mass and friction, and the gripper's drive.
        draw: what the seed draws of start, mass and friction in place of these; None for nothing.
    """

    name: str
    description: str
    object_factory: Callable[[], ObjectModel]
    start: tuple[float, float, float]
    up: tuple[str, ...] = ("z",)
    start_up: str = "z"
    prior: PriorSpec | None = None
    bounds: tuple[tuple[float, float], tuple[float, float]] = ((0.0, -0.4), (0.8, 0.4))
    height_m: float = 0.045
    heights_m: tuple[float, float] | None = None
    workspace_top_m: float = 0.2
    field_spacing_m: float = 0.01
    search: str = "SE(2)"
    nll_threshold: float = 20.0
    position_tolerance_m: float = 0.005
    rotation_tolerance_rad: float = math.radians(10.0)
    camera: CameraSpec | None = CameraSpec()
    looks_again: bool = False
    measures_motion: bool = True
    action_m: float | None = None
    action_rad: float | None = None
    tool_start: tuple[float, ...] = (0.20, 0.0, 0.0)
    base: tuple[float, float, float] = (-0.45, 0.0, 0.0)
    base_below_m: float = 0.0
    motion_noise_m: float = 0.0
    motion_noise_rad: float = 0.0
    felt_ahead_m: float = 0.0
    depth_noise_m: float = 0.0
    steps: int = 40
    apc_ratio: float | None = None
    physics: PhysicsSettings = field(default_factory=PhysicsSettings)
    draw: DrawSpec | None = None

    @property
    def spatial(self) -> bool:
        """Whether the tool moves in space."""
        return self.heights_m is not None

    def drawn(self, seed: int) -> "TaskSpec":
        """The scene of a seed: itself where nothing is drawn."""
        ranges = self.draw
        if ranges is None:
            return self
        share = torch.rand(6, generator=split(seed, "scene"), dtype=torch.float64).tolist()
        distance, mass, friction = (
            low + (high - low) * part
            for (low, high), part in zip((ranges.distance_m, ranges.mass_kg, ranges.friction), share[:3], strict=True)
        )
        bearing = (2.0 * share[3] - 1.0) * ranges.bearing_rad
        turn = (2.0 * share[4] - 1.0) * ranges.turn_rad
        x, y = (
            self.base[0] + distance * math.cos(self.base[2] + bearing),
            self.base[1] + distance * math.sin(self.base[2] + bearing),
        )
        if self.camera is not None:
            turn += math.atan2(y - self.camera.position[1], x - self.camera.position[0])
        return replace(
            self,
            start=(x, y, math.remainder(turn, 2.0 * math.pi)),
            start_up=self.up[min(int(share[5] * len(self.up)), len(self.up) - 1)],
            physics=replace(self.physics, mass_kg=mass, friction=friction),
        )
