"""Contact field of a belief: probability of contact and expected surface normal at every place of the tool."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
import torch.nn.functional as nnf
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.tool_lookup import ToolField
from rumi.fields.information import WorkspaceFields
from rumi.fields.normal import expected_normal
from rumi.fields.workspace import Workspace
from sdf import backend, compiled, gpu
from sdf.base import SDF
from sdf.voxel_grid import VoxelGrid


@dataclass(frozen=True, eq=False)
class ContactField:
    """Contact field of a belief, as a push model reads it.

    Attributes:
        probability: (X, Y, Z), that a robot point there touches the object: 1 - p(free).
        normal: (X, Y, Z, 3), mean outward normal of the object, world frame.
    """

    probability: VoxelGrid
    normal: VoxelGrid

    @classmethod
    def from_belief(
        cls,
        sdf: SDF,
        world_T_object: Float[Tensor, "N 4 4"],
        log_weights: Float[Tensor, "N"],
        workspace: Workspace,
        fields: WorkspaceFields,
        *,
        least: float = 1e-3,
    ) -> Self:
        """Field of one scene.

        Normals are worked out only at the nodes around a point whose contact probability is `least` or more, and
        left 0 elsewhere: rarer contacts than that may be taken as not pushing.
        """
        probability = workspace.grid(fields.contact)
        likely = (probability.values >= least).to(probability.values.dtype)[None, None]
        where = (nnf.max_pool3d(likely, 3, stride=1, padding=1) > 0).reshape(-1)
        normal = expected_normal(sdf, world_T_object, log_weights, workspace.points, where)
        return cls(probability, workspace.grid(normal))


class ContactBound:
    """Upper bound on the contact probability of a tool, from a few look-ups instead of one for each point.

    The tool's points lie in discs, in space in balls. What a disc can meet is at most the greatest node value that
    interpolation at any point of it may draw on: a maximum filter of the field, looked up at the node next to the
    disc's centre.

    Args:
        probability: contact probability (X, Y, Z).
        centres_t: centres of discs that cover the tool's points, or of balls, tool frame.
        radius: of the discs, metres.
    """

    def __init__(self, probability: VoxelGrid, centres_t: Float[Tensor, "D A"], radius: float) -> None:
        self.spatial = centres_t.shape[-1] == 3
        if self.spatial:
            self.grid, self.centres_t = _spread_in_space(probability, radius), centres_t
            return
        highest = probability.values.amax(2)
        cells = radius / probability.spacing
        filtered, margin = _spread(highest, cells)
        shift = gpu.constant((*map(float, margin), 0.0), highest.dtype, highest.device)
        origin = probability.origin - probability.spacing * shift
        self.grid = VoxelGrid(filtered[..., None], origin, probability.spacing)
        self.centres_t = torch.cat((centres_t, torch.zeros_like(centres_t[:, :1])), -1)

    @cached_property
    def _field(self) -> ToolField:
        return ToolField(self.grid, self.centres_t, "nearest", spatial=self.spatial)

    def __call__(self, features: Float[Tensor, "E F"]) -> Float[Tensor, "E"]:
        """Greatest contact probability that any tool point can have, for each row of `planar_features`."""
        return self._field(features)[0].amax(-1)


def _spread_in_space(grid: VoxelGrid, radius: float) -> VoxelGrid:
    """Maximum over a cube that holds a ball of `radius` metres, on a lattice wider by as much on every side.

    As for `_spread`: a ball's points draw on nodes up to its radius and 1.5 cells off the node next to its centre.
    """
    reach = int(radius / grid.spacing + 1.5 + 1e-3)
    values = nnf.pad(grid.values[None, None], [reach] * 6)
    for axis in range(3):
        kernel = [1, 1, 1]
        kernel[axis] = 2 * reach + 1
        values = nnf.max_pool3d(values, kernel, stride=1, padding=[k // 2 for k in kernel])
    return VoxelGrid(values[0, 0], grid.origin - reach * grid.spacing, grid.spacing)


def _spread(values: Float[Tensor, "X Y"], radius: float) -> tuple[Float[Tensor, "X2 Y2"], tuple[int, int]]:
    """Maximum over a disc of `radius` cells, widened by what interpolation and rounding to nodes may add.

    A point within `radius` of a centre draws on nodes less than 1 cell away from it along each axis, and the node next
    to the centre is at most half a cell off along each: the footprint is the disc swept over a square of 1.5 cells.

    Returns:
        the maxima on a lattice that is wider by some nodes on every side (none along an axis with a single node, on
        which fields do not change), and these numbers.
    """
    half = 1.5 + 1e-3
    widest = int(radius + half) + 1
    mx, my = (widest if n > 1 else 0 for n in values.shape)
    reaches = [radius**2 - max(abs(row) - half, 0.0) ** 2 for row in range(-mx, mx + 1)]
    # nodes to each side that count in each row of the footprint; -1 for none at all
    widths = [-1 if rest < 0 else min(int(half + rest**0.5), my) for rest in reaches]
    return backend.dispatch("spread", values)(values, widths, my), (mx, my)


@backend.register("spread")
def _spread_plain(values: Float[Tensor, "X Y"], widths: list[int], margin: int) -> Float[Tensor, "X2 Y2"]:
    middle = len(widths) // 2
    padded = nnf.pad(values[None, None], [margin, margin, middle, middle])
    result = torch.zeros_like(padded)
    height = padded.shape[2]
    for row, width in enumerate(widths, -middle):
        if width < 0:
            continue
        along = nnf.max_pool2d(nnf.pad(padded, (width, width)), (1, 2 * width + 1), stride=1)
        low, high = max(0, -row), min(height, height - row)
        result[:, :, low:high] = torch.maximum(result[:, :, low:high], along[:, :, low + row : high + row])
    return result[0, 0]


@backend.register("spread", "numba", compiled.supports)
def _spread_numba(values: Float[Tensor, "X Y"], widths: list[int], margin: int) -> Float[Tensor, "X2 Y2"]:
    from rumi.dynamics.displacement_numba import spread

    result = values.new_zeros(values.shape[0] + len(widths) - 1, values.shape[1] + 2 * margin)
    spread(values.contiguous().numpy(), torch.tensor(widths).numpy(), margin, result.numpy())
    return result


@backend.register("spread", gpu.VERSION, gpu.supports, gpu.suits)
def _spread_warp(values: Float[Tensor, "X Y"], widths: list[int], margin: int) -> Float[Tensor, "X2 Y2"]:
    from rumi.dynamics.contact_warp import spread

    result = values.new_empty(values.shape[0] + len(widths) - 1, values.shape[1] + 2 * margin)
    spread.launch(result.shape, values, gpu.constant(tuple(widths), torch.int64, values.device), result)
    return result
