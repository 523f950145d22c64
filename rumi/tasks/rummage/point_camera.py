"""The camera of a simulated task that reports points: surface of the object, and free space about it."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.sim.settings import SimSettings
from rumi.sim.view_faults import ViewFaults, taken_pose
from rumi.sim.world import World
from rumi.tasks.rummage.depth_camera import depth_image, moved, without_robot
from rumi.tasks.rummage.free_region import floor_points, region_about, region_of_prior, region_unseen
from rumi.tasks.rummage.scene_spec import CameraSpec, TaskSpec
from sdf.object_model import ObjectModel
from sensors.observation import Observation
from sensors.vision.camera import depth_observation, look_at, pinhole
from sensors.vision.robot_body import RobotBody


class PointCamera:
    """What a task's camera sees in one run, and the `region` (2, 3) in which free points are reported.

    Args:
        spec: the task.
        settings: of the simulator and its sensors.
        model: the object.
        links: the gripper, which the robot takes out of a wrong mask.
        faults: of the camera in this run.
        generator: of the task's own noise of depth.
    """

    def __init__(
        self,
        spec: TaskSpec,
        settings: SimSettings,
        model: ObjectModel,
        links: RobotBody,
        faults: ViewFaults,
        generator: torch.Generator,
    ) -> None:
        self.spec, self.settings, self.model, self.links, self.faults = spec, settings, model, links, faults
        self.generator = generator
        self.region = torch.zeros(2, 3)

    def view(self, world: World, world_T_tool: Float[Tensor, "1 4 4"], *, first: bool) -> Observation:
        """What it sees now, of a task without a camera free points of the floor; keeps the region of what it sees.

        Where nothing of the object shows later on, that is what it sees through where the object was last.

        Args:
            world: with the object and the gripper.
            world_T_tool: where the robot takes its tool to be.
            first: whether this is the first view of the run, which tells the region where nothing shows, too.
        """
        camera, spec = self.place, self.spec
        if camera is None:
            self.region = region_of_prior(spec, self.model)
            return Observation.empty() if spec.search == "SE(2)" else floor_points(self.region, spec)
        settings, sensors = self.settings, self.settings.sensors
        intrinsics = pinhole(camera.height, camera.width, camera.field_of_view_rad)
        world_T_camera = look_at(torch.tensor(camera.position), torch.tensor(camera.target))
        if sensors.calibration_m or sensors.calibration_rad:
            world_T_camera = taken_pose(world_T_camera.double(), self.faults.off, sensors, camera.target).float()
        depth, is_object = self.depth_image(world)
        if settings.view.mask_px:
            is_object = without_robot(is_object, depth, intrinsics, world_T_camera, self.links, world_T_tool)
        surface = depth_observation(depth, intrinsics, world_T_camera, is_object).points
        if len(surface) == 0 and first:
            self.region = region_unseen(spec, self.model)
            return Observation.empty()
        if len(surface):
            self.region = region_about(surface, spec, settings)
        return depth_observation(
            depth,
            intrinsics,
            world_T_camera,
            is_object,
            bounds=self.region,
            free_spacing=settings.free_spacing_m,
            free_margin_m=settings.free_margin_m,
            free_fraction=settings.free_fraction,
        )

    @property
    def place(self) -> CameraSpec | None:
        """The camera where it stands in this run, which is known."""
        return None if self.spec.camera is None else moved(self.spec.camera, self.faults)

    def depth_image(self, world: World) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
        """Depth and the object's mask, as `rumi.tasks.rummage.depth_camera.depth_image` has them, of what is there now.

        Raises:
            UsageError: the task has no camera.
        """
        camera = self.place
        if camera is None:
            raise UsageError(f"Expected a task with a camera, got {self.spec.name}")
        return depth_image(world, camera, self.faults, self.spec.depth_noise_m, self.generator)
