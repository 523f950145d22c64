"""Voxel grid of values in the world: interpolated look-up, and keys of lattice cells."""

import math
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from sdf.check import check_shape, keep_within_reach
from sdf.lookup import interpolate

BITS = 17
"""Bits of a lattice key that each axis has."""
_HALF = 1 << (BITS - 1)
MOST_NODES = 2**28
"""Numbers that a lattice may hold: 1 GiB of float32."""


def lattice_keys(points: Float[Tensor, "*b 3"], spacing: float | Float[Tensor, "*b"]) -> Int[Tensor, "*b"]:
    """One integer, 51 bits and not negative, for each point's cell of the world lattice `floor(x / spacing)`.

    The lattice is the world's, never the cloud's own, so that thinning twice is thinning once.

    Args:
        points: (*b, 3), metres.
        spacing: metres, one for all points or (*b); keys of different spacings are not comparable.

    Raises:
        ValueError: if a point is not finite or farther than 65536 cells from the origin.
    """
    check_shape("points", points, "(*b, 3)")
    pitch = spacing[..., None] if isinstance(spacing, Tensor) else spacing
    cell = torch.floor(points / pitch)
    if not bool(((cell >= -_HALF) & (cell < _HALF)).all()):
        raise ValueError(
            f"Expected points within {_HALF} lattice cells of the origin, got coordinates up to "
            f"{float(points.abs().max()):g} m: remove points that are not finite or far off, or widen the spacing"
        )
    x, y, z = (cell.long() + _HALF).unbind(-1)
    return (x << (2 * BITS)) | (y << BITS) | z


class VoxelGrid(nn.Module):
    """Values at the nodes of a lattice fixed in the world, with any channels.

    An axis with a single node carries no extent: the field is constant along it (planar fields).

    Args:
        values: (X, Y, Z, *C).
        origin: (3,), metres, where node (0, 0, 0), the centre of cell 0, is.
        spacing: metres between nodes.
    """

    values: Float[Tensor, "X Y Z *C"]
    origin: Float[Tensor, "3"]

    def __init__(self, values: Float[Tensor, "X Y Z *C"], origin: Float[Tensor, "3"], spacing: float) -> None:
        super().__init__()
        check_shape("values", values, "(X, Y, Z, *C)")
        check_shape("origin", origin, "(3,)")
        if not spacing > 0:
            raise ValueError(f"Expected spacing to be a positive number of metres, got {spacing}")
        self.register_buffer("values", values)
        self.register_buffer("origin", origin)
        self.spacing = float(spacing)

    @classmethod
    def from_bounds(cls, bounds: Float[Tensor, "2 3"], spacing: float, *, channels: tuple[int, ...] = ()) -> Self:
        """A lattice of zeros with nodes from the lower corner to at least the upper one.

        An extent of n spacings has n + 1 nodes; an axis of no extent has one.
        """
        check_shape("bounds", bounds, "(2, 3)")
        extent = ((bounds[1] - bounds[0]) / spacing).tolist()
        if not 0 < spacing < math.inf:
            raise ValueError(f"Expected spacing to be a positive number of metres, got {spacing}")
        if not min(extent) >= 0:
            raise ValueError(f"Expected bounds as (lower, upper) corners, got {bounds.tolist()}: swap them")
        if not math.prod(ratio + 1.0 for ratio in extent) * math.prod(channels) < MOST_NODES:
            raise ValueError(
                f"Expected fewer than {MOST_NODES:.0e} numbers in a lattice, got {bounds.tolist()} m with a node every "
                f"{spacing:g} m: widen the spacing, or narrow the bounds"
            )
        # a hair less than the ratio, so that rounding adds no node
        shape = [int(-(-(ratio - 1e-4) // 1)) + 1 for ratio in extent]
        return cls(bounds.new_zeros(*shape, *channels), bounds[0].clone(), spacing)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along x, y, z."""
        x, y, z = self.values.shape[:3]
        return x, y, z

    def with_values(self, values: Float[Tensor, "X Y Z *C"]) -> "VoxelGrid":
        """The same lattice with other values (and channels)."""
        return VoxelGrid(values, self.origin, self.spacing)

    def centers(self) -> Float[Tensor, "X Y Z 3"]:
        """Where each node is, metres."""
        axes = [
            self.origin[i] + self.spacing * torch.arange(n, dtype=self.origin.dtype, device=self.origin.device)
            for i, n in enumerate(self.shape)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)

    def nearest_index(self, points: Float[Tensor, "*b 3"]) -> tuple[Int[Tensor, "*b 3"], Bool[Tensor, "*b"]]:
        """Cell that holds each point, clamped to the lattice, and whether the point was inside it.

        Cells reach half a spacing to each side of their node; an axis with one node holds every coordinate.
        """
        last = torch.tensor([n - 1 for n in self.shape], device=points.device)
        cell = torch.floor((keep_within_reach(points) - self.origin) / self.spacing + 0.5)
        inside = ((cell >= 0) & (cell <= last) | (last == 0)).all(-1)
        return torch.minimum(cell.clamp_min(0.0), last.to(cell)).long(), inside

    def interpolate(
        self, points: Float[Tensor, "*b 3"], outside: float | Float[Tensor, "*C"] | None = 0.0
    ) -> Float[Tensor, "..."]:
        """Multilinear interpolation (*b, *C) of the values at some points; differentiable to points and values.

        Args:
            points: (*b, 3), metres; a coordinate that is not finite counts as far outside.
            outside: value of every node beyond the lattice, so that the field fades to it over one spacing and
                stays continuous; None continues the border's values instead.
        """
        check_shape("points", points, "(*b, 3)")
        values, margin = self.values, 0
        if outside is not None:
            margin = 1
            padding = [0, 0] * (values.ndim - 3)
            for n in reversed(self.shape):
                padding += [0, 0] if n == 1 else [1, 1]
            if isinstance(outside, Tensor):
                values = functional.pad(values - outside, padding) + outside
            else:
                values = functional.pad(values, padding, value=outside)
        cells = [
            ((keep_within_reach(plane) - start) / self.spacing).clamp(-margin, n - 1 + margin) + margin
            for plane, start, n in zip(points.unbind(-1), self.origin.unbind(-1), self.shape, strict=True)
        ]
        return interpolate(values, cells)
