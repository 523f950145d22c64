"""Surface and free points of a depth image: units, edges, segmentation, the robot's own body, persistence."""

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3
from sdf.bounds import Checked, Count
from sdf.check import check_finite, check_near, check_shape
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from sensors.vision.camera import free_lattice, pixel_points
from sensors.vision.depth_filters import EdgeSettings, nearest_about, reliable
from sensors.vision.images import Unit, depth_metres, known, undistorted
from sensors.vision.persistence import Persistence
from sensors.vision.robot_body import RobotBody
from sensors.vision.segmentation import Plane, Range, cluster_mask, color_mask, fit_plane

Segmentation = Literal["mask", "color", "plane"]


@dataclass(frozen=True)
class ViewSettings(Checked):
    """Settings of the conversion of a camera's frame to points.

    Attributes:
        segmentation: the object is a given "mask", has a "color", or is what stands on a "plane".
        hue_deg, saturation, value: its colour, from and to (`segmentation.color_mask`).
        clearance_m: what is farther than this in front of the plane stands on it.
        plane_tolerance_m: a point this near the plane is on it.
        cluster: keep the largest connected patch alone.
        cluster_px: pixels that a patch must have.
        unit: of the depth image (`images.depth_metres`).
        near_m, far_m: depths that the camera can tell.
        distortion: of the lens; none where the camera has removed it.
        edges: pixels that are not relied on; None to rely on all.
        body_margin_m: what is this near the robot's body is the robot.
        persist_s: a pixel must have shown the object for so long; 0 for frames that each stand alone.
        persist_tolerance_m: by which its depth may vary meanwhile.
        persist_gap_s: for which it may be missing meanwhile.
        free_spacing_m: of the free points, on the world's lattice.
        free_margin_m: before what is seen, up to which space is reported free.
        free_fraction: part of the seen depth, in place of the margin (RUMI: 0.95).
        free_rim_px: free space stays this many pixels clear of what is nearer, which covers mixed depths at edges.
    """

    segmentation: Segmentation = "mask"
    hue_deg: Range = (0.0, 360.0)
    saturation: Range = (0.25, 1.0)
    value: Range = (0.15, 1.0)
    clearance_m: float = 0.010
    plane_tolerance_m: float = 0.006
    cluster: bool = True
    cluster_px: int = 50
    unit: Unit | float = "auto"
    near_m: float = 0.0
    far_m: float = math.inf
    distortion: tuple[float, ...] = ()
    edges: EdgeSettings | None = field(default_factory=EdgeSettings)
    body_margin_m: float = 0.010
    persist_s: float = 0.0
    persist_tolerance_m: float = 0.010
    persist_gap_s: float = 0.1
    free_spacing_m: float = 0.005
    free_margin_m: float = 0.010
    free_fraction: float | None = None
    free_rim_px: Count = 2


@dataclass(frozen=True)
class Image:
    """A depth image of a pinhole camera, whose frame has z forward, x right, y down.

    Attributes:
        depth: (H, W), in the unit of the `ViewSettings`.
        intrinsics: (3, 3), pixels, for pixel centres at whole numbers.
        color: (H, W, 3), bytes, red, green, blue, aligned with the depth; for the segmentation "color".
        mask: (H, W), the object's pixels; for the segmentation "mask".
        stamp: seconds; needed where pixels must persist.
    """

    depth: np.ndarray | Tensor
    intrinsics: Float[Tensor, "3 3"]
    color: np.ndarray | Tensor | None = None
    mask: Bool[Tensor, "H W"] | None = None
    stamp: float | None = None


@dataclass(frozen=True)
class KnownScene:
    """Prior knowledge of the scene of an image: the robot's body and bounds.

    Attributes:
        plane: that the object stands on, camera frame; None fits it, which draws from a generator.
        body: the robot's; None where it is never seen.
        world_T_links: (L, 4, 4), poses of its links.
        within: (2, 3), metres, box of the world that holds the object; None for anywhere.
        bounds: (2, 3), metres, box of the world to report free points in; None for no free points.
    """

    plane: Plane | None = None
    body: RobotBody | None = None
    world_T_links: Float[Tensor, "L 4 4"] | None = None
    within: Float[Tensor, "2 3"] | None = None
    bounds: Float[Tensor, "2 3"] | None = None


class View(NamedTuple):
    """Surface and free points of one image.

    Attributes:
        observation: world points, surface ones first, all attached to the object.
        surface: (H, W), the pixels of the surface points.
        memory: hand it to the next image's call; None where images stand alone.
    """

    observation: Observation
    surface: Bool[Tensor, "H W"]
    memory: Persistence | None


def view_observation(
    image: Image,
    world_T_camera: Float[Tensor, "4 4"],
    settings: ViewSettings | None = None,
    scene: KnownScene | None = None,
    *,
    memory: Persistence | None = None,
    generator: torch.Generator | None = None,
) -> View:
    """Surface points (M, 3) of the object and free points of the space before it, world frame, metres, of one image.

    What is no surface of the object, the robot's body included, still bounds free space.

    Args:
        image: of the camera.
        world_T_camera: (4, 4), pose of the camera when it took the image.
        settings: of segmentation and filters.
        scene: what is known of the robot and the object's place.
        memory: of the image before, where pixels must persist.
        generator: of random numbers; needed to fit a plane.

    Raises:
        ValueError: what the settings need was not given, or shapes do not fit.
    """
    scene, intrinsics = scene or KnownScene(), image.intrinsics
    settings = settings or ViewSettings()
    check_shape("intrinsics", intrinsics, "(3, 3)", last=(3, 3))
    check_shape("world_T_camera", world_T_camera, "(4, 4)", last=(4, 4))
    check_finite("intrinsics", intrinsics)
    check_finite("world_T_camera", world_T_camera)
    metres = depth_metres(image.depth, settings.unit, near_m=settings.near_m, far_m=settings.far_m)
    check_near("world_T_camera", world_T_camera[:3, 3], metres.dtype)
    intrinsics, world_T_camera = intrinsics.to(metres), world_T_camera.to(metres)
    metres = undistorted(metres, intrinsics, settings.distortion)
    seen = known(metres) if settings.edges is None else reliable(metres, intrinsics, settings.edges)
    surface = seen & _candidates(metres, intrinsics, seen, settings, image, scene.plane, generator)
    surface = _without(surface, metres, intrinsics, world_T_camera, scene, settings.body_margin_m)
    if settings.cluster and settings.segmentation != "mask":
        surface = cluster_mask(surface, least_px=settings.cluster_px)
    shown = metres
    if settings.persist_s > 0:
        if image.stamp is None:
            raise ValueError("Expected a stamp for a frame whose pixels must persist, got None")
        memory = Persistence.start(*metres.shape) if memory is None else memory
        memory, lasting = memory.seen(
            metres,
            surface,
            image.stamp,
            window_s=settings.persist_s,
            tolerance_m=settings.persist_tolerance_m,
            gap_s=settings.persist_gap_s,
        )
        surface, shown = lasting
    points = se3.apply(world_T_camera, pixel_points(shown, surface, intrinsics))
    observation = Observation.of(points, Semantics.SURFACE)
    if scene.bounds is not None:
        free = free_lattice(
            nearest_about(metres, settings.free_rim_px),
            intrinsics,
            world_T_camera,
            scene.bounds,
            spacing=settings.free_spacing_m,
            margin_m=settings.free_margin_m,
            fraction=settings.free_fraction,
        )
        observation = concatenate([observation, Observation.of(free, Semantics.FREE)])
    return View(observation, surface, memory)


def _candidates(
    metres: Tensor,
    intrinsics: Tensor,
    seen: Tensor,
    settings: ViewSettings,
    image: Image,
    plane: Plane | None,
    generator: torch.Generator | None,
) -> Bool[Tensor, "H W"]:
    """Pixels that may be the object."""
    shape, color, mask = tuple(metres.shape), image.color, image.mask
    if settings.segmentation == "mask":
        if mask is None or tuple(mask.shape) != shape:
            got = "None" if mask is None else tuple(mask.shape)
            raise ValueError(f"Expected a mask of the object of depth's shape {shape}, got {got}")
        return torch.as_tensor(mask, dtype=torch.bool)
    if settings.segmentation == "color":
        if color is None or tuple(color.shape[:2]) != shape:
            got = "None" if color is None else tuple(color.shape)
            raise ValueError(f"Expected a colour image aligned with depth, {(*shape, 3)}, got {got}")
        return color_mask(color, settings.hue_deg, settings.saturation, settings.value)
    if plane is None:
        if generator is None:
            raise ValueError("Expected a plane, or a generator of random numbers to fit one with, got neither")
        some = torch.zeros_like(seen)
        some[::3, ::3] = seen[::3, ::3]
        points = pixel_points(metres, some, intrinsics)
        plane = fit_plane(points, tolerance_m=settings.plane_tolerance_m, generator=generator)
    # the height of a pixel's point is its depth times that of its ray, which is linear in row and column
    slopes = plane.normal.to(intrinsics) @ torch.linalg.inv(intrinsics)
    rows, columns = (torch.arange(size, dtype=metres.dtype) for size in shape)
    along = (slopes[1] * rows + slopes[2])[:, None] + slopes[0] * columns
    return along.mul_(metres) > plane.offset + settings.clearance_m


def _without(
    surface: Tensor,
    metres: Tensor,
    intrinsics: Tensor,
    world_T_camera: Tensor,
    scene: KnownScene,
    body_margin_m: float,
) -> Bool[Tensor, "H W"]:
    """The pixels without those of the robot and those out of the box."""
    if scene.body is None and scene.within is None:
        return surface
    points = se3.apply(world_T_camera, pixel_points(metres, surface, intrinsics))
    kept = torch.ones(len(points), dtype=torch.bool)
    if scene.within is not None:
        low, high = scene.within.to(points)
        kept &= ((points >= low) & (points <= high)).all(-1)
    if scene.body is not None:
        if scene.world_T_links is None:
            raise ValueError("Expected world_T_links, where the body's links were, got None")
        kept[kept.clone()] = ~scene.body.near(points[kept], scene.world_T_links, body_margin_m)
    left = torch.zeros_like(surface)
    left[surface] = kept
    return left
