"""A simulated task whose robot sees and feels through images, as a real one does."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.tool import Tool
from rumi.sim.bubble_camera import BubbleCamera
from rumi.sim.fault import Fault
from rumi.sim.robot_arm import RobotArm
from rumi.sim.settings import SimSettings
from rumi.sim.view_faults import holed, miscalibration, taken_pose
from rumi.sim.world import Track
from rumi.task import StepResult
from rumi.tasks.rummage.depth_camera import cast_pixels
from rumi.tasks.rummage.free_region import region_about, region_unseen
from rumi.tasks.rummage.raw_streams import RawStreams
from rumi.tasks.rummage.scene_spec import CameraSpec, TaskSpec
from rumi.tasks.rummage.simulated import SimTask
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics
from sensors.touch.bubble import Bubble, bubble_patch
from sensors.vision.camera import look_at, pinhole
from sensors.vision.view import Image, KnownScene, ViewSettings, view_observation

_LOOK_S = 0.4
_LOOKS = 3  # that the first one lasts for at most, while the object does not show
_BLUE, _GREY = (30, 60, 200), (120, 120, 120)
_FLOOR_M = 0.002  # what is lower is the floor
_NEAR_M = 0.002  # what the simulator's flat pieces are off the exact shape, at most
_VIEW = ViewSettings("color", (200.0, 260.0), persist_s=_LOOK_S, persist_gap_s=0.15)


class SensedTask(SimTask):
    """A `SimTask` that reports through a camera, soft bubbles, or both, and knows nothing else of the object.

    The camera sees the object and the gripper in one colour over a grey floor, for 0.4 s after an action; its frames go
    through `sensors.vision.view`, the gripper's body left out at the measured configuration. The first look goes on for
    three times as long where too many frames were lost for anything to show. Bubbles go through
    `sensors.touch.bubble` at every mini step. What the rigid part of the gripper went through, by 3 mm and more inside
    of it, is free. The object's motion is measured by a slip sensor, with noise.

    Args:
        spec: the task; it must have a camera.
        settings: of the simulator; its `sensors` say which there are, and how well they work.
        tool: the gripper with the reach of its arm.
        model: the object.
        cache_dir: folder that keeps convex pieces of meshes.
        faults: what goes wrong.
        arm: that carries the gripper; None for that of `settings.robot`.

    Raises:
        UsageError: the task has no camera.
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
        if spec.camera is None:
            raise UsageError(f"{spec.name} has no camera: only tasks with one report through other sensors than points")
        super().__init__(spec, settings, tool, model, cache_dir=cache_dir, faults=faults, arm=arm)
        self.sensors = sensors = settings.sensors
        self._bubbles = [BubbleCamera(self.shape, pad, sensors.membrane_m) for pad in range(2) if sensors.feels]
        self._believed: list[Bubble] = []
        self._off = se3.identity()
        self._late = round(sensors.late_s * settings.mini_steps / settings.action_s)
        self._look_frames = math.ceil(_LOOK_S * sensors.frame_rate_hz) + 2
        self.raw = RawStreams(spec, settings, self.shape, self._bubbles, self._look_frames)

    def reset(self, seed: int) -> StepResult:
        """Put everything at its start and return the first look; the seed draws noise and errors of calibration."""
        self._generator.manual_seed(seed)
        self._off = miscalibration(self.sensors, self._generator)
        self._believed = [
            Bubble.of(
                _seen(bubble.rest, 0.0, self._generator).float(),
                bubble.intrinsics.float(),
                bubble.tool_T_camera.float() @ miscalibration(self.sensors, self._generator),
            )
            for bubble in self._bubbles
        ]
        # drawn from a stream of its own, so that the calibration is the same whatever the noise
        after = int(torch.randint(2**62, (), generator=self._generator))
        return super().reset(after)

    @property
    def _looks_again(self) -> bool:
        return self.sensors.looks or super()._looks_again

    def _view(self) -> Observation:
        """What the camera sees while nothing moves; the first look sets the region of free points for touch."""
        seen = self._looked()
        surface = seen.points[seen.of_class(Semantics.SURFACE)]
        if self._steps == 0:
            spec, settings = self.spec, self.settings
            region = region_about(surface, spec, settings) if len(surface) else region_unseen(spec, self.model)
            self._camera.region = region
            self.raw.about(region)
        return seen

    def _looked(self) -> Observation:
        camera = self._camera.place
        assert camera is not None
        intrinsics = pinhole(camera.height, camera.width, camera.field_of_view_rad)
        pose = look_at(torch.tensor(camera.position).double(), torch.tensor(camera.target).double())
        depth, color = self._frame(camera)
        taken = taken_pose(pose, self._off, self.sensors, camera.target).float()
        count, tool_pose = self._look_frames, self.tool.pose(self._configuration())
        body = tool_pose.expand(len(self._links.links), 4, 4)
        most = count * (_LOOKS if self._steps == 0 else 1)
        if self._steps == 0:
            rest, mounts = ([getattr(b, name) for b in self._believed] for name in ("rest", "tool_T_camera"))
            self.raw.start(taken, tool_pose, rest, mounts)
        memory, last, bounds, index = None, Observation.empty(), None, -1
        while index + 1 < (count if bounds is not None else most):
            index += 1
            noise = math.hypot(self.sensors.depth_noise_m, self.spec.depth_noise_m)
            image = _seen(depth, noise, self._generator).float()
            image = holed(image, self.settings.view, self._camera.faults.generator)
            lost = self._lost()
            self.raw.frame(index, None if lost else image, color, tool_pose)
            if lost:
                continue
            if index >= count - 2:
                # the lasting points of these frames say where free ones matter
                bounds = region_about(last.points, self.spec, self.settings) if len(last) else None
            view = view_observation(
                Image(image, intrinsics, color, stamp=index / self.sensors.frame_rate_hz),
                taken,
                replace(_VIEW, free_spacing_m=self.settings.free_spacing_m, free_margin_m=self.settings.free_margin_m),
                KnownScene(body=self._links, world_T_links=body, bounds=bounds),
                memory=memory,
            )
            memory = view.memory
            surface = view.observation.of_class(Semantics.SURFACE)
            if bool(surface.any()):
                last = view.observation if bounds is not None else view.observation[surface]
        self.raw.looked(tool_pose, index + 1)
        if bounds is None and len(last):  # the last frames never came
            last = last[last.of_class(Semantics.SURFACE)]
        return last

    def _frame(self, camera: CameraSpec) -> tuple[Float[Tensor, "H W"], UInt8[Tensor, "H W 3"]]:
        """Depth without noise, and colours: everything above the floor is blue."""
        depth, _, height = cast_pixels(self.world, camera)
        above = (height.nan_to_num(nan=math.inf) > _FLOOR_M) & torch.isfinite(depth)
        color = torch.tensor(_GREY, dtype=torch.uint8).expand(len(depth), 3).clone()
        color[above] = torch.tensor(_BLUE, dtype=torch.uint8)
        shape = (camera.height, camera.width)
        return depth.reshape(shape), color.reshape(*shape, 3)

    def _lost(self) -> bool:
        return float(torch.rand((), generator=self._generator)) < self.sensors.lost

    def _sense(self, before: Float[Tensor, "4 4"], track: Track, refused: Tensor) -> Reading:
        """What was felt and swept on the way."""
        measured = self._measured(before, track)
        configuration = self._offset.taken(track.configuration).float()
        tool_pose = self.tool.pose(configuration)
        parts, instants, in_contact = self._felt_by_bubbles(track, tool_pose)
        self.raw.moved(tool_pose)
        swept, _ = self._space.swept(tool_pose, self._inner, measured, in_contact, self._camera.region)
        parts.append(Observation.of(swept.points, Semantics.FREE))
        instants.append(swept.instant)
        return Reading(
            concatenate(parts),
            torch.cat(instants),
            tool_pose,
            in_contact,
            measured,
            configuration[-1],
            refused,
            float(self.world.data.time),
        )

    def _felt_by_bubbles(
        self, track: Track, tool_pose: Float[Tensor, "K 4 4"]
    ) -> tuple[list[Observation], list[Tensor], Bool[Tensor, "K"]]:
        """Patches and free membrane at each mini step, and when anything was felt."""
        parts: list[Observation] = []
        instants: list[Tensor] = []
        in_contact = torch.zeros(len(tool_pose), dtype=torch.bool)
        true_pose = self._true_pose(track)
        near = self._near(track, true_pose) if self._bubbles else []
        for index in range(len(tool_pose)):
            taken = max(0, index - self._late)  # the image that arrives now
            for which in range(len(self._bubbles)):
                image = self._image(self._bubbles[which], track, true_pose, taken, near[taken])
                if image is not None:
                    self.raw.bubble(which, index, image)
                    patch = bubble_patch(self._believed[which], image, tool_pose[index])
                    parts.append(patch.observation)
                    instants.append(torch.full((len(patch.observation),), index, dtype=torch.long))
                    in_contact[index] |= bool(patch.contact.any())
        return parts, instants, in_contact

    def _near(self, track: Track, tool_pose: Float[Tensor, "K 4 4"]) -> list[bool]:
        """Whether the object is near a bubble at each mini step; elsewhere its membrane is at rest."""
        pads = torch.tensor(self.shape.pad_centers).double()
        there = se3.apply(se3.inverse(track.world_T_object) @ tool_pose.double(), pads.expand(len(tool_pose), -1, 3))
        with torch.no_grad():
            away = self._true.distance(there.float()).amin(-1)
        near: list[bool] = (away < max(self.shape.pad_m) + self.sensors.membrane_m + _NEAR_M).tolist()
        return near

    def _image(
        self, camera: BubbleCamera, track: Track, tool_pose: Float[Tensor, "K 4 4"], taken: int, near: bool
    ) -> Float[Tensor, "H W"] | None:
        """One image of one bubble; None where it was lost. Rays are cast where the object is near alone."""
        if self._lost():
            return None
        image = camera.rest
        if near:
            tool, pose = tool_pose[taken].double(), track.world_T_object[taken]
            origin, ways = camera.ways(tool)
            met, _ = self.world.cast(origin, ways, at=(track.configuration[taken], pose), through_gripper=True)
            image = camera.image(met)
        return _seen(image, self.sensors.bubble_noise_m, self._generator).float()


def _seen(depth: Tensor, noise_m: float, generator: torch.Generator) -> Tensor:
    """An image with noise; what is not known stays so."""
    if noise_m == 0:
        return depth
    noisy = depth + noise_m * torch.randn(depth.shape, generator=generator, dtype=depth.dtype)
    return torch.where(depth > 0, noisy, depth)
