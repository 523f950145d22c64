"""Depth camera of a simulated task: where it stands, what it sees, and which pixels the robot knows to be its own."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.sim.view_faults import ViewFaults
from rumi.sim.world import World
from rumi.tasks.rummage.scene_spec import CameraSpec
from sdf import se3
from sensors.vision.camera import look_at, pinhole, pixel_points, pixel_rays
from sensors.vision.robot_body import RobotBody

_CUT_M = 0.010  # about the floor and the gripper, within which what a wrong mask shows is not taken for the object


def moved(camera: CameraSpec, faults: ViewFaults) -> CameraSpec:
    """The camera at the place where it stands in a run."""
    if faults.errors.eye_m == 0:
        return camera
    x, y, z = (torch.tensor(camera.position).double() + faults.eye_m).tolist()
    return replace(camera, position=(x, y, z))


def cast_pixels(world: World, camera: CameraSpec) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"], Float[Tensor, "n"]]:
    """True depth of each pixel (infinite where nothing is met), whether it shows the object, and how high that is."""
    intrinsics = pinhole(camera.height, camera.width, camera.field_of_view_rad, dtype=torch.float64)
    pose = look_at(torch.tensor(camera.position).double(), torch.tensor(camera.target).double())
    rays = pixel_rays(camera.height, camera.width, intrinsics).reshape(-1, 3) @ pose[:3, :3].mT
    # directions with a forward part of 1: the distance along them is the depth
    depth, is_object = world.cast(pose[:3, 3], rays)
    return depth, is_object, pose[2, 3] + depth * rays[:, 2]


def depth_image(
    world: World, camera: CameraSpec, faults: ViewFaults, noise_m: float, generator: torch.Generator
) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Depth (H, W), metres, infinite where nothing is met, 0 where nothing is known; and the object's mask (H, W).

    Args:
        world: with the object and the gripper.
        camera: where it stands.
        faults: of the camera.
        noise_m: standard deviation of the task's own noise of depth.
        generator: of that noise.
    """
    depth, is_object, _ = cast_pixels(world, camera)
    if noise_m > 0:
        depth = depth + noise_m * torch.randn(depth.shape, generator=generator, dtype=depth.dtype)
    shape = (camera.height, camera.width)
    return faults.noisy(depth.reshape(shape).float()), faults.masked(is_object.reshape(shape))


def without_robot(
    mask: Bool[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    intrinsics: Float[Tensor, "3 3"],
    world_T_camera: Float[Tensor, "4 4"],
    links: RobotBody,
    world_T_tool: Float[Tensor, "1 4 4"],
) -> Bool[Tensor, "H W"]:
    """A mask without what shows the floor or the gripper, whose places the robot knows."""
    shown = mask & torch.isfinite(depth) & (depth > 0)
    points = se3.apply(world_T_camera, pixel_points(depth, shown, intrinsics))
    kept = mask.clone()
    near = links.near(points, world_T_tool.expand(len(links.links), 4, 4), _CUT_M)
    kept[shown] = (points[:, 2] > _CUT_M) & ~near
    return kept
