"""Semantics and information as the arrays that the fused CPU kernel takes."""

import math

import torch
from jaxtyping import Bool
from torch import Tensor

from rumi.fields.information import WorkspaceFields
from rumi.fields.information_numba import FORWARD, REVERSE, SENSOR, SURROGATE, field
from sdf.grid_sdf import GridSDF
from sdf.posed import common_height
from sdf.posed_numba import pose_planes, table_arguments

_MODES = {"sensor_mi": SENSOR, "surrogate": SURROGATE, "reverse_kl": REVERSE, "forward_kl": FORWARD}


def fused_fields(
    sdf: GridSDF,
    world_T_object: Tensor,
    log_weights: Tensor,
    points_w: Tensor,
    near: Bool[Tensor, "*b V"],
    mode: str,
    numbers: dict[str, float],
) -> WorkspaceFields:
    """One pass over the poses for each point of `near`; the others are free and void of information."""
    batch, poses = world_T_object.shape[:-3], world_T_object.shape[-3]
    scenes, count, dtype = math.prod(batch), points_w.shape[-2], points_w.dtype
    semantics = points_w.new_zeros(*batch, count, 3)
    semantics[..., 0] = 1.0
    information = points_w.new_zeros(*batch, count)
    log_weights = log_weights.detach().expand(*batch, poses)
    rows, weights = pose_planes(world_T_object, log_weights.exp()[..., None, :])
    settings = [
        1.0,
        numbers["peakiness"],
        numbers["peakiness"] * numbers["free_scale"],
        numbers["tolerance"],
        numbers["sharpness"],
        numbers["surface_tolerance"],
        torch.finfo(dtype).tiny,
    ]
    upright, (flat, _, *rest) = table_arguments(sdf, common_height(sdf, world_T_object, points_w), dtype)
    field(
        near.reshape(-1).nonzero()[:, 0].numpy(),
        points_w.detach().reshape(-1, 3).contiguous().numpy(),
        rows.numpy(),
        log_weights.reshape(scenes, poses).contiguous().numpy(),
        weights[:, 0].numpy(),
        _MODES[mode],
        torch.tensor(settings, dtype=dtype).numpy(),
        upright,
        flat,
        *rest,
        semantics.view(scenes, count, 3).numpy(),
        information.view(scenes, count).numpy(),
    )
    return WorkspaceFields(semantics, information)
