"""What a planned motion is worth: the information that its path would gather (RUMI, Eq 29)."""

import itertools

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.planar import placement, planar_features
from sdf import backend, fused
from sdf.voxel_grid import VoxelGrid

# rollouts whose marks are kept at once: few enough for the processor's cache
_CHUNK = 128


def information_cost(
    information: VoxelGrid,
    points_t: Float[Tensor, "M 3"],
    configurations: Float[Tensor, "R H 3"],
    displacements: Float[Tensor, "R H 3"],
    *,
    discount: float = 1.0,
    normalise: bool = False,
) -> Float[Tensor, "R"]:
    """Minus the information of all lattice cells that the sensing points meet, each counted once (RUMI, Eq 29).

    A point y meets the cell around the node next to y - d, since the field rides with the object. Given the H
    configurations after each action with the displacements there; the paper's sum starts at the present one, whose
    cells are known already, and leaves out the last. The paper gives no cell size: it is the field's own.

    Left out, with the same result: cells without information, steps at which the tool is too far from all others,
    and steps that repeat the one before.

    Args:
        information: (X, Y, Z), nats, 0 or more, 0 outside.
        points_t: sensing points of a planar tool; x and y in its frame, z in the world.
        configurations: (x, y, yaw) after each action.
        displacements: of the object by then, metres; z is not used.
        discount: factor by which a cell is worth less with each action before it is first met; 1, the paper's, leaves
            it open when in the horizon something is done.
        normalise: divide by the field's total, so that the cost is in [-1, 0]; 0 where there is no information.
    """
    rollouts, horizon = configurations.shape[:2]
    total = information.values.sum()
    cost = configurations.new_zeros(rollouts)
    some = (information.values > 0).nonzero()
    if len(some) == 0 or len(points_t) == 0:
        return cost
    low, high = some.amin(0), some.amax(0)
    points_t, layer = _in_layers(points_t, information, int(low[2]), int(high[2]))
    if len(points_t) == 0:
        return cost
    # cells of the box about all information, with a border of worthless ones for whatever lies outside
    box = information.values[low[0] : high[0] + 1, low[1] : high[1] + 1, low[2] : high[2] + 1]
    value = torch.nn.functional.pad(box, (0, 0, 1, 1, 1, 1))
    sizes = (value.shape[0], value.shape[1], value.shape[2])
    scale = torch.full_like(information.origin, 1.0 / information.spacing)
    # a cell reaches half a spacing to each side of its node
    offset = -information.origin * scale - low.to(scale) + 1.5
    lone = scale.new_tensor([float(n == 1) for n in information.shape])
    scale, offset = scale * (1.0 - lone), torch.where(lone > 0, 1.5, offset)  # a lone node holds every coordinate

    features = planar_features(configurations, displacements)
    near = _worth_counting(features, points_t, scale, offset, sizes).view(rollouts, horizon)
    x, y, _ = placement(points_t, scale, offset).unbind(-1)
    version = backend.dispatch("gathered_information", value, features)
    cost = -version(value, layer, x, y, features, near, discount)
    # sums in another order may differ in their last digit
    return (cost / total).clamp_min(-1.0) if normalise else cost


@backend.register("gathered_information")
def _gathered(
    value: Float[Tensor, "X Y Z"],
    layer: Int[Tensor, "M"],
    along_x: Float[Tensor, "5 M"],
    along_y: Float[Tensor, "5 M"],
    features: Float[Tensor, "R H 5"],
    near: Bool[Tensor, "R H"],
    discount: float,
) -> Float[Tensor, "R"]:
    """Worth of the cells that each rollout's points meet at the steps `near`, discounted from the first meeting."""
    rollouts, horizon = near.shape
    wide, deep, layers = value.shape
    gathered = features.new_zeros(rollouts)
    rows = near.reshape(-1).nonzero()[:, 0]
    features, owner = features.reshape(-1, 5)[rows], rows // horizon
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


@backend.register("gathered_information", "numba", fused.supports)
def _gathered_numba(
    value: Tensor, layer: Tensor, along_x: Tensor, along_y: Tensor, features: Tensor, near: Tensor, discount: float
) -> Tensor:
    from rumi.planning.costs_numba import gathered

    result = features.new_zeros(len(features))
    arrays = (part.contiguous().numpy() for part in (value, layer, along_x, along_y, features, near))
    gathered(*arrays, discount, result.numpy())
    return result


def _in_layers(
    points_t: Tensor, information: VoxelGrid, low: int, high: int
) -> tuple[Float[Tensor, "M 3"], Int[Tensor, "M"]]:
    """Points at the heights of layers low..high, and the layer of each, counted from `low`."""
    if information.shape[2] == 1:
        return points_t, torch.zeros(len(points_t), dtype=torch.long, device=points_t.device)
    layer = torch.floor((points_t[:, 2] - information.origin[2]) / information.spacing + 0.5)
    keep = (layer >= low) & (layer <= high)
    return points_t[keep], layer[keep].long() - low


def _worth_counting(
    features: Float[Tensor, "R H 5"],
    points_t: Float[Tensor, "M 3"],
    scale: Float[Tensor, "3"],
    offset: Float[Tensor, "3"],
    sizes: tuple[int, int, int],
) -> Tensor:
    """(R * H) mask of the steps that may mark a cell of worth which the step before did not."""
    middle = 0.5 * (points_t.amin(0) + points_t.amax(0))
    radius = (points_t - middle)[:, :2].norm(dim=-1).max() * scale.max()
    place = features @ placement(middle[None], scale, offset)[:, 0, :2]
    limit = place.new_tensor([float(n - 1) for n in sizes[:2]])
    # a margin against rounding, cells
    gap = torch.maximum(1.0 - place, place - limit).amax(-1)
    near = gap <= radius + 0.01
    again = (features[:, 1:] == features[:, :-1]).all(-1)
    near[:, 1:] &= ~again
    return near.reshape(-1)
