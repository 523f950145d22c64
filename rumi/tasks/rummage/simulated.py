"""A task carried out in MuJoCo: what the robot does and what it senses."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.belief.prior import lying
from rumi.errors import UsageError
from rumi.robot.gripper import gripper_of
from rumi.robot.tool import Tool
from rumi.seeding import split
from rumi.sim.arm_world import ArmWorld
from rumi.sim.bodies import Body, body_of
from rumi.sim.faults import Fault, Hand
from rumi.sim.force_sensing_world import ForceSensingWorld
from rumi.sim.robot_arm import RobotArm
from rumi.sim.sensors import measure
from rumi.sim.settings import PhysicsSettings, SimSettings
from rumi.sim.slip import measured_motion
from rumi.sim.world import Track, World
from rumi.sim.wrist_force import wrist_force
from rumi.task import StepResult
from rumi.tasks.rummage.scenes import TaskSpec
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.observation import Observation, concatenate
from sensors.reading import FORCE, TORQUE_CONTACT, Reading
from sensors.semantics import Semantics
from sensors.touch.tactile import InstantPoints, swept_points, tactile_observation, touched_points
from sensors.vision.camera import depth_observation, look_at, pinhole, pixel_rays

# standard deviations of the prior up to which free points are reported
_SPREADS = 4.0


class SimTask:
    """A `rumi.task.Task` in simulation: a level gripper about an object on the floor.

    The same seed gives the same bytes; seeds change the noise and what the task draws, else nothing. Readings are
    float32. Truth is in `StepResult.truth` only.

    Args:
        spec: the task.
        settings: of the simulator and its sensors.
        tool: the gripper with the reach of its arm, the same that the planner uses.
        model: the object.
        physics: masses, friction, drive; by default the task's.
        cache_dir: folder that keeps convex pieces of meshes; None keeps nothing.
        faults: what goes wrong.
        arm: that carries the gripper; None for that of `settings.robot`.

    Raises:
        UsageError: the simulator cannot build the object, or it does not stand by itself.
    """

    def __init__(
        self,
        spec: TaskSpec,
        settings: SimSettings,
        tool: Tool,
        model: ObjectModel,
        physics: PhysicsSettings | None = None,
        *,
        cache_dir: Path | None = None,
        faults: Sequence[Fault] = (),
        arm: RobotArm | None = None,
    ) -> None:
        for fault in faults:
            model = fault.shaped(model)
        self.spec, self.settings, self.tool, self.model, self.faults = spec, settings, tool, model, tuple(faults)
        physics = physics or spec.physics
        body = body_of(model.exact, physics, table=model.sdf, cache_dir=cache_dir)
        self.shape = shape = gripper_of(tool.shape)
        self._arm = arm
        if settings.robot == "arm" and arm is None:
            self._arm = RobotArm.standard(spec.base, spec.base_below_m)
        self.world = self._world(body, physics)
        self._scene = spec
        # what cannot stand is refused before anything begins
        self.world.reset(torch.tensor(spec.tool_start), self._start())
        self._pads = shape.pad_shell(settings.pad_spacing_m).float()
        self._felt_at = self._pads + spec.felt_ahead_m * shape.pad_normals(self._pads)
        self._body = shape.volume(settings.body_spacing_m).float()
        self._generator = torch.Generator()
        self._further_noise = split(0, "further sensors")
        self._region = torch.zeros(2, 3)
        self._attached = se3.identity()
        self._steps: int | None = None
        self._views: list[Observation] = []

    def reset(self, seed: int) -> StepResult:
        """Put everything at its start and return the first view: one instant, seen by the camera if there is one.

        Args:
            seed: of the sensors' noise, and of the scene where the task draws it.
        """
        self._generator.manual_seed(seed)
        self._further_noise = split(seed, "further sensors")
        self._scene = self.spec.drawn(seed)
        if self.spec.draw is not None or self.faults:
            physics = self.world.physics
            if self.spec.draw is not None:
                own = self._scene.physics
                physics = replace(physics, mass_kg=own.mass_kg, friction=own.friction)
            self.world = self._world(self.world.body, physics)
        self.world.seed(seed)
        self.world.reset(torch.tensor(self.spec.tool_start), self._start())
        self._attached, self._steps = se3.identity(), 0
        self._views = []
        observation = self._looked_at()
        configuration = self.world.configuration().float()
        still = se3.identity((1,)) if self._measures else None
        reading = Reading(
            observation,
            torch.zeros(len(observation), dtype=torch.long),
            self.tool.pose(configuration[None]),
            torch.zeros(1, dtype=torch.bool),
            still,
            configuration,
            torch.zeros(()),
        )
        return StepResult(reading, self.world.world_T_object().float())

    def _world(self, body: Body, physics: PhysicsSettings) -> World:
        """The scene with the robot of the settings."""
        spec, settings = self.spec, self.settings
        height = None if spec.spatial else spec.height_m
        if self._arm is None:
            kind = ForceSensingWorld if settings.sensors.wrist_force else World
            return kind(body, self.shape, height, settings.time_step_s, physics)
        if settings.sensors.wrist_force:
            raise UsageError("Expected --robot gripper with a wrist's force sensor, which the arm does not carry")
        world = ArmWorld(body, self.shape, height, settings.time_step_s, physics, arm=self._arm)
        world.pads_touch = lambda object_T_tool: bool(self._felt(object_T_tool[None].float()).any())
        return world

    def _start(self) -> Tensor:
        """Where the object starts, as `World.reset` takes it."""
        start = torch.tensor(self._scene.start, dtype=torch.float32)
        if self._scene.start_up != "z" or self._scene.prior is not None:
            return se3.from_planar(start) @ lying(self.model.exact.bounds.float(), self._scene.start_up)
        return start

    def step(self, control: Float[Tensor, "A"]) -> StepResult:
        """Carry out (dx, dy, dyaw), each in [-1, 1] of the action scales, as far as the arm reaches.

        Args:
            control: (3,), in space (dx, dy, dz, dyaw) and (4,), cut to [-1, 1].

        Raises:
            UsageError: before `reset`, after the task's last step, or if the control is not as many finite numbers.
        """
        control = self._checked(control)
        start = self.world.configuration().float()
        path = self.tool.free_path(start, control[None], self.settings.mini_steps)
        refused = (start + control * self.tool.scale - path[-1])[:-1].norm()
        assert self._steps is not None
        self._steps += 1
        for fault in self.faults:
            if fault.step == self._steps:
                fault.strike(self.world, self.model.exact, self._hand())
        before = self.world.world_T_object()
        track = self.world.move(path, self.settings.action_s, self.settings.hold_s)
        reading = self._sense(before, track, refused + track.refused_m)
        for fault in self.faults:
            if fault.step <= self._steps:
                reading = fault.felt(reading, self._hand(), self._steps)
        sensors = self.settings.sensors
        if sensors.further or sensors.wrist_force or self._arm is not None:
            measured = measure(sensors.further, self.world, track, reading.tool_pose, self._further_noise)
            if isinstance(self.world, ForceSensingWorld) and self.world.trace is not None:
                measured[FORCE] = wrist_force(self.world.trace, sensors.wrist_noise_n, self._further_noise)
            if isinstance(self.world, ArmWorld):
                measured[TORQUE_CONTACT] = self.world.signals.float()[:, None]
            reading = replace(reading, measurements=measured)
        if self._looks_again:
            reading = self._seen_again(reading)
        return StepResult(reading, track.world_T_object[-1].float())

    @property
    def _measures(self) -> bool:
        return self.settings.measures_motion and self.spec.measures_motion

    def _seen_again(self, reading: Reading) -> Reading:
        """The reading with what the camera sees at its last instant; nothing where the tool hides the object."""
        seen = self._looked_at()
        last = torch.full((len(seen),), len(reading.tool_pose) - 1, dtype=torch.long)
        observation = concatenate([reading.observation, seen])
        return replace(reading, observation=observation, instant=torch.cat((reading.instant, last)))

    @property
    def _looks_again(self) -> bool:
        return self.spec.looks_again and self.spec.camera is not None

    def _looked_at(self) -> Observation:
        """What the camera reports now."""
        view = self._view()
        for fault in self.faults:
            if fault.step <= (self._steps or 0):
                view = fault.seen(view, self._views)
        self._views.append(view)
        return view

    def _hand(self) -> Hand:
        pose = self.tool.pose(self.world.configuration().float()[None])[0]
        return Hand(self._felt_at, self._body, pose)

    def _view(self) -> Observation:
        """What the camera sees now: surface points of the object and free points about it."""
        camera = self.spec.camera
        if camera is None:
            self._region = self._region_of_prior()
            return Observation.empty() if self.spec.search == "SE(2)" else self._floor()
        intrinsics = pinhole(camera.height, camera.width, camera.field_of_view_rad)
        world_T_camera = look_at(torch.tensor(camera.position), torch.tensor(camera.target))
        depth, is_object = self.depth_image()
        surface = depth_observation(depth, intrinsics, world_T_camera, is_object).points
        if len(surface) == 0:
            if self._steps == 0:
                self._region = self._region_unseen()
            return Observation.empty()
        self._region = self._region_about(surface)
        return depth_observation(
            depth,
            intrinsics,
            world_T_camera,
            is_object,
            bounds=self._region,
            free_spacing=self.settings.free_spacing_m,
            free_margin_m=self.settings.free_margin_m,
            free_fraction=self.settings.free_fraction,
        )

    def depth_image(self) -> tuple[Float[Tensor, "H W"], Tensor]:
        """Depth (H, W), metres, infinite where nothing is met; and where it shows the object (H, W)."""
        camera = self.spec.camera
        if camera is None:
            raise UsageError(f"Expected a task with a camera, got {self.spec.name}")
        intrinsics = pinhole(camera.height, camera.width, camera.field_of_view_rad, dtype=torch.float64)
        pose = look_at(torch.tensor(camera.position).double(), torch.tensor(camera.target).double())
        rays = pixel_rays(camera.height, camera.width, intrinsics).reshape(-1, 3) @ pose[:3, :3].mT
        # directions with a forward part of 1: the distance along them is the depth
        depth, is_object = self.world.cast(pose[:3, 3], rays)
        if self.spec.depth_noise_m > 0:
            noise = torch.randn(depth.shape, generator=self._generator, dtype=depth.dtype)
            depth = depth + self.spec.depth_noise_m * noise
        shape = (camera.height, camera.width)
        return depth.reshape(shape).float(), is_object.reshape(shape)

    def finish(self, action: Any) -> Any:  # noqa: ANN401  (a subclass's own)
        """Nothing is done at the end."""

    def close(self) -> None:
        """Let go of the simulator: no step until the next `reset`."""
        self._steps = None

    def _checked(self, control: Tensor) -> Float[Tensor, "A"]:
        if self._steps is None:
            raise UsageError("Expected reset(seed) before the first step")
        if self._steps >= self.spec.steps:
            raise UsageError(
                f"Expected at most {self.spec.steps} steps of {self.spec.name}: call reset(seed), or raise the "
                "task's steps"
            )
        control = torch.as_tensor(control, dtype=torch.float32).detach().cpu()
        names = "(dx, dy, dz, dyaw)" if self.spec.spatial else "(dx, dy, dyaw)"
        size = len(self.tool.scale)
        if tuple(control.shape) != (size,) or not bool(torch.isfinite(control).all()):
            raise UsageError(f"Expected control to be {size} finite numbers {names}, got {control.tolist()}")
        return control.clamp(-1.0, 1.0)

    def _sense(self, before: Float[Tensor, "4 4"], track: Track, refused: Tensor) -> Reading:
        motion = track.world_T_object @ se3.inverse(before)
        # drawn whether or not the object moved, so that one action's noise does not depend on another's contact
        noise = torch.randn(3, generator=self._generator, dtype=torch.float64) * torch.tensor(
            (self.spec.motion_noise_m, self.spec.motion_noise_m, self.spec.motion_noise_rad), dtype=torch.float64
        )
        measured = measured_motion(before, motion, noise).float() if self._measures else None
        configuration = track.configuration.float()
        tool_pose = self.tool.pose(configuration) if track.world_T_tool is None else track.world_T_tool.float()
        object_T_tool = (se3.inverse(track.world_T_object) @ tool_pose.double()).float()
        touched = self._felt(object_T_tool)
        in_contact = touched.any(-1)
        swept, index = self._swept(tool_pose, self._body, measured, in_contact)
        clear = self._clear(object_T_tool, self._body, swept.instant, index)
        free = type(swept)(swept.points[clear], swept.instant[clear])
        observation, instant = tactile_observation(touched_points(tool_pose, self._felt_at, touched), free)
        return Reading(
            observation,
            instant,
            tool_pose,
            in_contact,
            measured,
            configuration[-1],
            refused,
            float(self.world.data.time),
        )

    def _swept(
        self, tool_pose: Float[Tensor, "K 4 4"], body: Float[Tensor, "n 3"], measured: Tensor | None, in_contact: Tensor
    ) -> tuple[InstantPoints, Int[Tensor, "M"]]:
        """What the gripper's points went through, and which of them; takes note of a measured motion."""
        attached_T_world, group = None, None
        region = self._region
        if measured is None:
            # nothing moves while nothing is touched; what was swept while touching belongs to its instant alone
            group = in_contact.long().cumsum(0)
            low, high = self.spec.bounds
            top = float(self._region[1, 2])
            region = torch.tensor(((*low, 0.0), (*high, top)))
        else:
            attached_T_world = se3.inverse(measured @ self._attached)
            self._attached = measured[-1] @ self._attached
        return swept_points(
            tool_pose,
            body,
            self.settings.free_spacing_m,
            attached_T_world=attached_T_world,
            group=group,
            region=region,
        )

    def _felt(self, object_T_tool: Float[Tensor, "K 4 4"]) -> Tensor:
        """Which pad points are within `contact_m` of the object's true surface (RUMI, V.A)."""
        return self._within(se3.apply(object_T_tool, self._pads), lambda distance, reach: distance.abs() <= reach)

    def _clear(
        self,
        object_T_tool: Float[Tensor, "K 4 4"],
        points: Float[Tensor, "n 3"],
        instant: Int[Tensor, "M"],
        index: Tensor,
    ) -> Bool[Tensor, "M"]:
        """Which points of the tool are farther than `contact_m` outside the object's true surface."""
        own = object_T_tool[instant]
        places = (own[:, :3, :3] @ points[index][..., None])[..., 0] + own[:, :3, 3]
        return ~self._within(places, lambda distance, reach: ~(distance > reach))

    def _within(self, places: Float[Tensor, "*b 3"], is_there: Callable[[Tensor, float], Tensor]) -> Bool[Tensor, "*b"]:
        """Where something holds of the distance to the object that only points close to it or in it can have."""
        reach = self.settings.contact_m
        low, high = self.model.exact.bounds.to(places)
        # such points are in the object's box, so that free motion costs next to nothing
        x, y, z = ((places >= low - reach) & (places <= high + reach)).unbind(-1)
        found = x & y & z  # `all` takes ten times as long
        near = found.nonzero(as_tuple=True)
        if len(near[0]):
            with torch.no_grad():
                found[near] = is_there(self.model.exact.distance(places[near]), reach)
        return found

    def _floor(self) -> Observation:
        """Free points where the floor is, fixed in the world (RUMI, V.B)."""
        step = self.spec.field_spacing_m
        low, high = self._region[:, :2]
        ends = [(float(low[axis]), float(high[axis]) + 0.5 * step) for axis in (0, 1)]
        x, y = (torch.arange(*pair, step, dtype=torch.float32) for pair in ends)
        points = torch.stack(torch.meshgrid(x, y, x.new_zeros(1), indexing="ij"), -1).reshape(-1, 3)
        return Observation.of(points, Semantics.FREE, attached=False)

    def _region_of_prior(self) -> Float[Tensor, "2 3"]:
        """The box that holds the object wherever it may well be."""
        prior, bounds = self.spec.prior, self.model.exact.bounds.float()
        if prior is None:
            raise UsageError(f"Expected {self.spec.name} to have a camera or a prior, got neither")
        mean, reach = torch.tensor(prior.mean_m), _SPREADS * prior.spread_m + self.model.radius
        top = max(float((bounds[1] - bounds[0])["xyz".index(up)]) for up in self.spec.up)
        return torch.tensor([[*(mean - reach).tolist(), 0.0], [*(mean + reach).tolist(), top]])

    def _region_unseen(self) -> Float[Tensor, "2 3"]:
        """Where the object may be if the first view does not show it: nowhere in particular without a prior."""
        return torch.zeros(2, 3) if self.spec.prior is None else self._region_of_prior()

    def _region_about(self, surface: Float[Tensor, "M 3"]) -> Float[Tensor, "2 3"]:
        """The box in which free points can refute a pose that the view leaves open."""
        grow = self.settings.free_region_m
        low, high = surface.amin(0) - grow, surface.amax(0) + grow
        if self.spec.search == "SE(2)":
            # an upright object is no taller than what is seen of it
            high[2] -= grow
            high[2] = math.ceil(float(high[2]) / self.settings.free_spacing_m) * self.settings.free_spacing_m
        low[2] = 0.0
        return torch.stack((low, high))
