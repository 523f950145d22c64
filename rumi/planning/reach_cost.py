"""What moving the object costs: information pushed to where the robot does not reach (RUMI, Alg 8)."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.planar import FieldSampler
from sdf.check import check_shape
from sdf.voxel_grid import VoxelGrid


def cross_correlation(
    reachability: Float[Tensor, "X Y Z"], information: Float[Tensor, "X Y Z"]
) -> Float[Tensor, "X2 Y2 Z2"]:
    """`sum_x r(x) I(x - k)` for every whole shift k, -(n - 1) .. n - 1 along an axis of n nodes; zero outside."""
    shape = information.shape
    axes = [axis for axis, n in enumerate(shape) if n > 1]
    if not axes:
        return reachability * information
    padded = [_quick_length(2 * shape[axis] - 1) for axis in axes]
    spectrum = torch.fft.rfftn(reachability, padded, axes) * torch.fft.rfftn(information, padded, axes).conj()
    table = torch.fft.irfftn(spectrum, padded, axes)
    for axis in axes:
        table = table.roll(shape[axis] - 1, axis).narrow(axis, 0, 2 * shape[axis] - 1)
    return table


def _quick_length(least: int) -> int:
    """The next length whose Fourier transform is quick: without a prime factor above 7."""
    length = least
    while True:
        rest = length
        for factor in (2, 3, 5, 7):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return length
        length += 1


class ReachabilityCost:
    """C_R of displacements: minus the share of the information that stays reachable, mean over the steps.

    `-mean_t sum_x r(x) I(x - d_t) / sum_x I(x)`, with I multilinear between nodes and zero outside the lattice. For
    fractional d this is, exactly, the same interpolation of a table over whole shifts, the cross-correlation of r and
    I: one Fourier transform for a plan and one look-up for a displacement.

    Args:
        information: (X, Y, Z), 0 or more.
        reachability: (X, Y, Z) on the same lattice, in [0, 1].
    """

    def __init__(self, information: VoxelGrid, reachability: VoxelGrid) -> None:
        if information.values.shape != reachability.values.shape:
            raise ValueError(
                f"Expected reachability to have the shape of information, {tuple(information.values.shape)}, "
                f"got {tuple(reachability.values.shape)}: sample both on one workspace"
            )
        self.points = information.values.numel()
        total = information.values.sum()
        share = cross_correlation(reachability.values, information.values)
        share = torch.where(total > 0, share / total, torch.zeros_like(share)).clamp(0.0, 1.0)
        first = [-(n - 1.0) * information.spacing for n in information.shape]
        self._share = FieldSampler(VoxelGrid(share, share.new_tensor(first), information.spacing))

    def __call__(self, displacements: Float[Tensor, "*b H 3"]) -> Float[Tensor, "*b"]:
        """Cost in [-1, 0] of displacements after each of H steps, metres; 0 where there is no information."""
        check_shape("displacements", displacements, "(*b, H, 3)", last=(3,))
        place = self._share.place(displacements.reshape(1, -1, 3))
        return -self._share(place).view(displacements.shape[:-1]).mean(-1)
