"""Weighted sets of states as points of a space with angles: differences, merged duplicates, neighbours."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.weights import check_weights
from sdf import backend, compiled
from sdf.bounds import Checked, Positive
from sdf.check import check_finite, is_eager
from sdf.numbers import refuse_trained
from sdf.so3 import wrap

# bytes of pairwise differences that are held at once
_BYTES = 64 << 20


@dataclass(frozen=True)
class StateMetric(Checked):
    """Metric of states, the same at all times, so that entropies can be compared.

    Metres and radians have no common unit: a neighbour by raw numbers is a neighbour in yaw alone.

    Attributes:
        scales: of each dimension, by which differences are divided before distances are taken; a prior's standard
            deviations, or metres and what a radian moves the object's border by.
        angles: whether each dimension is an angle, whose differences are wrapped to half a turn.
    """

    scales: tuple[Positive, ...]
    angles: tuple[bool, ...]

    def __post_init__(self) -> None:
        """Refuse what is no metric."""
        refuse_trained(self)
        super().__post_init__()
        if len(self.scales) != len(self.angles) or not self.scales:
            raise ValueError(f"Expected as many scales as angles, got {len(self.scales)} and {len(self.angles)}")

    @classmethod
    def euclidean(cls, dims: int) -> Self:
        """No angles, one unit."""
        return cls((1.0,) * dims, (False,) * dims)

    @classmethod
    def planar(cls, lever_m: float) -> Self:
        """(x, y, yaw) of an object that is about `lever_m` wide to each side: a radian counts as that many metres."""
        return cls((1.0, 1.0, 1.0 / lever_m), (False, False, True))

    @property
    def dims(self) -> int:
        """Number of dimensions."""
        return len(self.scales)

    def difference(self, a: Float[Tensor, "*#b D"], b: Float[Tensor, "*#b D"]) -> Float[Tensor, "*#b D"]:
        """Difference a - b, angles wrapped to [-pi, pi)."""
        raw = a - b
        if not any(self.angles):
            return raw
        wrapped = wrap(raw)
        return torch.where(torch.tensor(self.angles, device=raw.device), wrapped, raw)

    def whitened(self, differences: Float[Tensor, "*b D"]) -> Float[Tensor, "*b D"]:
        """Differences in units of the scales."""
        return differences / differences.new_tensor(self.scales)


class UniqueStates(NamedTuple):
    """A set in which each state counts once.

    Attributes:
        log_weights: (*b, N), of the first of equal states their sum, of the others -inf; normalised.
        first: (*b, N), whether a state is the first of its equals and has weight.
        states: (*b), how many there are of them.
    """

    log_weights: Float[Tensor, "*b N"]
    first: Bool[Tensor, "*b N"]
    states: Int[Tensor, "*b"]


def unique_states(
    states: Float[Tensor, "*b N D"], log_weights: Float[Tensor, "*#b N"], metric: StateMetric
) -> UniqueStates:
    """The same mixture without duplicates, as resampling leaves them; states without weight are left out too.

    Raises:
        ValueError: no states, some that are not finite, or weights as `check_weights` refuses them.
    """
    check_weights(log_weights)
    check_finite("states", states)
    log_weights = log_weights.expand(states.shape[:-1]).log_softmax(-1)
    flat, weights = states.reshape(-1, *states.shape[-2:]), log_weights.reshape(-1, states.shape[-2])
    version = backend.dispatch("leading_states", flat, weights)
    leader = version(flat, weights, metric)
    lead = weights.new_full(weights.shape, 0.0).scatter_add(-1, leader, weights.exp())
    own = torch.arange(leader.shape[-1], device=leader.device)
    first = (leader == own) & (weights > -math.inf)
    log = torch.where(first, torch.where(first, lead, 1.0).log(), -math.inf)
    shape = states.shape[:-1]
    return UniqueStates(log.view(shape), first.view(shape), first.sum(-1).view(shape[:-1]))


class Neighbours(NamedTuple):
    """Neighbours of each state.

    Attributes:
        sides: (*b, N, D), of the tight box about its nearest, 0 for states that do not count.
        distance: (*b, N), to the farthest of them, in units of the scales.
        mass: (*b, N), weight of the nearest, the state itself left out.
        used: (*b), how many nearest there were: as asked for, or all.
    """

    sides: Float[Tensor, "*b N D"]
    distance: Float[Tensor, "*b N"]
    mass: Float[Tensor, "*b N"]
    used: Int[Tensor, "*b"]


def neighbours(
    states: Float[Tensor, "*b N D"], unique: UniqueStates, metric: StateMetric, count: int, *, include_self: bool
) -> Neighbours:
    """The `count` nearest states of each one, itself among them or not; all where there are fewer."""
    shape, size = states.shape[:-1], states.shape[-2]
    flat, first = states.reshape(-1, *states.shape[-2:]), unique.first.reshape(-1, size)
    weights = unique.log_weights.reshape(-1, size).exp()
    there = unique.states.reshape(-1)
    used = torch.minimum(there if include_self else there - 1, torch.full_like(there, count)).clamp_min(0)
    version = backend.dispatch("nearest_states", flat, weights)
    sides, distance, mass = version(flat, first, weights, metric, used, include_self)
    return Neighbours(sides.view(states.shape), distance.view(shape), mass.view(shape), used.view(shape[:-1]))


@backend.register("leading_states")
def _leaders(flat: Float[Tensor, "B N D"], weights: Float[Tensor, "B N"], metric: StateMetric) -> Int[Tensor, "B N"]:
    """The first state of weight that is equal to each; 0 where there is none."""
    leaders = [torch.zeros(0, weights.shape[-1], dtype=torch.long, device=flat.device)]
    for part in _parts(flat):
        same = (metric.difference(flat[part, :, None], flat[part, None]) == 0).all(-1)
        same = same & (weights[part] > -math.inf)[:, None, :]
        leaders.append(same.to(torch.uint8).argmax(-1))
    return torch.cat(leaders)


@backend.register("leading_states", "numba", compiled.supports)
def _leaders_numba(flat: Tensor, weights: Tensor, metric: StateMetric) -> Tensor:
    from rumi.information.neighbours_numba import leaders

    leader = torch.empty(weights.shape, dtype=torch.long)
    leaders(*compiled.arrays_of(flat, weights), np.array(metric.angles), leader.numpy())
    return leader


@backend.register("nearest_states")
def _nearest(
    flat: Float[Tensor, "B N D"],
    first: Bool[Tensor, "B N"],
    weights: Float[Tensor, "B N"],
    metric: StateMetric,
    used: Int[Tensor, "B"],
    include_self: bool,
) -> tuple[Float[Tensor, "B N D"], Float[Tensor, "B N"], Float[Tensor, "B N"]]:
    """Sides, distance and mass of the `used` nearest of each state that is `first`."""
    size, dims = flat.shape[1:]
    nothing = torch.zeros_like(flat), torch.zeros_like(weights), torch.zeros_like(weights)
    # what is traced sorts all: how many count is in the values
    take = size if not is_eager() else min(size, int(used.max()) + (not include_self)) if len(used) else 0
    if take < 2:
        return nothing
    found = []
    rank = torch.arange(take, device=flat.device)
    own = torch.eye(size, dtype=torch.bool, device=flat.device)
    for part in _parts(flat):
        apart = metric.difference(flat[part, None], flat[part, :, None])  # [b, i, j]: j as seen from i
        square = metric.whitened(apart).square().sum(-1)
        # the state itself is the nearest, whatever rounding says of others
        square = square.masked_fill(~first[part, None, :], math.inf).masked_fill(own, -1.0)
        near = square.topk(take, dim=-1, largest=False, sorted=True)
        counts = (rank < used[part, None, None] + (not include_self)) & (near.values < math.inf)
        if not include_self:
            counts = counts & (rank > 0)
        around = apart.gather(2, near.indices[..., None].expand(-1, -1, -1, dims))
        high = torch.where(counts[..., None], around, torch.full_like(around, -math.inf)).amax(2)
        low = torch.where(counts[..., None], around, torch.full_like(around, math.inf)).amin(2)
        others = counts & (rank > 0)
        valid = first[part] & others.any(-1)
        sides = torch.where(valid[..., None], high - low, 0.0)
        farthest = torch.where(others, near.values, torch.zeros_like(near.values)).amax(-1)
        distance = torch.where(valid, torch.where(valid, farthest, 1.0).sqrt(), 0.0)
        held = weights[part, None, :].expand(-1, size, -1).gather(2, near.indices)
        found.append((sides, distance, torch.where(valid, torch.where(others, held, 0.0).sum(-1), 0.0)))
    sides, distance, mass = (torch.cat(column) for column in zip(*found, strict=True))
    return sides, distance, mass


@backend.register("nearest_states", "numba", compiled.supports)
def _nearest_numba(
    flat: Tensor, first: Tensor, weights: Tensor, metric: StateMetric, used: Tensor, include_self: bool
) -> tuple[Tensor, Tensor, Tensor]:
    from rumi.information.neighbours_numba import nearest

    sides, distance, mass = torch.zeros_like(flat), torch.zeros_like(weights), torch.zeros_like(weights)
    nearest(
        *compiled.arrays_of(flat, first, weights),
        np.array(metric.scales),
        np.array(metric.angles),
        *compiled.arrays_of(used),
        include_self,
        *(part.numpy() for part in (sides, distance, mass)),
    )
    return sides, distance, mass


def _parts(flat: Float[Tensor, "B N D"]) -> Iterator[slice]:
    """Slices of a batch whose pairwise differences fit into memory."""
    size, dims = flat.shape[-2:]
    each = max(1, _BYTES // max(1, size * size * dims * flat.element_size()))
    for start in range(0, len(flat), each):
        yield slice(start, start + each)
