"""Depth images: surface points of an object and free space in front of what is seen."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3
from sdf.check import check_finite, check_shape
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics


def pinhole(
    height: int, width: int, field_of_view: float, *, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "3 3"]:
    """Intrinsics of a camera with square pixels whose axis meets the middle of the image.

    Args:
        height: rows of the image.
        width: columns.
        field_of_view: vertical, radians.
        dtype: of the result.
    """
    focal = 0.5 * height / math.tan(0.5 * field_of_view)
    return torch.tensor(
        [[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]], dtype=dtype
    )


def look_at(eye: Float[Tensor, "3"], target: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """world_T_camera of a level camera (z forward, x right, y down); not for looking straight up or down."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    up = forward.new_tensor((0.0, 0.0, 1.0))
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6:
        raise ValueError(f"Expected target not to lie straight above or below eye, got {target} and {eye}")
    right = torch.nn.functional.normalize(right, dim=0)
    return se3.make(torch.stack((right, torch.linalg.cross(forward, right), forward), -1), eye)


def pixel_rays(height: int, width: int, intrinsics: Float[Tensor, "3 3"]) -> Float[Tensor, "H W 3"]:
    """Directions in the camera's frame through the pixels' centres, whose z is 1: a ray's length is its depth."""
    rows = torch.arange(height, dtype=intrinsics.dtype, device=intrinsics.device)
    columns = torch.arange(width, dtype=intrinsics.dtype, device=intrinsics.device)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    x = (u - intrinsics[0, 2] - intrinsics[0, 1] * (v - intrinsics[1, 2]) / intrinsics[1, 1]) / intrinsics[0, 0]
    return torch.stack((x, (v - intrinsics[1, 2]) / intrinsics[1, 1], torch.ones_like(x)), -1)


def depth_observation(
    depth: Float[Tensor, "H W"],
    intrinsics: Float[Tensor, "3 3"],
    world_T_camera: Float[Tensor, "4 4"],
    object_mask: Bool[Tensor, "H W"],
    *,
    bounds: Float[Tensor, "2 3"] | None = None,
    free_spacing: float = 0.005,
    free_margin_m: float = 0.010,
    free_fraction: float | None = None,
) -> Observation:
    """Surface points on the object and free points in front of everything that a depth image shows.

    Surface points are the masked pixels. Free points are those lattice points within `bounds` that lie before the
    least depth of the four pixels about their projection, less the margin (or times the fraction). The paper takes
    95 % of the depth, which leaves room for a handle before a far object: hence the margin.

    Args:
        depth: (H, W), metres along the camera's axis; infinite where nothing was met (all of the ray is free),
            0, negative or NaN where the camera knows nothing (nothing of it is).
        intrinsics: (3, 3), for pixel centres at whole numbers.
        world_T_camera: (4, 4), camera frame with z forward, x right, y down.
        object_mask: (H, W), True on the object; what is False still bounds free space.
        bounds: (2, 3), metres, box of the world to report free points in; None for no free points.
        free_spacing: of the free points, metres, on the world's lattice.
        free_margin_m: metres before what is seen up to which space is reported free.
        free_fraction: part of the seen depth up to which it is, in place of the margin.

    Returns:
        World points, surface ones first, all attached to the object.
    """
    check_shape("depth", depth, "(H, W)")
    check_shape("intrinsics", intrinsics, "(3, 3)", last=(3, 3))
    check_shape("world_T_camera", world_T_camera, "(4, 4)", last=(4, 4))
    check_finite("intrinsics", intrinsics)
    check_finite("world_T_camera", world_T_camera)
    if object_mask.shape != depth.shape:
        raise ValueError(
            f"Expected object_mask to have depth's shape {tuple(depth.shape)}, got {tuple(object_mask.shape)}"
        )
    height, width = depth.shape
    seen = object_mask & torch.isfinite(depth) & (depth > 0)
    rays = pixel_rays(height, width, intrinsics.to(depth))
    surface = se3.apply(world_T_camera.to(depth), rays[seen] * depth[seen][:, None])
    observation = Observation.of(surface, Semantics.SURFACE)
    if bounds is None:
        return observation
    lattice = lattice_points(bounds.to(depth), free_spacing)
    points_c = se3.apply(se3.inverse(world_T_camera.to(depth)), lattice)
    shown = depth_shown(depth, intrinsics.to(depth), points_c)
    limit = shown - free_margin_m if free_fraction is None else shown * free_fraction
    free = lattice[(points_c[:, 2] > 0) & (points_c[:, 2] < limit)]
    return concatenate([observation, Observation.of(free, Semantics.FREE)])


def depth_shown(
    depth: Float[Tensor, "H W"], intrinsics: Float[Tensor, "3 3"], points_c: Float[Tensor, "M 3"]
) -> Float[Tensor, "M"]:
    """Least depth of the four pixels about each point of the camera's frame, -1 where that is not known."""
    height, width = depth.shape
    if min(height, width) < 2:  # no four pixels
        return points_c.new_full(points_c.shape[:1], -1.0)
    z = points_c[:, 2]
    ahead = z > 1e-6
    flat = (points_c / torch.where(ahead, z, torch.ones_like(z))[:, None]) @ intrinsics.mT
    u, v = flat[:, 0].floor(), flat[:, 1].floor()
    ahead &= (u >= 0) & (u < width - 1) & (v >= 0) & (v < height - 1)
    column = torch.where(ahead, u, torch.zeros_like(u)).long()
    row = torch.where(ahead, v, torch.zeros_like(v)).long()
    known = torch.where((depth > 0) & ~torch.isnan(depth), depth, torch.full_like(depth, -1.0))
    least = torch.minimum(known[:-1], known[1:])
    least = torch.minimum(least[:, :-1], least[:, 1:])
    limit = least.reshape(-1)[row * (width - 1) + column]
    return torch.where(ahead, limit, torch.full_like(limit, -1.0))


def lattice_points(bounds: Float[Tensor, "2 3"], spacing: float) -> Float[Tensor, "M 3"]:
    """Centres of the cells of the world's lattice `floor(x / spacing)` that lie within bounds (2, 3), metres."""
    check_shape("bounds", bounds, "(2, 3)", last=(2, 3))
    if not spacing > 0:
        raise ValueError(f"Expected free_spacing to be a positive number of metres, got {spacing}")
    axes = []
    for low, high in bounds.mT.tolist():
        first, last = math.ceil(low / spacing - 0.5), math.floor(high / spacing - 0.5)
        cells = torch.arange(first, max(first, last + 1), dtype=bounds.dtype, device=bounds.device)
        axes.append((cells + 0.5) * spacing)
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
