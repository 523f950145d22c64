"""Points of a level tool, placed on a lattice by one matrix product, and lattice fields looked up there."""

import math
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from sdf.check import may_look
from sdf.voxel_grid import VoxelGrid


def world_height(points_t: Float[Tensor, "M 3"], height: float) -> Float[Tensor, "M 3"]:
    """Points of the tool frame with the heights that they have in the world while the tool keeps to its plane."""
    raised = points_t.clone()
    raised[:, 2] += height
    return raised


def planar_features(
    configurations: Float[Tensor, "*b Q"], displacements: Float[Tensor, "*b 3"] | None = None
) -> Float[Tensor, "*b F"]:
    """(cos yaw, sin yaw, x, y, 1) of configurations (x, y, yaw), in the frame of an object moved by `displacements`.

    A world point y meets the object where y - d met it before it moved, hence x - dx and y - dy; objects stay on the
    floor, so that there is no use for dz. A configuration in space (x, y, z, yaw) has its z as a sixth feature.
    """
    x, y, yaw = configurations[..., 0], configurations[..., 1], configurations[..., -1]
    if displacements is not None:
        x, y = x - displacements[..., 0], y - displacements[..., 1]
    features = (yaw.cos(), yaw.sin(), x, y, torch.ones_like(x))
    return torch.stack((*features, configurations[..., 2]) if configurations.shape[-1] == 4 else features, -1)


def placement(
    points_t: Float[Tensor, "M 3"], scale: Float[Tensor, "3"], offset: Float[Tensor, "3"], *, spatial: bool = False
) -> Float[Tensor, "F M 3"]:
    """Matrix from `planar_features` to `scale * point + offset` of every tool point.

    Args:
        points_t: metres; x and y in the tool frame, z in the world, or with `spatial` in the tool frame too.
        scale: of each world axis.
        offset: of each world axis, after scaling.
        spatial: whether the features are those of configurations in space.
    """
    px, py, pz = points_t.unbind(-1)
    none, one = torch.zeros_like(px), torch.ones_like(px)
    along_x = torch.stack((px, -py, one, none, none)) * scale[0]
    along_y = torch.stack((py, px, none, one, none)) * scale[1]
    along_z = torch.stack((none, none, none, none, pz * scale[2]))
    matrix = torch.stack((along_x, along_y, along_z), -1)
    matrix[4] += offset
    if not spatial:
        return matrix
    rise = torch.stack((none, none, one * scale[2]), -1)
    return torch.cat((matrix, rise[None]))


def at_height(grid: VoxelGrid, height: float) -> VoxelGrid:
    """The planar field that `grid` is at one height; zero fades in above and below the lattice.

    Itself where it is planar, or where the host may not look: it can be looked up at any height as well.
    """
    if grid.shape[2] == 1 or not may_look(grid.values):
        return grid
    place = (height - float(grid.origin[2])) / grid.spacing
    below = math.floor(place)
    weights = {below: 1.0 - (place - below), below + 1: place - below}
    layer = torch.zeros_like(grid.values[:, :, :1])
    for index, weight in weights.items():
        if 0 <= index < grid.shape[2]:
            layer = layer + weight * grid.values[:, :, index : index + 1]
    return VoxelGrid(layer, grid.origin, grid.spacing)


class FieldSampler:
    """A lattice field, looked up quickly; zero fades in outside the lattice.

    Gives what `VoxelGrid.interpolate(points, outside=0)` gives, up to rounding, by the library's image sampler, whose
    coordinates of a point are `point * scale + offset` (x and y alone where the field is planar).

    Args:
        grid: (X, Y, Z) or (X, Y, Z, C); an axis with one node is constant along it.
        mode: "bilinear", multilinear between nodes, or "nearest".
    """

    def __init__(self, grid: VoxelGrid, mode: Literal["bilinear", "nearest"] = "bilinear") -> None:
        self.mode = mode
        dims = 2 if grid.shape[2] == 1 else 3
        counts = grid.origin.new_tensor([float(n) for n in grid.shape])[:dims]
        # the sampler wants -1 at the first node and 1 at the last
        self.scale = torch.where(counts > 1, 2.0 / (grid.spacing * (counts - 1.0).clamp_min(1.0)), 0.0)
        self.offset = torch.where(counts > 1, -grid.origin[:dims] * self.scale - 1.0, 0.0)
        values = grid.values if grid.values.ndim == 4 else grid.values[..., None]
        values = values.permute(3, 2, 1, 0)  # its first coordinate is along the last axis
        self.values = (values[:, 0] if dims == 2 else values)[None].contiguous()

    def place(self, points: Float[Tensor, "E M 3"]) -> Float[Tensor, "E M dims"]:
        """Sampler coordinates of points."""
        return torch.addcmul(self.offset, points[..., : len(self.scale)], self.scale)

    def __call__(self, place: Float[Tensor, "E M dims"]) -> Float[Tensor, "C E M"]:
        """Values at sampler coordinates."""
        grid = place[None] if place.shape[-1] == 2 else place[None, None]
        values = functional.grid_sample(self.values, grid, mode=self.mode, padding_mode="zeros", align_corners=True)
        return values.reshape(self.values.shape[1], *place.shape[:2])


class ToolField:
    """A lattice field, looked up at points that are tied to a level tool; see `FieldSampler`.

    Args:
        grid: the field.
        points_t: points of the tool; x and y in its frame, z in the world, or with `spatial` in its frame too.
        mode: as for `FieldSampler`.
        spatial: whether the tool moves in space.
    """

    def __init__(
        self,
        grid: VoxelGrid,
        points_t: Float[Tensor, "M 3"],
        mode: Literal["bilinear", "nearest"] = "bilinear",
        *,
        spatial: bool = False,
    ) -> None:
        self._sample = FieldSampler(grid, mode)
        scale, offset = self._sample.scale, self._sample.offset
        if len(scale) == 2:  # no sampler coordinate along z
            scale, offset = functional.pad(scale, [0, 1]), functional.pad(offset, [0, 1])
        self._matrix = placement(points_t, scale, offset, spatial=spatial)[..., : len(self._sample.scale)]
        self._flat = self._matrix.reshape(len(self._matrix), -1).contiguous()

    def __call__(self, features: Float[Tensor, "E F"]) -> Float[Tensor, "C E M"]:
        """Values at every point of the tool for each row of `planar_features`."""
        return self._sample((features @ self._flat).view(len(features), *self._matrix.shape[1:]))

    def at(self, features: Float[Tensor, "E F"], index: Int[Tensor, "E"]) -> Float[Tensor, "C E"]:
        """Values at one point of the tool for each row of features."""
        place = (features.mT[..., None] * self._matrix[:, index]).sum(0)
        return self._sample(place[:, None])[..., 0]
