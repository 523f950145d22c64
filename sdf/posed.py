"""Signed distances of world points from one object at many poses."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import backend, compiled, gpu, se3
from sdf.base import SDF, SDFQuery
from sdf.batch import broadcast_shapes
from sdf.check import FAR, check_shape, is_eager
from sdf.grid_sdf import GridSDF, takes
from sdf.precision import full_precision

# pairs looked up at once: few enough for the caches, enough that two threads do not wait for each other all the time
_BLOCK = 1 << 17
# metres
_FAR = 1e4


@full_precision
def posed_distance(
    sdf: SDF, world_T_object: Float[Tensor, "*#b N 4 4"], points_w: Float[Tensor, "*#b M 3"]
) -> Float[Tensor, "... N M"]:
    """Signed distance of every world point from the object at every pose, metres.

    Differentiable to poses and points. Batch axes broadcast. Works block by block, so that beside the result
    little memory is taken unless a graph is kept. Rounding counts by how far points and poses are from the first pose,
    not from the world's origin (`about_first`). What is skipped: where no graph is needed and the object is
    upright at one height over points of one height, a tabulated SDF is looked up in the one layer that all
    pairs share, which is the same interpolation with its z step done once.

    Args:
        sdf: the object's.
        world_T_object: (*b, N, 4, 4), poses.
        points_w: (*b, M, 3), metres; one that is not finite counts as very far from the object.

    Raises:
        ValueError: if a shape does not fit, or points are of another float type than poses.
    """
    _check(world_T_object, points_w)
    world_T_object, points_w = about_first(world_T_object, points_w)
    version = backend.dispatch("posed_distance", world_T_object, points_w, *sdf.tensors())
    return version(sdf, world_T_object, points_w)


@full_precision
def posed_query(sdf: SDF, world_T_object: Float[Tensor, "*#b N 4 4"], points_w: Float[Tensor, "*#b M 3"]) -> SDFQuery:
    """Signed distance (*b, N, M), metres, and gradient (*b, N, M, 3) in each object frame; else as `posed_distance`.

    Args:
        sdf: the object's.
        world_T_object: (*b, N, 4, 4), poses.
        points_w: (*b, M, 3), metres; one that is not finite counts as very far from the object.

    Raises:
        ValueError: if a shape does not fit, or points are of another float type than poses.
    """
    _check(world_T_object, points_w)
    world_T_object, points_w = about_first(world_T_object, points_w)
    version = backend.dispatch("posed_query", world_T_object, points_w, *sdf.tensors())
    return version(sdf, world_T_object, points_w)


@backend.register("posed_distance")
def _posed_distance(sdf: SDF, world_T_object: Tensor, points_w: Tensor) -> Tensor:
    height = common_height(sdf, world_T_object, points_w)

    def look_up(points_o: Tensor) -> tuple[Tensor, ...]:
        if height is not None and isinstance(sdf, GridSDF):
            return (sdf.distance_at_height(points_o[..., :2], height),)
        return (sdf.distance(points_o),)

    return _by_blocks(look_up, world_T_object, points_w)[0]


@backend.register("posed_query")
def _posed_query(sdf: SDF, world_T_object: Tensor, points_w: Tensor) -> SDFQuery:
    height = common_height(sdf, world_T_object, points_w)

    def look_up(points_o: Tensor) -> tuple[Tensor, ...]:
        if height is not None and isinstance(sdf, GridSDF):
            query = sdf.query_at_height(points_o[..., :2], height)
        else:
            query = sdf(points_o)
        # plane by plane, as the coordinates are: blocks are then joined by copies of whole rows
        return query.distance, query.gradient.movedim(-1, 0)

    distance, gradient = _by_blocks(look_up, world_T_object, points_w)
    return SDFQuery(distance, gradient.movedim(0, -1))


@backend.register("posed_distance", "numba", compiled.supports)
def _posed_distance_numba(sdf: SDF, world_T_object: Tensor, points_w: Tensor) -> Tensor:
    if not takes(sdf, world_T_object, points_w):
        return _posed_distance(sdf, world_T_object, points_w)
    from sdf import posed_numba

    return posed_numba.posed_distance(sdf, world_T_object, points_w, common_height(sdf, world_T_object, points_w))


@backend.register("posed_query", "numba", compiled.supports)
def _posed_query_numba(sdf: SDF, world_T_object: Tensor, points_w: Tensor) -> SDFQuery:
    if not takes(sdf, world_T_object, points_w):
        return _posed_query(sdf, world_T_object, points_w)
    from sdf import posed_numba

    return posed_numba.posed_query(sdf, world_T_object, points_w, common_height(sdf, world_T_object, points_w))


@backend.register("posed_distance", gpu.VERSION, gpu.supports, gpu.suits)
def _posed_distance_warp(sdf: SDF, world_T_object: Tensor, points_w: Tensor) -> Tensor:
    if not takes(sdf, world_T_object, points_w):
        return _posed_distance(sdf, world_T_object, points_w)
    from sdf import posed_warp

    return posed_warp.posed_distance(sdf, world_T_object, points_w)


@backend.register("posed_query", gpu.VERSION, gpu.supports, gpu.suits)
def _posed_query_warp(sdf: SDF, world_T_object: Tensor, points_w: Tensor) -> SDFQuery:
    if not takes(sdf, world_T_object, points_w):
        return _posed_query(sdf, world_T_object, points_w)
    from sdf import posed_warp

    return posed_warp.posed_query(sdf, world_T_object, points_w)


def _by_blocks(
    look_up: Callable[[Tensor], tuple[Tensor, ...]], world_T_object: Tensor, points_w: Tensor
) -> list[Tensor]:
    """Results (..., N, M) of a function of object-frame points, a block of poses and points at a time."""
    batch = broadcast_shapes(world_T_object.shape[:-3], points_w.shape[:-2])
    poses, points = world_T_object.shape[-3], points_w.shape[-2]
    scenes = math.prod(batch)
    eager = is_eager()
    object_T_world = se3.inverse(world_T_object)[..., :3, :].movedim(-2, 0)
    # a point that is not finite would give each pose a slope of 0 times NaN
    sound = None
    if not eager or (torch.is_grad_enabled() and world_T_object.requires_grad):
        sound = points_w.isfinite().all(-1)
        points_w = points_w.where(sound[..., None], torch.zeros_like(points_w))
    homogeneous = torch.cat((points_w, torch.ones_like(points_w[..., :1])), dim=-1).mT

    def block(transforms: Tensor, places: Tensor, kept: Tensor | None) -> tuple[Tensor, ...]:
        # coordinate planes (3, *b, n, m), each contiguous, seen as points (*b, n, m, 3)
        planes = transforms @ places
        if kept is not None:
            planes = planes.where(kept[..., None, :], planes.new_full((), FAR))
        return look_up(planes.movedim(0, -1))

    if not eager:  # what is traced holds for any number of poses and points: one block
        return list(block(object_T_world, homogeneous, sound))
    point_step = max(1, min(points, _BLOCK // max(scenes, 1)))
    pose_step = max(1, _BLOCK // max(scenes * point_step, 1))
    rows = []
    for first in range(0, max(poses, 1), pose_step):
        transforms = object_T_world[..., first : first + pose_step, :]
        row = []
        for start in range(0, max(points, 1), point_step):
            part = slice(start, start + point_step)
            row.append(block(transforms, homogeneous[..., part], None if sound is None else sound[..., part]))
        rows.append([torch.cat(parts, dim=-1) if len(row) > 1 else parts[0] for parts in zip(*row, strict=True)])
    return [torch.cat(parts, dim=-2) if len(rows) > 1 else parts[0] for parts in zip(*rows, strict=True)]


def about_first(
    world_T_object: Float[Tensor, "*#b N 4 4"], points_w: Float[Tensor, "*#b M 3"]
) -> tuple[Float[Tensor, "..."], Float[Tensor, "..."]]:
    """Poses and points with each scene's first pose at the origin: the same question, asked where floats are finer.

    Taken apart, `R^T x - R^T t` loses what x and t have in common: in float32, metres from the world's origin, more
    than a sharp sensor model forgives. Their difference is exact or nearly so. A first pose that is not finite, or
    farther than `_FAR`, moves nothing.
    """
    if world_T_object.shape[-3] == 0:
        return world_T_object, points_w
    first = world_T_object[..., 0, :3, 3].detach()
    middle = torch.where(first.abs() < _FAR, first, torch.zeros_like(first))
    shift = torch.nn.functional.pad(middle[..., None, :, None], (3, 0, 0, 1))
    return world_T_object - shift, points_w - middle[..., None, :].to(points_w.dtype)


def common_height(sdf: SDF, world_T_object: Tensor, points_w: Tensor) -> Tensor | None:
    """Height of all points in the frames of all poses if there is one, the poses are upright and no graph is kept."""
    graph = torch.is_grad_enabled() and (world_T_object.requires_grad or points_w.requires_grad)
    if graph or not isinstance(sdf, GridSDF) or not world_T_object.numel() or not points_w.numel():
        return None
    if not is_eager():
        return None
    heights, levels = points_w[..., 2].reshape(-1), world_T_object[..., 2, 3].reshape(-1)
    upright = world_T_object[..., 2, :3] == world_T_object.new_tensor((0.0, 0.0, 1.0))
    if bool((heights == heights[0]).all() & (levels == levels[0]).all() & upright.all()):
        return heights[0] - levels[0]
    return None


def _check(world_T_object: Tensor, points_w: Tensor) -> None:
    check_shape("world_T_object", world_T_object, "(*b, N, 4, 4)")
    check_shape("points_w", points_w, "(*b, M, 3)")
    if points_w.dtype != world_T_object.dtype and points_w.numel():
        wanted = world_T_object.dtype
        raise ValueError(
            f"Expected points of {wanted} as the poses are, got {points_w.dtype}: use .to(dtype={wanted}) on either"
        )
