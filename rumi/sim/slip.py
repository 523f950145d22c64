"""Simulated slip sensor: the measured motion of the object, with noise."""

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import se3

_METRES_PER_RADIAN = 0.05


def measured_motion(
    start: Float[Tensor, "4 4"], motion: Float[Tensor, "K 4 4"], noise: Float[Tensor, "3"]
) -> Float[Tensor, "K 4 4"]:
    """World motion that the sensor reports at each instant of one action.

    The error grows in proportion to the path that the object has gone; an object that stands still is measured
    exactly.

    Args:
        start: (4, 4), world_T_object at the start of the action.
        motion: (K, 4, 4), true world motion since then.
        noise: (3,), error at the end of the action: metres along x and y, radians about the object's upright axis.

    Returns:
        (K, 4, 4), with `pose_k = motion_k @ start` up to the noise.
    """
    if not bool((noise != 0).any()):
        return motion
    poses = torch.cat((start[None], motion @ start))
    shift, turn = se3.distance(poses[:-1], poses[1:])
    path = (shift + _METRES_PER_RADIAN * turn).cumsum(0)
    # servo and solver ripple of a resting object is not motion
    if float(path[-1]) < 1e-4:
        return motion
    planar = (path / path[-1])[:, None] * noise
    error = se3.from_planar(planar)
    here = se3.make(torch.eye(3, dtype=start.dtype, device=start.device), poses[1:, :3, 3])
    return here @ error @ se3.inverse(here) @ motion
