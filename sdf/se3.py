"""Rigid transforms as (*b, 4, 4) matrices: `a_T_b` maps points of frame b to frame a.

Tangent vectors are (v, omega): metres first, then radians. Finite and right in value and gradient from the identity
to half a turn, in float32 and float64 (see `sdf.so3`).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import so3
from sdf.batch import broadcast_shapes
from sdf.check import is_eager
from sdf.precision import full_precision

# |Bernoulli number 2k| / (2k)!, k = 1 to 7
_LOG_SERIES = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600)


def identity(
    batch: tuple[int, ...] = (), *, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
) -> Float[Tensor, "*b 4 4"]:
    """The transform that moves nothing, once for each element of `batch`."""
    return torch.eye(4, dtype=dtype, device=device).repeat(*batch, 1, 1)


def make(rotation: Float[Tensor, "*#b 3 3"], translation: Float[Tensor, "*#b 3"]) -> Float[Tensor, "... 4 4"]:
    """Transform of a rotation and a translation (metres), whose batch axes broadcast."""
    batch = rotation.shape[:-2]
    if batch != translation.shape[:-1]:
        batch = broadcast_shapes(batch, translation.shape[:-1])
    top = torch.cat((rotation.expand(*batch, 3, 3), translation[..., None].expand(*batch, 3, 1)), dim=-1)
    bottom = torch.tensor((0.0, 0.0, 0.0, 1.0), dtype=top.dtype, device=top.device).expand(*batch, 1, 4)
    return torch.cat((top, bottom), dim=-2)


@full_precision
def exp(tangent: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 4 4"]:
    """Transform reached by following a constant twist (v, omega) for unit time."""
    v, omega = tangent[..., :3], tangent[..., 3:]
    first, second, third = so3.exp_coefficients((omega * omega).sum(-1))
    cross = so3.hat(omega)
    square = cross @ cross
    eye = torch.eye(3, dtype=tangent.dtype, device=tangent.device)
    rotation = eye + first[..., None, None] * cross + second[..., None, None] * square
    jacobian = eye + second[..., None, None] * cross + third[..., None, None] * square
    return make(rotation, (jacobian @ v[..., None])[..., 0])


@full_precision
def log(transform: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 6"]:
    """Twist (v, omega) with `exp(log(T)) == T` and |omega| at most pi."""
    omega = so3.log(transform[..., :3, :3])
    squared = (omega * omega).sum(-1)
    cross = so3.hat(omega)
    eye = torch.eye(3, dtype=transform.dtype, device=transform.device)
    inverse_jacobian = eye - 0.5 * cross + _log_coefficient(squared)[..., None, None] * (cross @ cross)
    return torch.cat(((inverse_jacobian @ transform[..., :3, 3:])[..., 0], omega), dim=-1)


@full_precision
def compose(first: Float[Tensor, "*#b 4 4"], second: Float[Tensor, "*#b 4 4"]) -> Float[Tensor, "... 4 4"]:
    """`first @ second`, its rotation block a rotation again; batch axes broadcast.

    For products that go on and on: of plain ones what rounding adds piles up, until after 10^6 in float32 they are no
    rotations by 1e-4, and their angles are off by more. Here the product is worked out in float64, brought back to a
    rotation (`renormalised`), and rounded once.
    """
    product = renormalised(first.double() @ second.double())
    return product.to(torch.promote_types(first.dtype, second.dtype))


@full_precision
def renormalised(transform: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The same with its rotation block, which must be one up to rounding, a rotation to the last digit.

    By one step of Newton's iteration in float64; `reproject` takes any matrix, and takes longer.
    """
    rotation = transform[..., :3, :3].double()
    off = torch.eye(3, dtype=rotation.dtype, device=rotation.device) - rotation.mT @ rotation
    return make((rotation + 0.5 * (rotation @ off)).to(transform.dtype), transform[..., :3, 3])


@full_precision
def inverse(transform: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """b_T_a of a_T_b, by the transposed rotation."""
    rotation = transform[..., :3, :3].mT
    return make(rotation, -(rotation @ transform[..., :3, 3:])[..., 0])


@full_precision
def apply(transform: Float[Tensor, "*#b 4 4"], points: Float[Tensor, "*#b M 3"]) -> Float[Tensor, "... M 3"]:
    """Points carried from frame b to frame a by a_T_b, metres; batch axes broadcast."""
    return points @ transform[..., :3, :3].mT + transform[..., None, :3, 3]


@full_precision
def rotate(transform: Float[Tensor, "*#b 4 4"], vectors: Float[Tensor, "*#b M 3"]) -> Float[Tensor, "... M 3"]:
    """Directions carried from frame b to frame a by a_T_b; batch axes broadcast."""
    return vectors @ transform[..., :3, :3].mT


def from_planar(xyyaw: Float[Tensor, "*b 3"], z: float | Tensor = 0.0) -> Float[Tensor, "*b 4 4"]:
    """Upright transform at (x, y, z), metres, turned by yaw, radians, about z; z is a number or (*b)."""
    x, y, yaw = xyyaw.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    cosine, sine = yaw.cos(), yaw.sin()
    height = z.to(x).expand_as(x) if isinstance(z, Tensor) else torch.full_like(x, z)
    entries = (cosine, -sine, zero, x, sine, cosine, zero, y, zero, zero, one, height, zero, zero, zero, one)
    return torch.stack(entries, dim=-1).reshape(*xyyaw.shape[:-1], 4, 4)


def to_planar(transform: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 3"]:
    """(x, y, yaw), metres and radians in (-pi, pi]: the heading of the x axis seen from above."""
    yaw = torch.atan2(transform[..., 1, 0], transform[..., 0, 0])
    return torch.stack((transform[..., 0, 3], transform[..., 1, 3], yaw), dim=-1)


@full_precision
def perturb(transform: Float[Tensor, "*#b 4 4"], tangent: Float[Tensor, "*#b 6"]) -> Float[Tensor, "... 4 4"]:
    """`exp(tangent) @ transform`: a_T_b moved by a twist of frame a; batch axes broadcast."""
    return exp(tangent) @ transform


@full_precision
def mean(transforms: Float[Tensor, "*b N 4 4"], weights: Float[Tensor, "*b N"]) -> Float[Tensor, "*b 4 4"]:
    """Weighted mean: of translations, and the chordal mean of rotations (the rotation nearest to their mean matrix).

    Args:
        transforms: (*b, N, 4, 4).
        weights: (*b, N), not negative; only their ratios matter.

    Raises:
        ValueError: if the weights of a batch element do not sum to a positive number.
    """
    total = weights.sum(-1, keepdim=True)
    if is_eager() and not bool((total > 0).all()):
        raise ValueError(
            f"Expected weights to sum to a positive number, got {float(total.min())}: give at least one weight above 0"
        )
    average = ((weights / total)[..., None, None] * transforms).sum(-3)
    return make(so3.reproject(average[..., :3, :3]), average[..., :3, 3])


@full_precision
def distance(
    first: Float[Tensor, "*#b 4 4"], second: Float[Tensor, "*#b 4 4"]
) -> tuple[Float[Tensor, "..."], Float[Tensor, "..."]]:
    """Distance of the origins, metres, and angle between the rotations, radians in [0, pi]; batch axes broadcast."""
    offset = first[..., :3, 3] - second[..., :3, 3]
    return torch.linalg.vector_norm(offset, dim=-1), so3.angle(first[..., :3, :3].mT @ second[..., :3, :3])


def reproject(transform: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The same transform with its rotation block made a rotation again, against drift of long products."""
    return make(so3.reproject(transform[..., :3, :3]), transform[..., :3, 3])


def _log_coefficient(squared_angle: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """(1 - (sin t / t) / (2 (1 - cos t) / t^2)) / t^2, which is 1/12 at 0 and 1/pi^2 at pi."""
    small = squared_angle < so3.SERIES_BELOW
    low = torch.where(small, squared_angle, torch.zeros_like(squared_angle))
    high = torch.where(small, torch.ones_like(squared_angle), squared_angle)
    series = torch.zeros_like(low)
    for coefficient in reversed(_LOG_SERIES):
        series = series * low + coefficient
    first, second, _ = so3.exp_coefficients(high)
    return torch.where(small, series, (1.0 - first / (2.0 * second)) / high)
