"""Distance between poses of an object that may look the same turned."""

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import se3


def pose_error(
    estimate: Float[Tensor, "*b 4 4"], truth: Float[Tensor, "*b 4 4"], symmetries: Float[Tensor, "K 3 3"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Position error (m) of the origin and rotation error (rad), modulo the object's symmetries.

    Args:
        estimate: world_T_object.
        truth: world_T_object.
        symmetries: rotations about the object's origin that leave it as it is, the identity among them.
    """
    symmetry = symmetries.to(truth)
    same = se3.make(symmetry, torch.zeros_like(symmetry[..., 0]))
    alike = truth[..., None, :, :] @ same
    metres, radians = se3.distance(estimate[..., None, :, :].expand(alike.shape), alike)
    best = torch.argmin(radians, -1, keepdim=True)
    return torch.gather(metres, -1, best)[..., 0], torch.gather(radians, -1, best)[..., 0]
