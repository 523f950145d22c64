"""The expected normal as the arrays that the fused CPU kernel takes."""

import math

from jaxtyping import Bool, Float
from torch import Tensor

from rumi.fields.normal_numba import normal
from sdf.grid_sdf import GridSDF
from sdf.posed import common_height
from sdf.posed_numba import pose_planes, table_arguments


def fused_normal(
    sdf: GridSDF, world_T_object: Tensor, log_weights: Tensor, points_w: Tensor, where: Bool[Tensor, "*b V"]
) -> Float[Tensor, "*b V 3"]:
    """One pass over the poses for each point of `where`, 0 elsewhere."""
    batch, poses, count = world_T_object.shape[:-3], world_T_object.shape[-3], len(points_w)
    turned = log_weights.exp()[..., None, None] * world_T_object[..., :3, :3]
    rows, turned = pose_planes(world_T_object, turned.expand(*batch, poses, 3, 3).reshape(*batch, poses, 9).mT)
    upright, table = table_arguments(sdf, common_height(sdf, world_T_object, points_w), points_w.dtype)
    result = points_w.new_zeros(*batch, count, 3)
    normal(
        where.expand(*batch, count).reshape(-1).nonzero()[:, 0].numpy(),
        points_w.detach().contiguous().numpy(),
        rows.numpy(),
        turned.numpy(),
        upright,
        *table,
        result.view(math.prod(batch), count, 3).numpy(),
    )
    return result
