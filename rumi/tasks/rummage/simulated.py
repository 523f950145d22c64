"""A task carried out in MuJoCo: what the robot does and what it senses."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.prior import lying
from rumi.errors import UsageError
from rumi.robot.gripper import gripper_links, gripper_of
from rumi.robot.tool import Tool
from rumi.seeding import split
from rumi.sim.bodies import Body, body_of
from rumi.sim.error_settings import BuildSpread
from rumi.sim.fault import Fault, Hand
from rumi.sim.guarded_move import GuardedMove
from rumi.sim.object_build import Build
from rumi.sim.pad_faults import PadFaults
from rumi.sim.robot_arm import RobotArm
from rumi.sim.settings import PhysicsSettings, SimSettings
from rumi.sim.slip import measured_motion
from rumi.sim.tool_offset import ToolOffset
from rumi.sim.view_faults import ViewFaults
from rumi.sim.world import Guard, Track, World
from rumi.task import StepResult
from rumi.tasks.rummage.point_camera import PointCamera
from rumi.tasks.rummage.robots import make_world, measurements
from rumi.tasks.rummage.scene_spec import TaskSpec
from rumi.tasks.rummage.swept_space import SweptSpace
from rumi.tasks.rummage.true_contact import outside, touching
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.touch.tactile import InstantPoints, tactile_observation, touched_points
from sensors.vision.robot_body import RobotBody


class SimTask:
    """A `rumi.task.Task` in simulation: a level gripper about an object on the floor.

    The same seed gives the same bytes; seeds change the noise and what the task draws, else nothing. Readings are
    float32. Truth is in `StepResult.truth` only.

    Args:
        spec: the task.
        settings: of the simulator and its sensors.
        tool: the gripper with the reach of its arm, the same that the planner uses.
        model: the object.
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
        *,
        cache_dir: Path | None = None,
        faults: Sequence[Fault] = (),
        arm: RobotArm | None = None,
    ) -> None:
        for fault in faults:
            model = fault.shaped(model)
        self.spec, self.settings, self.tool, self.model, self.faults = spec, settings, tool, model, tuple(faults)
        physics = spec.physics
        body = body_of(model.exact, physics, table=model.sdf, cache_dir=cache_dir)
        self.shape = shape = gripper_of(tool.shape)
        self._arm = arm
        if settings.robot == "arm" and arm is None:
            self._arm = RobotArm.standard(spec.base, spec.base_below_m)
        self.world = self._world(body, physics)
        self._plain, self._true = (body, physics), model.exact
        self._cache_dir = cache_dir
        Build.thinnest(settings.build).shape(model.exact)
        self._scene = spec
        # what cannot stand is refused before anything begins
        self.world.reset(torch.tensor(spec.tool_start), self._start())
        self._pads = shape.pad_shell(settings.pad_spacing_m).float()
        self._felt_at = self._pads + spec.felt_ahead_m * shape.pad_normals(self._pads)
        self._body = shape.volume(settings.body_spacing_m).float()
        self._links = RobotBody(gripper_links(shape))
        deep = torch.stack([link.distance(self._body) for link in self._links.links]).amin(0) < -settings.contact_m
        self._inner = self._body[deep]
        self._generator = torch.Generator()
        self._draw_errors(0)
        self._further_noise = split(0, "further sensors")
        self._space = SweptSpace(spec.bounds, settings.free_spacing_m)
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
        self._draw_errors(seed)
        if self.spec.draw is not None or self.faults or self.settings.build != BuildSpread():
            self.world = self._built(seed)
        self.world.seed(seed)
        self.world.reset(torch.tensor(self.spec.tool_start), self._start())
        self._space = SweptSpace(self.spec.bounds, self.settings.free_spacing_m)
        self._steps, self._views = 0, []
        observation = self._looked_at()
        configuration = self._configuration()
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
        return make_world(self.spec, self.settings, self.shape, self._arm, body, physics)

    def _draw_errors(self, seed: int) -> None:
        """Draw what is wrong with the robot of a run, each from a stream of its own."""
        own = self.settings
        self._offset = ToolOffset.drawn(own.tool_off_m, own.tool_off_rad, spatial=self.spec.spatial, seed=seed)
        self._pad_faults = PadFaults(own.pads, self._pads, seed)
        self._pad_draws = self._pad_faults.drawn(0)
        faults = ViewFaults.drawn(own.view, own.sensors, seed)
        self._camera = PointCamera(self.spec, own, self.model, self._links, faults, self._generator)

    def _built(self, seed: int) -> World:
        """The world with the object as the seed has it."""
        body, physics = self._plain
        if self.spec.draw is not None:
            physics = replace(physics, mass_kg=self._scene.physics.mass_kg, friction=self._scene.physics.friction)
        if self.settings.build != BuildSpread():
            build = Build.drawn(self.settings.build, seed)
            physics, self._true = build.physics(physics), build.shape(self.model.exact)
            if self._true is not self.model.exact:
                body = body_of(self._true, physics, cache_dir=self._cache_dir)
        return self._world(body, physics)

    def _configuration(self) -> Float[Tensor, "Q"]:
        """Where the robot takes its tool to be."""
        return self._offset.taken(self.world.configuration()).float()

    def _start(self) -> Tensor:
        """Where the object starts, as `World.reset` takes it."""
        start = torch.tensor(self._scene.start, dtype=torch.float32)
        if self._scene.start_up != "z" or self._scene.prior is not None:
            return se3.from_planar(start) @ lying(self._true.bounds.float(), self._scene.start_up)
        return start

    def step(self, control: Float[Tensor, "A"]) -> StepResult:
        """Carry out (dx, dy, dyaw), each in [-1, 1] of the action scales, as far as the arm reaches.

        Args:
            control: (3,), in space (dx, dy, dz, dyaw) and (4,), cut to [-1, 1].

        Raises:
            UsageError: before `reset`, after the task's last step, or if the control is not as many finite numbers.
        """
        control = self._checked(control)
        start, late_s = self._configuration(), self.settings.stops_late_s
        path = self.tool.free_path(start, control[None], self.settings.mini_steps)
        refused = (start + control * self.tool.scale - path[-1])[:-1].norm()
        assert self._steps is not None
        self._steps += 1
        for fault in self.faults:
            if fault.step == self._steps:
                fault.strike(self.world, self._true, self._hand())
        before = self.world.world_T_object()
        if late_s > 0:
            farther = control[None] * (1.0 + late_s / self.settings.action_s)
            path = self.tool.free_path(start, farther, self.settings.mini_steps)
        self._pad_draws = self._pad_faults.drawn(len(path))
        guard = None
        if self.settings.guarded == "always":
            guard_m = self.settings.guard_of(spatial=self.spec.spatial, looks_again=self._looks_again)
            guard = Guard(GuardedMove(guard_m, lambda index: self._feels(index, path)), late_s)
        track = self.world.move(self._offset.true(path), self.settings.action_s + late_s, self.settings.hold_s, guard)
        reading = self._sense(before, track, refused + track.refused_m)
        for fault in self._begun_faults():
            reading = fault.felt(reading, self._hand(), self._steps)
        sensors = self.settings.sensors
        if sensors.further or sensors.wrist_force or self._arm is not None:
            where = reading.tool_pose if self._offset.none else self._true_pose(track)
            found = measurements(self.world, sensors, track, where, self._further_noise)
            reading = replace(reading, measurements=found)
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
        for fault in self._begun_faults():
            view = fault.seen(view, self._views)
        self._views.append(view)
        return view

    def _begun_faults(self) -> list[Fault]:
        return [fault for fault in self.faults if fault.step <= (self._steps or 0)]

    def _hand(self) -> Hand:
        pose = self.tool.pose(self.world.configuration().float()[None])[0]
        return Hand(self._felt_at, self._body, pose)

    def _view(self) -> Observation:
        """What the camera sees now: surface points of the object and free points about it."""
        tool = self.tool.pose(self._configuration()[None])
        return self._camera.view(self.world, tool, first=self._steps == 0)

    def depth_image(self) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
        """Depth and the object's mask of what is there now; see `PointCamera.depth_image`."""
        return self._camera.depth_image(self.world)

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
        measured = self._measured(before, track)
        configuration = self._offset.taken(track.configuration).float()
        true = self._true_pose(track)
        tool_pose = self._taken_pose(track, true)
        object_T_tool = (se3.inverse(track.world_T_object) @ true.double()).float()
        touched = self._pad_faults.felt(self._touched(object_T_tool), self._pad_draws)
        in_contact = touched.any(-1)
        free = self._freed(tool_pose, object_T_tool, measured, in_contact)
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

    def _measured(self, before: Float[Tensor, "4 4"], track: Track) -> Float[Tensor, "K 4 4"] | None:
        """The object's motion since the action's start, by a slip sensor; None where there is no such sensor."""
        sensors = self.settings.sensors
        shift = math.hypot(self.spec.motion_noise_m, sensors.motion_noise_m)
        turn = math.hypot(self.spec.motion_noise_rad, sensors.motion_noise_rad)
        # drawn whether or not the object moved, so that one action's noise does not depend on another's contact
        noise = torch.randn(3, generator=self._generator, dtype=torch.float64)
        noise = noise * torch.tensor((shift, shift, turn), dtype=torch.float64)
        if not self._measures:
            return None
        return measured_motion(before, track.world_T_object @ se3.inverse(before), noise).float()

    def _true_pose(self, track: Track) -> Float[Tensor, "K 4 4"]:
        """Where the tool was."""
        return self.tool.pose(track.configuration.float()) if track.world_T_tool is None else track.world_T_tool.float()

    def _taken_pose(self, track: Track, true: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 4 4"]:
        """Where the robot takes its tool to have been."""
        if self._offset.none:
            return true
        level = self.tool.pose(self._offset.taken(track.configuration).float())
        if track.world_T_tool is None:
            return level
        return true @ se3.inverse(self.tool.pose(track.configuration.float())) @ level

    def _freed(
        self,
        tool_pose: Float[Tensor, "K 4 4"],
        object_T_tool: Float[Tensor, "K 4 4"],
        measured: Tensor | None,
        in_contact: Tensor,
    ) -> InstantPoints:
        """What is reported free of what the gripper went through."""
        region = self._camera.region
        if self.settings.cleared_by == "margin":
            return self._space.swept(tool_pose, self._inner, measured, in_contact, region)[0]
        swept, index = self._space.swept(tool_pose, self._body, measured, in_contact, region)
        clear = outside(self._true, object_T_tool[swept.instant], self._body[index], self.settings.contact_m)
        return InstantPoints(swept.points[clear], swept.instant[clear])

    def _touched(self, object_T_tool: Float[Tensor, "K 4 4"]) -> Bool[Tensor, "K n"]:
        return touching(self._true, object_T_tool, self._pads, self.settings.contact_m)

    def _feels(self, index: int, path: Float[Tensor, "K Q"]) -> tuple[Float[Tensor, "Q"], bool]:
        """Where the tool is at the end of a mini step, and whether its pads report that they feel anything.

        In space that is where it was to go: held up from below it goes nowhere, and presses all the harder.
        """
        now = self.world.now()
        object_T_tool = (se3.inverse(now.world_T_object) @ self._true_pose(now).double()).float()
        felt = bool(self._pad_faults.felt(self._touched(object_T_tool), self._pad_draws.at(index)).any())
        for fault in self._begun_faults():
            felt = fault.touched(felt, self._hand())
        return path[index] if self.spec.spatial else now.configuration[0], felt
