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
    _, m01, m02, m10, _, m12, m20, m21, _ = matrix.flatten(-2).unbind(-1)
    return 0.5 * torch.stack((m21 - m12, m02 - m20, m10 - m01), dim=-1)


@full_precision
def exp(omega: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation by |omega| radians about omega (Rodrigues)."""
    first, second = exp_coefficients((omega * omega).sum(-1), 2)
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


def exp_coefficients(squared_angle: Float[Tensor, "*b"], count: int = 3) -> tuple[Float[Tensor, "*b"], ...]:
    """The first of the smooth functions sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of t^2."""
    small = squared_angle < SERIES_BELOW
    low = torch.where(small, squared_angle, torch.zeros_like(squared_angle))
    high = torch.where(small, torch.ones_like(squared_angle), squared_angle)
    theta = high.sqrt()
    sine = theta.sin()
    half_sine = (0.5 * theta).sin()
    closed = (sine / theta, 2.0 * half_sine * half_sine / high, (theta - sine) / (high * theta))
    return tuple(torch.where(small, _odd_series(low, n + 1), closed[n]) for n in range(count))


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
    unit = torch.nn.functional.normalize(quaternion, dim=-1)
    _, x, y, z = unit.unbind(-1)
    w2, x2, y2, z2 = (2.0 * unit).unbind(-1)
    xx, yy, zz = x2 * x, y2 * y, z2 * z
    xy, xz, yz = x2 * y, x2 * z, y2 * z
    wx, wy, wz = w2 * x, w2 * y, w2 * z
    rows = (
        *(1 - (yy + zz), xy - wz, xz + wy),
        *(xy + wz, 1 - (xx + zz), yz - wx),
        *(xz - wy, yz + wx, 1 - (xx + yy)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _scaled_quaternion(rotation: Tensor) -> Tensor:
    """(w, x, y, z) times a positive or negative number of size 2 to 4: polynomial in the matrix, so smooth.

    Row i of 4 q q^T is q times 4 q_i; the row of the greatest |q_i| never vanishes.
    """
    xx, m01, m02, m10, yy, m12, m20, m21, zz = rotation.flatten(-2).unbind(-1)
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m01 + m10, m02 + m20, m12 + m21
    rows = (
        *(1.0 + xx + yy + zz, wx, wy, wz),
        *(wx, 1.0 + xx - yy - zz, xy, xz),
        *(wy, xy, 1.0 - xx + yy - zz, yz),
        *(wz, xz, yz, 1.0 - xx - yy + zz),
    )
    outer = torch.stack(rows, -1).unflatten(-1, (4, 4))
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    return torch.gather(outer, -2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
