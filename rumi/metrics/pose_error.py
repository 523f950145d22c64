"""Pose error: distance between poses of an object up to its symmetries."""

from jaxtyping import Float
from torch import Tensor

from sdf import se3
from sdf.precision import full_precision
from sdf.symmetry import Symmetries


@full_precision
def pose_error(
    estimate: Float[Tensor, "*b 4 4"], truth: Float[Tensor, "*b 4 4"], symmetries: Symmetries
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Position error (m) of the origin and rotation error (rad), modulo the object's symmetries.

    Of the poses at which the object is as it truly is, against the one whose rotation is nearest to the estimate's.

    Args:
        estimate: world_T_object.
        truth: world_T_object.
        symmetries: of the object.
    """
    return se3.distance(estimate, symmetries.nearest(truth, estimate))
