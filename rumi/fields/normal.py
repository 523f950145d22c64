"""Expected surface normal at every workspace point under a belief."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import backend, compiled, gpu, skipped_work
from sdf.base import SDF
from sdf.check import check_shape, may_look
from sdf.grid_sdf import takes
from sdf.posed import posed_query
from sdf.precision import full_precision

CHUNK_BYTES = 64 * 2**20


@full_precision
def expected_normal(
    sdf: SDF,
    world_T_object: Float[Tensor, "*b N 4 4"],
    log_weights: Float[Tensor, "*b N"],
    points_w: Float[Tensor, "V 3"],
    where: Bool[Tensor, "*b V"] | None = None,
) -> Float[Tensor, "*b V 3"]:
    """Mean outward normal of world points over the poses, in the world frame, at most of length 1.

    `sum_j w_j R_j grad sdf(x in the frame of object j)`, R_j turning object j's axes into the world's. RUMI's Alg 7,
    line 11, sums the gradients of P different object frames, which means nothing; this is what was meant.

    Args:
        sdf: the object's shape.
        world_T_object: poses.
        log_weights: normalised.
        points_w: the same for every scene of a batch.
        where: points to compute; the others get 0. None computes all.
    """
    check_shape("world_T_object", world_T_object, "(*b, N, 4, 4)", last=(4, 4))
    check_shape("points_w", points_w, "(V, 3)", last=(3,))
    if where is None:
        shape = (*world_T_object.shape[:-3], len(points_w))
        where = torch.ones(shape, dtype=torch.bool, device=points_w.device)
    version = backend.dispatch("expected_normal", world_T_object, log_weights, points_w, *sdf.tensors())
    with skipped_work.work("normals") as work:
        if skipped_work.kept():
            work.count(where.sum(), where.numel())
        return version(sdf, world_T_object, log_weights, points_w, where)


@backend.register("expected_normal")
def _expected_normal(sdf: SDF, world_T_object: Tensor, log_weights: Tensor, points_w: Tensor, where: Tensor) -> Tensor:
    batch, count = world_T_object.shape[:-3], world_T_object.shape[-3]
    turned = (log_weights.exp()[..., None, None] * world_T_object[..., :3, :3]).transpose(-3, -2)  # (*b, 3, N, 3)
    turned = turned.reshape(*batch, 3, 3 * count)
    if not may_look(world_T_object):  # what is traced looks all up
        gradient = posed_query(sdf, world_T_object, points_w.expand(*batch, *points_w.shape)).gradient
        stacked = gradient.transpose(-1, -2).reshape(*batch, 3 * count, len(points_w))
        return (turned @ stacked).mT * where[..., None]
    normal = points_w.new_zeros(*batch, len(points_w), 3)
    size = max(1, CHUNK_BYTES // (4 * 40 * max(1, math.prod(batch) * count)))
    for index in where.reshape(math.prod(batch), len(points_w)).any(0).nonzero()[:, 0].split(size):
        points = points_w[index].expand(*batch, len(index), 3)
        gradient = posed_query(sdf, world_T_object, points).gradient  # (*b, N, V, 3), object frames
        stacked = gradient.transpose(-1, -2).reshape(*batch, 3 * count, len(index))
        normal[..., index, :] = (turned @ stacked).mT * where[..., index, None]
    return normal


@backend.register("expected_normal", "numba", compiled.supports)
def _expected_normal_numba(
    sdf: SDF, world_T_object: Tensor, log_weights: Tensor, points_w: Tensor, where: Tensor
) -> Tensor:
    if not takes(sdf, world_T_object, log_weights, points_w):
        return _expected_normal(sdf, world_T_object, log_weights, points_w, where)
    from rumi.fields.normal_numba import expected_normal as compiled

    return compiled(sdf, world_T_object, log_weights, points_w, where)


@backend.register("expected_normal", gpu.VERSION, gpu.supports, gpu.suits)
def _expected_normal_warp(
    sdf: SDF, world_T_object: Tensor, log_weights: Tensor, points_w: Tensor, where: Tensor
) -> Tensor:
    if not takes(sdf, world_T_object, log_weights, points_w):
        return _expected_normal(sdf, world_T_object, log_weights, points_w, where)
    from rumi.fields.information_warp import expected_normal as compiled

    return compiled(sdf, world_T_object, log_weights, points_w, where)
