"""Workspace: the lattice of world points on which fields live."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.check import check_finite, check_near, check_shape
from sdf.voxel_grid import MOST_NODES, VoxelGrid


@dataclass(frozen=True, eq=False)
class Workspace:
    """A box of lattice points in the world; a planar one has a single layer.

    Attributes:
        origin: (3,), metres, the first lattice point.
        spacing: metres between neighbours.
        shape: points along x, y and z; 1 along z for a planar workspace.
    """

    origin: Float[Tensor, "3"]
    spacing: float
    shape: tuple[int, int, int]

    @classmethod
    def from_bounds(cls, bounds: Float[Tensor, "2 3"], spacing: float, *, planar_height: float | None = None) -> Self:
        """Lattice from the lower to the upper corner, both included as far as `spacing` divides the box.

        Args:
            bounds: (2, 3), metres, lower and upper corner.
            spacing: metres between neighbours.
            planar_height: height of the only layer; None for a lattice that fills the box.
        """
        check_shape("bounds", bounds, "(2, 3)", last=(2, 3))
        check_finite("bounds", bounds)
        check_near("bounds", bounds)
        if not 0 < spacing < math.inf:
            raise ValueError(f"Expected spacing to be a positive number of metres, got {spacing}")
        if bool((bounds[1] < bounds[0]).any()):
            raise ValueError(
                f"Expected bounds to be (lower, upper) with lower <= upper, got {bounds.tolist()}: swap the corners"
            )
        ratios = ((bounds[1] - bounds[0]).double() / spacing + 1.0).tolist()
        if not math.prod(ratios) < MOST_NODES:
            raise ValueError(
                f"Expected fewer than {MOST_NODES:.0e} lattice points, got {bounds.tolist()} m with one every "
                f"{spacing:g} m: widen the spacing, or narrow the bounds"
            )
        # a hair more than the ratio, so that rounding of the corners loses no point
        slack = 1e-4 + 4.0 * torch.finfo(bounds.dtype).eps * float(bounds.abs().max()) / spacing
        steps = ((bounds[1] - bounds[0]).double() / spacing + min(slack, 0.5)).floor().long() + 1
        origin = bounds[0].clone()
        if planar_height is not None:
            origin[2] = planar_height
            steps[2] = 1
        return cls(origin, float(spacing), (int(steps[0]), int(steps[1]), int(steps[2])))

    @cached_property
    def points(self) -> Float[Tensor, "V 3"]:
        """World points of the lattice, metres; z runs fastest, then y."""
        axes = [
            self.origin[axis] + self.spacing * torch.arange(count, dtype=self.origin.dtype, device=self.origin.device)
            for axis, count in enumerate(self.shape)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Lower and upper corner of the lattice points, metres."""
        return torch.stack(
            (self.origin, self.origin + self.spacing * (self.origin.new_tensor([float(n - 1) for n in self.shape])))
        )

    @property
    def planar(self) -> bool:
        """Whether the lattice has a single layer."""
        return self.shape[2] == 1

    def __len__(self) -> int:
        """Number of lattice points."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    def grid(self, values: Float[Tensor, "V *c"]) -> VoxelGrid:
        """A field on this lattice from its values at `points`."""
        if values.shape[:1] != (len(self),):
            raise ValueError(
                f"Expected values to have shape ({len(self)}, *c), one row a workspace point, got {tuple(values.shape)}"
            )
        return VoxelGrid(values.reshape(*self.shape, *values.shape[1:]), self.origin, self.spacing)

    def zeros(self, *channels: int) -> VoxelGrid:
        """The field that is zero everywhere."""
        return self.grid(self.origin.new_zeros(len(self), *channels))

    def to(self, *args: torch.device | torch.dtype | str) -> Self:
        """Move to a device or a floating dtype."""
        return type(self)(self.origin.to(*args), self.spacing, self.shape)  # type: ignore[call-overload]
