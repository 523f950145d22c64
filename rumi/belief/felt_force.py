"""Likelihood of a felt force's direction along a pushed object's trajectory: friction resists the motion that it makes.

Under an isotropic limit surface (an ellipsoid; Goyal, Ruina, Papadopoulos 1991) the force of the tool on the object has
the direction in which the centre of friction goes, whatever the friction under the object is worth, so that the force's
size, and the floor's friction, are not asked for. The reading is the tool's mean force over a segment.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.sliding import rotated

_STILL_M = 1e-6  # below which nothing was pushed, whatever was felt


def log_likelihood_of_forces(
    poses: Float[Tensor, "N S1 3"],
    centre: Float[Tensor, "N 2"],
    ahead_m: Float[Tensor, "N #S"],
    history: History,
    own: PoseTrajectorySettings,
) -> Float[Tensor, "N S"]:
    """Log-likelihood of each segment's force, up to a constant: normal errors of its direction, and outliers.

    Args:
        poses: (x, y, yaw) before the first segment and after each.
        centre: of friction, object frame, metres; an action's own shift of it is left out.
        ahead_m: how far the pressure's centre is ahead of it, in the direction of the push.
        history: what was done and sensed.
        own: of `force_rad` and `outliers`.
    """
    way = directions_of(history)
    place = poses[..., :2] + rotated(centre[:, None].expand(*poses.shape[:-1], 2), poses[..., 2])
    turn = poses[:, 1:, 2] - poses[:, :-1, 2]
    across = torch.stack((-way[:, 1], way[:, 0]), -1)
    step = place[:, 1:] - place[:, :-1] + (ahead_m * turn)[..., None] * across
    force = history.force[:, :2]
    off = torch.atan2(step[..., 0] * force[:, 1] - step[..., 1] * force[:, 0], (step * force).sum(-1))
    off = torch.where(step.norm(dim=-1) > _STILL_M, off, math.pi)
    near = own.outliers + (1.0 - own.outliers) * (-0.5 * (off / own.force_rad).square()).exp()
    return history.force[:, 2] * near.log()


def directions_of(history: History) -> Float[Tensor, "S 2"]:
    """Unit vector from where the tool begins each segment to where it ends; 0 where it goes nowhere."""
    ends = history.ends
    begins = torch.cat((torch.zeros_like(ends[:1]), ends[:-1]))
    way = (history.tool[ends - 1, 1] - history.tool[begins, 0])[:, :2]
    return way / way.norm(dim=-1, keepdim=True).clamp_min(1e-12)
