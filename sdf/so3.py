"""Rotations as (*b, 3, 3) matrices: exponential, logarithm, angle, projection.

Every function is finite and right in value and gradient from the identity to half a turn, in float32 and float64:
each branch that would divide by zero is given a harmless input before `torch.where` drops it.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.check import is_eager
from sdf.precision import full_precision

SERIES_BELOW = 0.25
"""Squared angle under which the power series serve: there 8 terms are exact in float64, above it nothing cancels."""


def hat(omega: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Cross-product matrix: `hat(a) @ b == a x b`."""
    x, y, z = omega.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).reshape(*omega.shape[:-1], 3, 3)


def vee(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Inverse of `hat`; takes the antisymmetric part of any matrix."""
    return 0.5 * torch.stack(
        (
            matrix[..., 2, 1] - matrix[..., 1, 2],
            matrix[..., 0, 2] - matrix[..., 2, 0],
            matrix[..., 1, 0] - matrix[..., 0, 1],
        ),
        dim=-1,
    )


@full_precision
def exp(omega: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation by |omega| radians about omega (Rodrigues)."""
    first, second, _ = exp_coefficients((omega * omega).sum(-1))
    cross = hat(omega)
    eye = torch.eye(3, dtype=omega.dtype, device=omega.device)
    return eye + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


def log(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Rotation vector, radians, of length at most pi; at half a turn either of the two."""
    quaternion = _scaled_quaternion(rotation)
    real, imaginary = quaternion[..., :1], quaternion[..., 1:]
    flip = torch.where(real < 0, -torch.ones_like(real), torch.ones_like(real))
    real, imaginary = flip * real, flip * imaginary
    # 2 atan(s / w) / s, by its series where s, the length of the imaginary part, may be zero
    squared = (imaginary * imaginary).sum(-1, keepdim=True)
    small = squared < 1e-6 * real * real
    safe_real = torch.where(small, real, torch.ones_like(real))
    ratio = torch.where(small, squared, torch.zeros_like(squared)) / (safe_real * safe_real)
    series = 2.0 / safe_real * (1.0 - ratio * (1.0 / 3.0 - ratio * (1.0 / 5.0 - ratio / 7.0)))
    sine = torch.where(small, torch.ones_like(squared), squared).sqrt()
    closed = 2.0 * torch.atan2(sine, real) / sine
    return torch.where(small, series, closed) * imaginary


def wrap(angle: Float[Tensor, "*b"], period: float = 2.0 * math.pi) -> Float[Tensor, "*b"]:
    """Angles wrapped to [-period / 2, period / 2), radians: [-pi, pi) unless the object looks the same before."""
    return torch.remainder(angle + 0.5 * period, period) - 0.5 * period


def arccos(cosine: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Angle in [0, pi] of a cosine, clamped; its slope at both ends, where there is none, is 0."""
    within = cosine.abs() < 1.0
    ends = torch.where(cosine > 0, torch.zeros_like(cosine), torch.full_like(cosine, math.pi))
    return torch.where(within, torch.where(within, cosine, torch.zeros_like(cosine)).acos(), ends)


def angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle of rotation in [0, pi], radians; its gradient at the identity and at half a turn, both kinks, is 0."""
    sine = vee(rotation)
    squared = (sine * sine).sum(-1)
    zero = squared == 0
    length = torch.where(zero, torch.ones_like(squared), squared).sqrt()
    cosine = 0.5 * (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0)
    return torch.atan2(torch.where(zero, torch.zeros_like(length), length), cosine)


@full_precision
def reproject(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """The rotation nearest to a matrix in the Frobenius norm, determinant +1; smooth.

    Where several rotations are equally near (a singular matrix of rank below 2) one of them, without a slope.

    The slopes, of any order up to the third, are those of two of Newton's steps from there: with A = R^T M, R exp(w) is
    next, (tr(A) I - A_sym) w = vee(A - A^T). Only sums of singular values are divided by, which are about 2 near a
    rotation; the slope of the factors would divide by their differences, 0 there.
    """
    with torch.no_grad():
        u, s, vh = torch.linalg.svd(matrix.detach())
        sign = torch.where(torch.linalg.det(u @ vh) < 0, -1.0, 1.0).to(matrix.dtype)
        signs = torch.stack((torch.ones_like(sign), torch.ones_like(sign), sign), dim=-1)
        u, s = u * signs[..., None, :], s * signs
        nearest = u @ vh
    if is_eager() and not (torch.is_grad_enabled() and matrix.requires_grad):
        return nearest
    # s falls: the least sum is that of the last two
    firm = (s[..., 1] + s[..., 2] > 10.0 * torch.finfo(s.dtype).eps * s[..., 0])[..., None]
    eye, rotation = torch.eye(3, dtype=matrix.dtype, device=matrix.device), nearest
    for _ in range(2):
        inner = rotation.mT @ matrix
        trace = inner.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        system = torch.where(firm[..., None], trace * eye - 0.5 * (inner + inner.mT), eye)
        turn = torch.linalg.solve(system, 2.0 * vee(inner)[..., None])[..., 0]
        rotation = rotation @ exp(torch.where(firm, turn, torch.zeros_like(turn)))
    return nearest + (rotation - rotation.detach())


def exp_coefficients(
    squared_angle: Float[Tensor, "*b"],
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """The smooth functions sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of t^2."""
    small = squared_angle < SERIES_BELOW
    low = torch.where(small, squared_angle, torch.zeros_like(squared_angle))
    high = torch.where(small, torch.ones_like(squared_angle), squared_angle)
    theta = high.sqrt()
    sine = theta.sin()
    half_sine = (0.5 * theta).sin()
    first = torch.where(small, _odd_series(low, 1), sine / theta)
    second = torch.where(small, _odd_series(low, 2), 2.0 * half_sine * half_sine / high)
    third = torch.where(small, _odd_series(low, 3), (theta - sine) / (high * theta))
    return first, second, third


def _odd_series(squared: Tensor, start: int) -> Tensor:
    """Sum over k of (-squared)^k start-wise factorials: 1/start! - squared/(start+2)! + ..., 8 terms by Horner."""
    total = torch.ones_like(squared)
    for k in range(7, 0, -1):
        total = 1.0 - squared / ((start + 2 * k - 1) * (start + 2 * k)) * total
    return total / (1.0, 1.0, 2.0, 6.0)[start]


def quaternion(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion (x, y, z, w) of a rotation, with w of 0 or more."""
    scaled = _scaled_quaternion(rotation)
    unit = scaled / scaled.norm(dim=-1, keepdim=True)
    return torch.where(unit[..., :1] < 0, -unit, unit)[..., [1, 2, 3, 0]]


def from_wxyz(quaternion: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation of a quaternion (w, x, y, z) of any length, as simulators and recordings order it; of 0 none."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _scaled_quaternion(rotation: Tensor) -> Tensor:
    """(w, x, y, z) times a positive or negative number of size 2 to 4: polynomial in the matrix, so smooth.

    Row i of 4 q q^T is q times 4 q_i; the row of the greatest |q_i| never vanishes.
    """
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    outer = torch.stack(
        (
            torch.stack((1.0 + xx + yy + zz, wx, wy, wz), dim=-1),
            torch.stack((wx, 1.0 + xx - yy - zz, xy, xz), dim=-1),
            torch.stack((wy, xy, 1.0 - xx + yy - zz, yz), dim=-1),
            torch.stack((wz, xz, yz, 1.0 - xx - yy + zz), dim=-1),
        ),
        dim=-2,
    )
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    return torch.gather(outer, -2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
