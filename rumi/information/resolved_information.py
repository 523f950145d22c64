"""Information that an outcome gives about a pose at a resolution: what is finer than that counts for nothing."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf import se3
from sdf.symmetry import Symmetries

_CHUNK = 4_000_000  # pairs of poses of all actions that are looked at at once


def pose_kernel(
    world_T_object: Float[Tensor, "N 4 4"], symmetries: Symmetries, *, position_m: float, rotation_rad: float
) -> Float[Tensor, "N N"]:
    """Gaussian kernel of each pair of poses, modulo the object's symmetries; 1 for the same pose.

    Args:
        world_T_object: poses.
        symmetries: of the object.
        position_m: deviation of the position.
        rotation_rad: of the angle between rotations.
    """
    count = len(world_T_object)
    first, second = torch.triu_indices(count, count, 1, device=world_T_object.device)
    one, other = world_T_object[first], world_T_object[second]
    metres, radians = se3.distance(one, symmetries.nearest(other, one))
    alike = torch.exp(-0.5 * ((metres / position_m).square() + (radians / rotation_rad).square()))
    kernel = torch.eye(count).to(alike)
    kernel[first, second] = alike
    kernel[second, first] = alike
    return kernel


def resolved_entropy(kernel: Float[Tensor, "N N"], log_weights: Float[Tensor, "N"]) -> Float[Tensor, ""]:
    """Entropy of a weighted set of poses at the kernel's resolution, nats: -sum_i w_i log sum_j w_j k_ij.

    Args:
        kernel: of each pair of poses, 1 for the same (`pose_kernel`).
        log_weights: of the poses, normalised or not.
    """
    weights = log_weights.to(kernel).softmax(-1)
    return -(weights @ (kernel @ weights).clamp_min(torch.finfo(kernel.dtype).tiny).log())


def outcome_information(
    kernel: Float[Tensor, "N N"], log_weights: Float[Tensor, "N"], outcomes: Int[Tensor, "K N"]
) -> Float[Tensor, "K"]:
    """Mutual information of pose and outcome (K,), nats, at the kernel's resolution.

    The `resolved_entropy` of the poses less that of those which lead to the same outcome, in the mean over outcomes. A
    kernel of ones where poses are alike and of zeros else gives the plain mutual information of which kind of pose it
    is.

    Args:
        kernel: of each pair of poses, 1 for the same (`pose_kernel`).
        log_weights: of the poses, normalised or not.
        outcomes: number of the outcome that each pose leads to surely, of K actions.
    """
    weights, tiny = log_weights.to(kernel).softmax(-1), torch.finfo(kernel.dtype).tiny
    after = list[Tensor]()
    for part in outcomes.split(max(1, _CHUNK // max(1, kernel.numel()))):
        same = (part[:, :, None] == part[:, None, :]).to(kernel)
        shared, held = same @ weights, (same * (kernel * weights)).sum(-1)
        after.append((shared.clamp_min(tiny).log() - held.clamp_min(tiny).log()) @ weights)
    return (resolved_entropy(kernel, log_weights) - torch.cat(after)).clamp_min(0.0)
