"""Scenes in closed form as a camera and a soft bubble would see them, with their noise: what converters are held to."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3
from sdf.base import SDF
from sdf.primitives import Box, Sphere
from sensors.vision.camera import look_at, pinhole, pixel_rays

_STEPS = 200
_HIT_M = 1e-6


class SceneView(NamedTuple):
    """One view of an object on the floor, without noise.

    Attributes:
        shape: the object.
        world_T_object: (4, 4).
        depth: (H, W), metres; infinite where nothing is met.
        mask: (H, W), the object's pixels.
        color: (H, W, 3), bytes: the object blue, the floor grey.
        intrinsics: (3, 3).
        world_T_camera: (4, 4).
    """

    shape: SDF
    world_T_object: Float[Tensor, "4 4"]
    depth: Float[Tensor, "H W"]
    mask: Bool[Tensor, "H W"]
    color: Tensor
    intrinsics: Float[Tensor, "3 3"]
    world_T_camera: Float[Tensor, "4 4"]

    def distance(self, points_w: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
        """Signed distance of world points from the object, metres."""
        with torch.no_grad():
            return self.shape.distance(se3.apply(se3.inverse(self.world_T_object), points_w.double()))


SCENES = ("plane", "sphere", "box")


def scene_view(name: str, height: int = 480, width: int = 640) -> SceneView:
    """A board that leans back, a ball or a box on the floor, 0.7 m before the camera."""
    shape, pose = _object(name)
    eye, target = torch.tensor([-0.25, 0.05, 0.30]).double(), torch.tensor([0.40, 0.0, 0.04]).double()
    intrinsics = pinhole(height, width, math.radians(45.0), dtype=torch.float64)
    world_T_camera = look_at(eye, target)
    rays = pixel_rays(height, width, intrinsics).reshape(-1, 3)
    ways = rays @ world_T_camera[:3, :3].mT
    along = traced(shape.double(), se3.inverse(pose), eye, ways)
    floor = torch.where(ways[:, 2] < 0, -eye[2] / ways[:, 2], torch.full_like(along, math.inf))
    mask = (along <= floor) & torch.isfinite(along)
    depth = torch.minimum(along, floor).reshape(height, width)
    color = torch.full((height * width, 3), 120, dtype=torch.uint8)
    color[mask] = torch.tensor([30, 60, 200], dtype=torch.uint8)
    return SceneView(
        shape,
        pose,
        depth,
        mask.reshape(height, width),
        color.reshape(height, width, 3),
        intrinsics.float(),
        world_T_camera.float(),
    )


def _object(name: str) -> tuple[SDF, Float[Tensor, "4 4"]]:
    if name == "sphere":
        return Sphere(0.05), se3.from_planar(torch.tensor([0.40, 0.0, 0.0]).double(), 0.05)
    if name == "box":
        return Box((0.03, 0.05, 0.06)), se3.from_planar(torch.tensor([0.38, 0.02, 0.6]).double(), 0.06)
    if name == "plane":
        lean = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]).double())
        return Box((0.002, 0.10, 0.08)), se3.from_planar(torch.tensor([0.40, 0.0, 0.2]).double(), 0.09) @ lean
    raise ValueError(f"Expected a scene of {', '.join(SCENES)}, got {name!r}")


def traced(
    shape: SDF, object_T_world: Float[Tensor, "4 4"], eye: Float[Tensor, "3"], ways: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """How many times its own length each ray goes to a shape, to a thousandth of a millimetre; infinite for none."""
    length = ways.norm(dim=-1)
    ways_o = ways @ object_T_world[:3, :3].mT / length[:, None]
    eye_o = se3.apply(object_T_world, eye[None])[0]
    gone = torch.zeros_like(length)
    left = torch.arange(len(ways))
    with torch.no_grad():
        for _ in range(_STEPS):
            step = shape.distance(eye_o + gone[left, None] * ways_o[left])
            gone[left] += step
            left = left[(step > _HIT_M) & (gone[left] < 3.0)]
        away = shape.distance(eye_o + gone[:, None] * ways_o)
    return torch.where(away.abs() < 10 * _HIT_M, gone / length, torch.full_like(gone, math.inf))


def with_noise(
    depth: Float[Tensor, "H W"],
    noise_m: float,
    *,
    lost: float = 0.0,
    mixed: bool = False,
    generator: torch.Generator,
) -> Float[Tensor, "H W"]:
    """A depth image as a camera would give it.

    Args:
        depth: (H, W), metres.
        noise_m: standard deviation of each pixel.
        lost: part of the pixels that are not known, 0.
        mixed: at edges, half of the pixels lie anywhere between the two depths.
        generator: of the noise.
    """
    found = depth.clone()
    if mixed:
        reach = torch.nn.functional.pad(depth[None, None].clamp_max(5.0), (1, 1, 1, 1), mode="replicate")
        far = torch.nn.functional.max_pool2d(reach, 3, 1)[0, 0]
        near = -torch.nn.functional.max_pool2d(-reach, 3, 1)[0, 0]
        edge = (far - near > 0.02) & (torch.rand(depth.shape, generator=generator) < 0.5)
        share = torch.rand(depth.shape, generator=generator, dtype=depth.dtype)
        found = torch.where(edge, near + share * (far - near), found)
    if noise_m > 0:
        found = found + noise_m * torch.randn(depth.shape, generator=generator, dtype=depth.dtype)
    if lost > 0:
        found = found.masked_fill(torch.rand(depth.shape, generator=generator) < lost, 0.0)
    return found


class PressedBubble(NamedTuple):
    """A soft bubble that something is pressed into, without noise; the tool's frame is the camera's.

    Attributes:
        shape: what is pressed in.
        world_T_object: (4, 4).
        rest: (H, W), metres, depth of the membrane at rest.
        depth: (H, W), metres, where it is now: it clings to what is pressed in.
        intrinsics: (3, 3).
    """

    shape: SDF
    world_T_object: Float[Tensor, "4 4"]
    rest: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
    intrinsics: Float[Tensor, "3 3"]

    def distance(self, points_w: Float[Tensor, "M 3"]) -> Float[Tensor, "M"]:
        """Signed distance of points from what is pressed in, metres."""
        with torch.no_grad():
            return self.shape.distance(se3.apply(se3.inverse(self.world_T_object), points_w.double()))


_TOP_M = 0.075  # of the membrane above the camera
_CAP_M = 0.05  # radius of the membrane


def pressed_bubble(name: str, press_m: float = 0.008, height: int = 171, width: int = 224) -> PressedBubble:
    """A plate, a ball of 20 mm or a box of 20 mm pressed by so much into the top of a bubble of 50 mm radius."""
    intrinsics = pinhole(height, width, math.radians(45.0), dtype=torch.float64)
    rays = pixel_rays(height, width, intrinsics).reshape(-1, 3)
    # the far side of a ball about (0, 0, top - radius)
    center = torch.tensor([0.0, 0.0, _TOP_M - _CAP_M]).double()
    a, b = (rays * rays).sum(-1), rays @ center
    rest = (b + (b * b - a * (center @ center - _CAP_M**2)).clamp_min(0).sqrt()) / a
    shape: SDF
    if name == "sphere":
        shape, deep = Sphere(0.02), 0.02
    elif name == "box":
        shape, deep = Box((0.02, 0.01, 0.01)), 0.01
    elif name == "plane":
        shape, deep = Box((0.10, 0.10, 0.01)), 0.01
    else:
        raise ValueError(f"Expected one of {', '.join(SCENES)}, got {name!r}")
    pose = se3.identity(dtype=torch.float64)
    pose[2, 3] = _TOP_M + deep - press_m
    met = traced(shape.double(), se3.inverse(pose), torch.zeros(3).double(), rays)
    size = (height, width)
    return PressedBubble(shape, pose, rest.reshape(size), torch.minimum(rest, met).reshape(size), intrinsics.float())
