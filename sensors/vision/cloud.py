"""Surface and free points of a point cloud, read as the depth image that it was or could have been."""

import math
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from sdf import se3
from sdf.check import check_shape
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from sensors.vision.persistence import Persistence
from sensors.vision.segmentation import color_mask, fit_plane
from sensors.vision.view import Image, KnownScene, View, ViewSettings, view_observation

_FIT_POINTS = 20_000  # that intrinsics are fitted to, about
_FIT_PX = 1.0  # an organised cloud whose points are farther than this from their pixels is of no pinhole camera
_A_PIXEL, _MOST_PX = 4.0, 2000  # points of a pixel that has any, in the middle, and rows or columns at most


class Pinhole(NamedTuple):
    """A camera that a cloud can be drawn in.

    Attributes:
        intrinsics: (3, 3), for pixel centres at whole numbers.
        height: rows.
        width: columns.
    """

    intrinsics: Float[Tensor, "3 3"]
    height: int
    width: int


def cloud_observation(
    points: Float[Tensor, "*m 3"],
    world_T_camera: Float[Tensor, "4 4"],
    settings: ViewSettings | None = None,
    scene: KnownScene | None = None,
    *,
    frame: Literal["camera", "world"] = "camera",
    pinhole: Pinhole | None = None,
    colors: UInt8[Tensor, "*m 3"] | None = None,
    mask: Bool[Tensor, "*m"] | None = None,
    stamp: float | None = None,
    memory: Persistence | None = None,
    generator: torch.Generator | None = None,
) -> View:
    """Surface and free points of one cloud; arguments and filters are those of `view_observation`.

    An organised cloud is the image of a pinhole camera whose intrinsics follow from it. Points without order are drawn
    into an image with about four points a pixel; what is returned are the points themselves, all those of a pixel
    that are not behind its nearest one.

    Args:
        points: (M, 3), or (H, W, 3) in the order of a camera's pixels, metres; NaN where nothing is known.
        world_T_camera: (4, 4), from where the cloud was seen: z forward.
        settings: of segmentation and filters.
        scene: what is known of the robot and the object's place.
        frame: that the points are in.
        pinhole: the camera to draw points without order in; needed where pixels must persist from cloud to cloud.
        colors: bytes, red, green, blue, one a point.
        mask: which points are the object's.
        stamp: seconds.
        memory: of the cloud before.
        generator: of random numbers.

    Raises:
        ValueError: no points to be seen, or an organised cloud of no pinhole camera.
    """
    settings = settings or ViewSettings()
    check_shape("points", points, "(*m, 3)", last=(3,))
    if points.ndim not in (2, 3):
        raise ValueError(f"Expected points (M, 3) or (H, W, 3), got {tuple(points.shape)}")
    world_T_camera = world_T_camera.to(points)
    if frame == "world":
        shape = points.shape
        points = se3.apply(se3.inverse(world_T_camera), points.reshape(-1, 3)).reshape(shape)
    scene = scene or KnownScene()
    settings = replace(settings, unit="m", distortion=())
    if points.ndim == 3:
        seen = torch.isfinite(points).all(-1) & (points[..., 2] > 0)
        depth = torch.where(seen, points[..., 2], torch.zeros_like(points[..., 2]))
        intrinsics = organised_intrinsics(points)
        image = Image(depth, intrinsics, colors, mask, stamp)
        return view_observation(image, world_T_camera, settings, scene, memory=memory, generator=generator)
    if settings.segmentation == "plane" and scene.plane is None and generator is not None:
        there = points[torch.isfinite(points).all(-1)]
        plane = fit_plane(there, tolerance_m=settings.plane_tolerance_m, generator=generator)
        scene = replace(scene, plane=plane)
    pinhole = pinhole or pinhole_about(points)
    if settings.edges is not None:
        # a pixel without a point is chance here, not a shadow
        settings = replace(settings, edges=replace(settings.edges, rim_px=0))
    pixel = _pixels(points, pinhole)
    depth, first = _drawn(points, pixel, pinhole)
    met, winner = first >= 0, first.clamp_min(0)
    image = Image(
        depth,
        pinhole.intrinsics,
        None if colors is None else colors[winner] * met[..., None].to(colors.dtype),
        None if mask is None else mask[winner] & met,
        stamp,
    )
    view = view_observation(image, world_T_camera, settings, scene, memory=memory, generator=generator)
    jump = settings.edges.jump_m if settings.edges is not None else 0.0
    inside = pixel >= 0
    place = pixel.clamp_min(0)
    own = inside & view.surface.reshape(-1)[place] & (points[:, 2] <= depth.reshape(-1)[place] + jump)
    # a pixel that shows the object may have points of what is about it
    if settings.segmentation == "mask" and mask is not None:
        own &= mask
    elif settings.segmentation == "color" and colors is not None:
        own &= color_mask(colors[None], settings.hue_deg, settings.saturation, settings.value, clean_px=0)[0]
    elif scene.plane is not None:
        own &= scene.plane.height(points) > settings.clearance_m
    surface = Observation.of(se3.apply(world_T_camera, points[own]), Semantics.SURFACE)
    rest = view.observation.of_class(Semantics.FREE)
    return View(concatenate([surface, view.observation[rest]]), view.surface, view.memory)


def organised_intrinsics(points: Float[Tensor, "H W 3"]) -> Float[Tensor, "3 3"]:
    """Intrinsics of the pinhole camera that an organised cloud is of, by least squares.

    Args:
        points: (H, W, 3), camera frame with z forward; NaN where nothing is known.

    Raises:
        ValueError: fewer than 10 points, or points that are off their pixels: the cloud is not in its camera's frame,
            or its camera has no pinhole or an image that is not rectified.
    """
    seen = torch.isfinite(points).all(-1) & (points[..., 2] > 0)
    if int(seen.sum()) < 10:
        raise ValueError(
            f"Expected an organised cloud with at least 10 points before the camera, got {int(seen.sum())}"
        )
    place = seen.nonzero()
    place = place[:: max(1, len(place) // _FIT_POINTS)]
    own = points[place[:, 0], place[:, 1]].double()
    v, u = place.double().unbind(-1)
    intrinsics, worst = torch.eye(3, dtype=torch.float64), 0.0
    for axis, pixel in ((0, u), (1, v)):
        table = torch.stack((own[:, axis] / own[:, 2], torch.ones_like(pixel)), -1)
        found = torch.linalg.lstsq(table, pixel[:, None]).solution[:, 0]
        intrinsics[axis, axis], intrinsics[axis, 2] = found
        worst = max(worst, float((table @ found - pixel).abs().quantile(0.95)))
    if not worst <= _FIT_PX or not bool((intrinsics.diagonal() > 0).all()):
        raise ValueError(
            f"Expected an organised cloud of a pinhole camera in the camera's frame (z forward, x right, y down), got "
            f"points {worst:.1f} pixels off: give it as points without order, (M, 3), or in the camera's frame"
        )
    return intrinsics.to(points)


def pinhole_about(points: Float[Tensor, "M 3"]) -> Pinhole:
    """The camera in which a cloud without order fills an image with some points a pixel.

    Args:
        points: (M, 3), camera frame with z forward.

    Raises:
        ValueError: no point lies before the camera, or all are aside of it.
    """
    ahead = points[torch.isfinite(points).all(-1) & (points[:, 2] > 1e-3)]
    if len(ahead) == 0:
        raise ValueError("Expected points before the camera (z > 0), got none: z points forward in its frame")
    flat = ahead[:, :2] / ahead[:, 2:]
    # what is seen at more than 75 degrees off the axis is left out
    flat = flat[(flat.abs() < math.tan(math.radians(75.0))).all(-1)]
    if len(flat) == 0:
        raise ValueError(
            f"Expected points within 75 degrees of the camera's axis (z), got {len(ahead)} and all beyond: z points "
            "forward in its frame; does world_T_camera look at them?"
        )
    low, high = flat.amin(0), flat.amax(0)
    # a coarse image tells which part of the rectangle has points at all
    extent = (high - low).clamp_min(1e-4)
    cells = ((flat - low) / extent * 63.999).long()
    covered = len(torch.unique(cells[:, 0] * 64 + cells[:, 1])) / 64.0**2
    focal = math.sqrt(len(flat) / (_A_PIXEL * covered * float(extent.prod())))
    focal = min(focal, _MOST_PX / float(extent.max()))
    width, height = (max(2, math.ceil(float(side) * focal) + 1) for side in extent)
    intrinsics = torch.tensor(
        [[focal, 0.0, -focal * float(low[0])], [0.0, focal, -focal * float(low[1])], [0.0, 0.0, 1.0]]
    )
    return Pinhole(intrinsics.to(points), height, width)


def _pixels(points: Tensor, pinhole: Pinhole) -> Int[Tensor, "M"]:
    """Pixel of each point, row after row; -1 for what is not in the image."""
    ahead = torch.isfinite(points).all(-1) & (points[:, 2] > 1e-3)
    safe = torch.where(ahead[:, None], points, torch.ones_like(points))
    flat = ((safe / safe[:, 2:]) @ pinhole.intrinsics.to(points).mT)[:, :2].round().long()
    inside = ahead & (flat >= 0).all(-1) & (flat[:, 0] < pinhole.width) & (flat[:, 1] < pinhole.height)
    return torch.where(inside, flat[:, 1] * pinhole.width + flat[:, 0], torch.full_like(flat[:, 0], -1))


def _drawn(points: Tensor, pixel: Tensor, pinhole: Pinhole) -> tuple[Float[Tensor, "H W"], Int[Tensor, "H W"]]:
    """Depth of the nearest point of each pixel, 0 for none, and its index, -1 for none."""
    size = pinhole.height * pinhole.width
    index = (pixel >= 0).nonzero()[:, 0]
    # the farthest first: what is written last stays
    index = index[torch.argsort(points[index, 2], descending=True, stable=True)]
    rank = torch.full((size,), -1, dtype=torch.long)
    rank.scatter_reduce_(0, pixel[index], torch.arange(len(index)), "amax")
    first = torch.where(rank >= 0, index[rank.clamp_min(0)] if len(index) else rank, torch.full_like(rank, -1))
    depth = torch.where(first >= 0, points[first.clamp_min(0), 2], torch.zeros(size, dtype=points.dtype))
    return depth.reshape(pinhole.height, pinhole.width), first.reshape(pinhole.height, pinhole.width)
