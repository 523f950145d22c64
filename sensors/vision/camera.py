"""Depth images: surface points of an object and free space in front of what is seen."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3
from sdf.check import check_finite, check_near, check_shape
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


def pixel_points(
    depth: Float[Tensor, "H W"], mask: Bool[Tensor, "H W"], intrinsics: Float[Tensor, "3 3"]
) -> Float[Tensor, "n 3"]:
    """Points of the camera's frame that some pixels of a depth image show, in the order of `mask.nonzero()`."""
    v, u = mask.nonzero().to(intrinsics.dtype).unbind(-1)
    z = depth[mask]
    y = (v - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (u - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    return torch.stack((x * z, y * z, z), -1)


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
    check_near("world_T_camera", world_T_camera[:3, 3], depth.dtype)
    if object_mask.shape != depth.shape:
        raise ValueError(
            f"Expected object_mask to have depth's shape {tuple(depth.shape)}, got {tuple(object_mask.shape)}"
        )
    seen = object_mask & torch.isfinite(depth) & (depth > 0)
    surface = se3.apply(world_T_camera.to(depth), pixel_points(depth, seen, intrinsics.to(depth)))
    observation = Observation.of(surface, Semantics.SURFACE)
    if bounds is None:
        return observation
    free = free_points(
        depth,
        intrinsics,
        world_T_camera,
        bounds,
        spacing=free_spacing,
        margin_m=free_margin_m,
        fraction=free_fraction,
    )
    return concatenate([observation, Observation.of(free, Semantics.FREE)])


def free_points(
    depth: Float[Tensor, "H W"],
    intrinsics: Float[Tensor, "3 3"],
    world_T_camera: Float[Tensor, "4 4"],
    bounds: Float[Tensor, "2 3"],
    *,
    spacing: float = 0.005,
    margin_m: float = 0.010,
    fraction: float | None = None,
) -> Float[Tensor, "M 3"]:
    """World points of the lattice in a box that lie in front of everything that a depth image shows.

    The arguments are those of `depth_observation`.
    """
    lattice = lattice_points(bounds.to(depth), spacing)
    points_c = se3.apply(se3.inverse(world_T_camera.to(depth)), lattice)
    shown = depth_shown(depth, intrinsics.to(depth), points_c)
    limit = shown - margin_m if fraction is None else shown * fraction
    return lattice[(points_c[:, 2] > 0) & (points_c[:, 2] < limit)]


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
    corner, flat_depth = row * width + column, depth.reshape(-1)
    limit = flat_depth[corner]
    for step in (1, width, width + 1):
        limit = torch.minimum(limit, flat_depth[corner + step])  # NaN stays
    limit = torch.where(limit > 0, limit, torch.full_like(limit, -1.0))
    return torch.where(ahead, limit, torch.full_like(limit, -1.0))


def free_lattice(
    nearest: Float[Tensor, "H W"],
    intrinsics: Float[Tensor, "3 3"],
    world_T_camera: Float[Tensor, "4 4"],
    bounds: Float[Tensor, "2 3"],
    *,
    spacing: float = 0.005,
    margin_m: float = 0.010,
    fraction: float | None = None,
) -> Float[Tensor, "M 3"]:
    """`free_points` of an image whose pixels hold the least depth about them: one look-up a point in place of four.

    Args:
        nearest: (H, W), metres, the least depth within a pixel or more (`depth_filters.nearest_about`), which holds for
            all four pixels about a point that the pixel is the nearest of.
        intrinsics: (3, 3).
        world_T_camera: (4, 4).
        bounds: (2, 3), metres, box of the world.
        spacing: of the lattice, metres.
        margin_m: metres before what is seen up to which space is free.
        fraction: part of the seen depth up to which it is, in place of the margin.
    """
    height, width = nearest.shape
    axes = lattice_axes(bounds.to(nearest), spacing)
    # a lattice's image is a sum over its axes, so that points need not be projected one by one
    camera_T_world = se3.inverse(world_T_camera.to(nearest))
    projection = intrinsics.to(nearest) @ camera_T_world[:3]
    u, v, z = (
        row[3] + (row[0] * axes[0])[:, None, None] + (row[1] * axes[1])[:, None] + row[2] * axes[2]
        for row in projection
    )
    ahead = z > 1e-6
    scale = torch.where(ahead, z, torch.ones_like(z)).reciprocal_()
    column, row = u.mul_(scale).round_(), v.mul_(scale).round_()
    inside = ahead & (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    pixel = torch.where(inside, row * width + column, torch.zeros_like(z)).int()
    limit = nearest.reshape(-1)[pixel.reshape(-1)].reshape(z.shape)
    limit = limit - margin_m if fraction is None else limit * fraction
    x, y, height_index = (inside & (z < limit)).nonzero().unbind(-1)
    return torch.stack((axes[0][x], axes[1][y], axes[2][height_index]), -1)


def lattice_points(bounds: Float[Tensor, "2 3"], spacing: float) -> Float[Tensor, "M 3"]:
    """Centres of the cells of the world's lattice `floor(x / spacing)` that lie within bounds (2, 3), metres."""
    return torch.stack(torch.meshgrid(*lattice_axes(bounds, spacing), indexing="ij"), -1).reshape(-1, 3)


def lattice_axes(bounds: Float[Tensor, "2 3"], spacing: float) -> list[Tensor]:
    """Coordinates of `lattice_points` along x, y and z, metres."""
    check_shape("bounds", bounds, "(2, 3)", last=(2, 3))
    if not spacing > 0:
        raise ValueError(f"Expected free_spacing to be a positive number of metres, got {spacing}")
    axes = []
    for low, high in bounds.mT.tolist():
        first, last = math.ceil(low / spacing - 0.5), math.floor(high / spacing - 0.5)
        cells = torch.arange(first, max(first, last + 1), dtype=bounds.dtype, device=bounds.device)
        axes.append((cells + 0.5) * spacing)
    return axes
