"""How far two results are apart: one number a case."""

import torch
from jaxtyping import Float
from torch import Tensor

from tests.stress.sweep import Inputs


def largest(difference: Tensor) -> Float[Tensor, "n"]:
    """Largest absolute value of each row."""
    return difference.detach().double().abs().reshape(difference.shape[0], -1).amax(-1)


def absolute(got: Tensor, wanted: Tensor) -> Float[Tensor, "n"]:
    """Largest absolute difference of each row; equal infinities do not differ."""
    a, b = got.detach().double(), wanted.detach().double()
    return largest(torch.where(a == b, torch.zeros_like(b), a - b))


def relative(got: Tensor, wanted: Tensor, least: float = 1.0) -> Float[Tensor, "n"]:
    """Largest difference of each row over the largest wanted value of it, or over `least` where that is less."""
    scale = largest(torch.where(torch.isfinite(wanted), wanted, torch.zeros_like(wanted)))
    return absolute(got, wanted) / scale.clamp_min(least)


def pose(got: Float[Tensor, "n 4 4"], wanted: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n"]:
    """The greater of the distance of the origins, metres, and of the rotations, radians.

    The latter as |R - R'| / sqrt 2 in the Frobenius norm, which is the angle where both are rotations, and counts what
    is no rotation too.
    """
    a, b = got.detach().double(), wanted.detach().double()
    metres = (a[..., :3, 3] - b[..., :3, 3]).norm(dim=-1)
    radians = (a[..., :3, :3] - b[..., :3, :3]).flatten(-2).norm(dim=-1) / 2**0.5
    return torch.maximum(metres, radians)


def from_orthogonal(rotation: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n"]:
    """Largest entry of R^T R - 1."""
    wide = rotation.detach().double()
    return largest(wide.mT @ wide - torch.eye(3, dtype=torch.float64))


def of_numbers(got: Tensor, wanted: Tensor, inputs: Inputs) -> Float[Tensor, "n"]:
    """`absolute`, as a sweep's error."""
    return absolute(got, wanted)


def of_pose(got: Tensor, wanted: Tensor, inputs: Inputs) -> Float[Tensor, "n"]:
    """`pose`, as a sweep's error."""
    return pose(got, wanted)


def of_touch(got: Tensor, wanted: Tensor, inputs: Inputs) -> Float[Tensor, "n"]:
    """In units of what 1e-6 m and 1e-6 of a chord make of it: both count by their sigmas."""
    noise = inputs["noise"]
    slack = (2e-6 * (-2.0 * wanted).clamp_min(0.0).sqrt()) * (1.0 / noise.point_m + 1.0 / noise.normal_rad) + 1e-5
    return ((got.double() - wanted).abs() / slack).amax(-1)
