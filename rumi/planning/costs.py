"""Information cost of trajectories: the information that a path would gather (RUMI, Eq 29)."""

import copy
import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from rumi.dynamics.base import Paths
from rumi.dynamics.tool_lookup import placement, planar_features
from sdf import backend, compiled, gpu
from sdf.voxel_grid import VoxelGrid

# rollouts whose marks are kept at once: few enough for the processor's cache
_CHUNK = 128
# cells, against rounding
_MARGIN = 0.01


class InformationCost:
    """Minus the information of all lattice cells that the sensing points meet, each counted once (RUMI, Eq 29).

    A point y meets the cell around the node next to y - d, since the field rides with the object. Given the H
    configurations after each action with the displacements there; the paper's sum starts at the present one, whose
    cells are known already, and leaves out the last. The paper gives no cell size: it is the field's own.

    Left out, with the same result: cells without information, steps at which the tool is too far from all others,
    and steps that repeat the one before.

    Args:
        information: (X, Y, Z), nats, 0 or more, 0 outside.
        points_t: sensing points of a planar tool, x and y in its frame, z in the world; of one that moves in space,
            in its frame.
        spatial: whether the tool moves in space.
        discount: factor by which a cell is worth less with each action before it is first met; 1, the paper's, leaves
            it open when in the horizon something is done.
        normalise: divide by the field's total, so that the cost is in [-1, 0]; 0 where there is no information.
    """

    def __init__(
        self,
        information: VoxelGrid,
        points_t: Float[Tensor, "M 3"],
        *,
        spatial: bool = False,
        discount: float = 1.0,
        normalise: bool = False,
    ) -> None:
        self.information, self.points_t, self.spatial = information, points_t, spatial
        self.discount = discount
        self.total: Tensor | None = None
        if normalise:
            total = information.values.sum()
            self.total = torch.where(total > 0, total, math.inf)  # without any, all shares are 0

    @cached_property
    def cells(self) -> "Cells | None":
        """What of the field can be met; None where nothing can."""
        return _cells(self.information, self.points_t, self.spatial)

    def undiscounted(self) -> "InformationCost":
        """The same of what the whole path meets, neither discounted nor a share."""
        own = copy.copy(self)  # with the cells, if they are known
        own.discount, own.total = 1.0, None
        return own

    def __call__(
        self,
        configurations: Float[Tensor, "R H Q"],
        displacements: Float[Tensor, "R H 3"],
        turns: Float[Tensor, "R H"] | None = None,
        pivot: Float[Tensor, "*#R 2"] | None = None,
    ) -> Float[Tensor, "R"]:
        """Cost of each path.

        Args:
            configurations: (x, y, yaw) after each action, in space (x, y, z, yaw).
            displacements: of the object by then, or of its point at the `pivot`, metres; z is not used.
            turns: of the object about the pivot, radians; None if never.
            pivot: of all paths, or of each.
        """
        version = backend.dispatch("gathered_information", self.information.values, configurations, displacements)
        cost = -version(self, Paths(configurations, displacements, turns, pivot))
        # sums in another order may differ in their last digit
        return cost if self.total is None else (cost / self.total).clamp_min(-1.0)


def information_cost(
    information: VoxelGrid,
    points_t: Float[Tensor, "M 3"],
    configurations: Float[Tensor, "R H Q"],
    displacements: Float[Tensor, "R H 3"],
    *,
    discount: float = 1.0,
    normalise: bool = False,
) -> Float[Tensor, "R"]:
    """`InformationCost` of one field, asked once."""
    spatial = configurations.shape[-1] == 4
    cost = InformationCost(information, points_t, spatial=spatial, discount=discount, normalise=normalise)
    return cost(configurations, displacements)


@dataclass(frozen=True, eq=False)
class Cells:
    """The cells of a field that are worth something, with the sensing points that may meet them.

    Attributes:
        value: worth of the cells in a box about all information, with a border of worthless ones in x and y, in space
            in z too, for whatever lies outside.
        layer: of each point of a planar tool; empty in space.
        scale, offset: from metres to cells of the box.
        points_t: sensing points.
        middle: of the points' box, tool frame.
        radius: of the points about it, cells.
    """

    value: Float[Tensor, "X Y Z"]
    layer: Int[Tensor, "L"]
    scale: Float[Tensor, "3"]
    offset: Float[Tensor, "3"]
    points_t: Float[Tensor, "M 3"]
    middle: Float[Tensor, "3"]
    radius: float

    @property
    def spatial(self) -> bool:
        """Whether the tool moves in space."""
        return len(self.layer) == 0


def _cells(information: VoxelGrid, points_t: Float[Tensor, "M 3"], spatial: bool) -> Cells | None:
    """None where nothing can be met."""
    some = (information.values > 0).nonzero()
    if len(some) == 0 or len(points_t) == 0:
        return None
    low, high = some.amin(0), some.amax(0)
    layer = torch.zeros(0, dtype=torch.long, device=points_t.device)
    if not spatial:
        points_t, layer = _in_layers(points_t, information, int(low[2]), int(high[2]))
        if len(points_t) == 0:
            return None
    box = information.values[low[0] : high[0] + 1, low[1] : high[1] + 1, low[2] : high[2] + 1]
    scale = torch.full_like(information.origin, 1.0 / information.spacing)
    # a cell reaches half a spacing to each side of its node
    offset = -information.origin * scale - low.to(scale) + 1.5
    lone = scale.new_tensor([float(n == 1) for n in information.shape])
    scale, offset = scale * (1.0 - lone), torch.where(lone > 0, 1.5, offset)  # a lone node holds every coordinate
    middle = 0.5 * (points_t.amin(0) + points_t.amax(0))
    radius = float((points_t - middle)[:, :2].norm(dim=-1).max() * scale.max())
    border = (1, 1, 1, 1, 1, 1) if spatial else (0, 0, 1, 1, 1, 1)
    return Cells(functional.pad(box, border), layer, scale, offset, points_t, middle, radius)


@backend.register("gathered_information")
def _gathered(cost: InformationCost, paths: Paths) -> Float[Tensor, "R"]:
    """Information of the cells that each path's points meet, discounted from the first meeting."""
    cells, discount = cost.cells, cost.discount
    configurations, displacements = paths.in_object_frame()
    if cells is None:
        return configurations.new_zeros(len(configurations))
    value, (rollouts, horizon) = cells.value, configurations.shape[:2]
    wide, deep, layers = value.shape
    features = planar_features(configurations, displacements)
    rows = _worth_counting(features, cells).nonzero()[:, 0]
    placed = placement(cells.points_t, cells.scale, cells.offset, spatial=cells.spatial)
    along_x, along_y, along_z = placed.unbind(-1)
    gathered = features.new_zeros(rollouts)
    features, owner = features.flatten(0, 1)[rows], rows // horizon
    edges = torch.arange(0, rollouts + _CHUNK, _CHUNK, device=owner.device)
    bounds = torch.searchsorted(owner, edges).tolist()
    for chunk, (first, last) in enumerate(itertools.pairwise(bounds)):
        if first == last:
            continue
        here, start = features[first:last], chunk * _CHUNK
        count = min(_CHUNK, rollouts - start)
        cell = (here @ along_x).clamp_(0.0, wide - 1.0).trunc_().mul_(float(deep))
        cell.add_((here @ along_y).clamp_(0.0, deep - 1.0).trunc_())
        # whole numbers that floats hold exactly, up to here
        layer = cells.layer
        if cells.spatial:
            layer = (here @ along_z).clamp_(0.0, layers - 1.0).long()
        index = cell.long().mul_(layers).add_(layer)
        index += ((owner[first:last] - start) * value.numel())[:, None]
        marks = value.new_zeros(count * value.numel())
        if discount == 1.0:
            marks.index_fill_(0, index.view(-1), 1.0)
        else:
            action = rows[first:last] % horizon
            # the first to meet a cell marks it last
            for late in range(horizon - 1, -1, -1):
                marks.index_fill_(0, index[action == late].view(-1), discount**late)
        gathered[start : start + count] = marks.view(count, -1) @ value.reshape(-1)
    return gathered


@backend.register("gathered_information", "numba", compiled.supports)
def _gathered_numba(cost: InformationCost, paths: Paths) -> Tensor:
    from rumi.planning.costs_numba import gathered

    cells, (configurations, displacements, turns, pivot) = cost.cells, paths
    if cells is None:
        return configurations.new_zeros(len(configurations))
    result = configurations.new_empty(len(configurations))
    along, across, up = (part.contiguous().numpy() for part in cells.points_t.unbind(-1))
    gathered(
        cells.value.contiguous().numpy(),
        None if cells.spatial else cells.layer.contiguous().numpy(),
        tuple(part.contiguous().numpy() for part in (cells.scale, cells.offset, cells.middle)),
        (along, across),
        up if cells.spatial else None,  # heights are given by the layers
        cells.radius + _MARGIN,
        configurations.contiguous().numpy(),
        displacements.contiguous().numpy(),
        # without turns an empty array: for None the kernel would be compiled once more
        (displacements.new_empty(0, 0) if turns is None else turns.contiguous()).numpy(),
        (displacements.new_empty(0, 2) if pivot is None else pivot.reshape(-1, 2).to(displacements)).numpy(),
        cost.discount,
        result.numpy(),
    )
    return result


@backend.register("gathered_information", gpu.VERSION, gpu.supports, gpu.suits)
def _gathered_warp(cost: InformationCost, paths: Paths) -> Tensor:
    from rumi.planning.trajectory_cost_warp import gathered

    return gathered(cost, *paths.in_object_frame())


def _in_layers(
    points_t: Tensor, information: VoxelGrid, low: int, high: int
) -> tuple[Float[Tensor, "M 3"], Int[Tensor, "M"]]:
    """Points at the heights of layers low..high, and the layer of each, counted from `low`."""
    if information.shape[2] == 1:
        return points_t, torch.zeros(len(points_t), dtype=torch.long, device=points_t.device)
    layer = torch.floor((points_t[:, 2] - information.origin[2]) / information.spacing + 0.5)
    keep = (layer >= low) & (layer <= high)
    return points_t[keep], layer[keep].long() - low


def _worth_counting(features: Float[Tensor, "R H F"], cells: Cells) -> Bool[Tensor, "RH"]:
    """Steps that may mark a cell of worth which the step before did not."""
    spatial = cells.spatial
    place = features @ placement(cells.middle[None], cells.scale, cells.offset, spatial=spatial)[:, 0, :2]
    limit = place.new_tensor([float(n - 1) for n in cells.value.shape[:2]])
    gap = torch.maximum(1.0 - place, place - limit).amax(-1)
    near = gap <= cells.radius + _MARGIN
    again = (features[:, 1:] == features[:, :-1]).all(-1)
    near[:, 1:] &= ~again
    return near.reshape(-1)
