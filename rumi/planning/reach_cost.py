"""Reachability cost: information that is pushed to where the robot does not reach (RUMI, Alg 8)."""

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from rumi.dynamics.tool_lookup import FieldSampler
from sdf import backend, compiled
from sdf.check import check_shape, eager_only, is_eager
from sdf.voxel_grid import VoxelGrid

_SHIFTS = 256
"""Shifts whose sums are taken at once: the memory for more is not needed."""


class CrossCorrelation:
    """`sum_x r(x) I(x - k)` for every whole shift k, -(n - 1) .. n - 1 along an axis of n nodes; zero outside.

    The Fourier transform of r is made once.

    Args:
        reachability: (X, Y, Z), r.
    """

    def __init__(self, reachability: Float[Tensor, "X Y Z"]) -> None:
        shape = reachability.shape
        self._axes = [axis - 3 for axis, n in enumerate(shape) if n > 1]
        self._padded = [_quick_length(2 * shape[axis] - 1) for axis in self._axes]
        self._reachability = reachability
        # set off by the greatest shift below 0, so that the table begins with it
        offset = [side for n in reversed(shape) for side in (n - 1, 0)]
        later = functional.pad(reachability, offset)
        self._spectrum = torch.fft.rfftn(later, self._padded, self._axes) if self._axes else None

    def __call__(self, information: Float[Tensor, "*n X Y Z"]) -> Float[Tensor, "*n X2 Y2 Z2"]:
        """The table of an I."""
        if self._spectrum is None:
            return self._reachability * information
        spectrum = self._spectrum * torch.fft.rfftn(information, self._padded, self._axes).conj()
        table = torch.fft.irfftn(spectrum, self._padded, self._axes)
        for axis in self._axes:
            table = table.narrow(axis, 0, 2 * self._reachability.shape[axis] - 1)
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


class _Once:
    """An attribute that is worked out where it is first asked for, and kept; not so where code is traced."""

    def __init__(self, make: Callable[[Any], Any]) -> None:
        self.make, self.name, self.__doc__ = make, make.__name__, make.__doc__

    def __get__(self, of: Any, kind: type) -> Any:  # noqa: ANN401  (whatever is worked out)
        value = self.make(of)
        if is_eager():
            of.__dict__[self.name] = value  # found before this from now on
        return value


class ReachabilityCost:
    """C_R of displacements: minus the share of the information that stays reachable, mean over the steps.

    `-mean_t sum_x r(x) I(x - d_t) / sum_x I(x)`, with I multilinear between nodes and zero outside the lattice. For
    fractional d this is, exactly, the same interpolation between whole shifts, whose sums are the cross-correlation of
    r and I: one Fourier transform for a plan and one look-up for a displacement. Where objects turn about an upright
    axis, the information is turned by whole multiples of `turn_step`, with linear interpolation between, and the sums
    are taken at those shifts alone that a path comes to; what turns stays at its height. The cost of a row is the same
    to the bit whatever other rows it is asked for with.

    Args:
        information: (X, Y, Z), 0 or more.
        reachability: (X, Y, Z) on the same lattice, in [0, 1].
        turn_step: between the turns that are summed over, radians; rounded to a whole share of the turn.
    """

    def __init__(self, information: VoxelGrid, reachability: VoxelGrid, *, turn_step: float = math.radians(15)) -> None:
        if information.values.shape != reachability.values.shape:
            raise ValueError(
                f"Expected reachability to have the shape of information, {tuple(information.values.shape)}, "
                f"got {tuple(reachability.values.shape)}: sample both on one workspace"
            )
        self.points = information.values.numel()
        # a whole number of steps to the turn
        self.steps = max(1, round(2.0 * math.pi / turn_step))
        self.turn_step = 2.0 * math.pi / self.steps
        self.information, self.reachability = information, reachability
        total = information.values.sum()
        self.total = torch.where(total > 0, total, math.inf)  # without information all shares are 0
        self.all_tables: Tensor | None = None
        self._compiled: Any = None

    @_Once
    def table(self) -> Float[Tensor, "X2 Y2 Z2"]:
        """Share of the information that stays reachable, of every whole shift; the middle node is no shift."""
        return self._table(self.information.values)

    @_Once
    def _correlation(self) -> CrossCorrelation:
        return CrossCorrelation(self.reachability.values)

    @_Once
    def _share(self) -> FieldSampler:
        origin = self.total.new_tensor([-(n - 1.0) * self.information.spacing for n in self.information.shape])
        return FieldSampler(VoxelGrid(self.table, origin, self.information.spacing))

    @_Once
    def held(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
        """Nodes that have information, and what they have."""
        where = self.information.values.nonzero()
        return where.to(self.information.values), self.information.values[tuple(where.unbind(-1))]

    def turned_tables(self, turned: Float[Tensor, "*n X Y Z"]) -> Float[Tensor, "*n X2 Y2"]:
        """Tables of the share that stays reachable, for shifts by no height, of information that has been turned."""
        return self._table(turned)[..., self.information.shape[2] - 1]

    def __call__(
        self,
        displacements: Float[Tensor, "*b H 3"],
        turns: Float[Tensor, "*b H"] | None = None,
        pivot: Float[Tensor, "2"] | None = None,
    ) -> Float[Tensor, "*b"]:
        """Cost in [-1, 0] after each of H steps; 0 where there is no information.

        Args:
            displacements: metres, of the object, or of the `pivot` where it is turned; there z is not used.
            turns: radians, about the pivot.
            pivot: (2,), needed with turns; the same at every call.
        """
        check_shape("displacements", displacements, "(*b, H, 3)", last=(3,))
        if turns is None or pivot is None:
            share = self._share(self._share.place(displacements.reshape(1, -1, 3))).view(displacements.shape[:-1])
        else:
            eager_only("the reachability cost of turns", "sums are taken where a path comes to")
            version = backend.dispatch("turned_shares", self.information.values, displacements, turns, pivot)
            share = version(self, displacements, turns, pivot)
        return -share.mean(-1)

    def compiled(self, pivot: Float[Tensor, "2"]) -> Any:  # noqa: ANN401  (numba comes without types)
        """The compiled shares of turns about a pivot, with the sums that were taken so far; made once."""
        if self._compiled is None:
            from rumi.planning.reach_cost_numba import CompiledShares

            self._compiled = CompiledShares(self, pivot)
        return self._compiled

    def _table(self, information: Tensor) -> Tensor:
        return (self._correlation(information) / self.total).clamp(0.0, 1.0)


@backend.register("turned_shares")
def _turned_shares(
    cost: ReachabilityCost, displacements: Float[Tensor, "*b H 3"], turns: Float[Tensor, "*b H"], pivot: Tensor
) -> Float[Tensor, "*b H"]:
    """Share that stays reachable: linear between two turns, and between whole shifts."""
    lattice, place = cost.information, turns / cost.turn_step
    # at shifts by the whole lattice nothing is left, and beyond neither
    far = displacements.new_tensor([float(n) for n in lattice.shape[:2]])
    node = torch.maximum(torch.minimum(displacements[..., :2] / lattice.spacing, far), -far)
    below, corner = place.floor(), node.floor()
    part, (a, b) = place - below, (node - corner).unbind(-1)
    layer, (i, j) = below.long() % cost.steps, corner.long().unbind(-1)
    ends = [((layer + up) % cost.steps, i + di, j + dj) for up in (0, 1) for di in (0, 1) for dj in (0, 1)]
    wanted = torch.stack([torch.stack(end, -1) for end in ends])
    nodes, which = wanted.flatten(0, -2).unique(dim=0, return_inverse=True)
    corners = _shares_at(cost, nodes, pivot)[which].view(2, 2, 2, *turns.shape)
    near = corners[:, 0, 0] + b * (corners[:, 0, 1] - corners[:, 0, 0])
    high = corners[:, 1, 0] + b * (corners[:, 1, 1] - corners[:, 1, 0])
    low, high = (near + a * (high - near)).unbind(0)
    return low + part * (high - low)


@backend.register("turned_shares", "numba", compiled.supports)
def _turned_shares_numba(cost: ReachabilityCost, displacements: Tensor, turns: Tensor, pivot: Tensor) -> Tensor:
    share: Tensor = cost.compiled(pivot)(displacements, turns)
    return share


def _shares_at(cost: ReachabilityCost, nodes: Int[Tensor, "S 3"], pivot: Float[Tensor, "2"]) -> Float[Tensor, "S"]:
    """Share of the turned information that is reachable, of whole shifts.

    Args:
        cost: with both maps.
        nodes: number of the turn, and shift along x and y, of which none exceeds the lattice.
        pivot: of the turns, metres.
    """
    columns, rows, layers = cost.information.shape
    # what is moved out of the lattice is out of reach
    reach = functional.pad(cost.reachability.values, (0, 0, rows + 1, rows + 1, columns + 1, columns + 1)).flatten()
    shares = cost.total.new_zeros(len(nodes))
    for number in nodes[:, 0].unique().tolist():
        turned = turned_information(cost, number * cost.turn_step, pivot)
        i, j, k = turned.detach().nonzero().unbind(-1)
        held = turned[i, j, k] / cost.total
        place = ((i + columns + 1) * (3 * rows + 2) + j + rows + 1) * layers + k
        for those in (nodes[:, 0] == number).nonzero()[:, 0].split(_SHIFTS):
            shift = (nodes[those, 1] * (3 * rows + 2) + nodes[those, 2]) * layers
            shares = shares.index_put((those,), (reach[shift[:, None] + place] * held).sum(-1))
    return shares.clamp(0.0, 1.0)


def turned_information(cost: ReachabilityCost, turn: float, pivot: Float[Tensor, "2"]) -> Float[Tensor, "X Y Z"]:
    """Information turned about a pivot: each node's value goes to the four nodes about its new place.

    Args:
        cost: whose information.
        turn: radians.
        pivot: (2,), metres.
    """
    nodes, held = cost.held
    origin, spacing, (columns, rows, layers) = (
        cost.information.origin[:2],
        cost.information.spacing,
        cost.information.shape,
    )
    about, z = pivot.to(held), nodes[:, 2].long()
    cos, sin = math.cos(turn), math.sin(turn)
    way = (nodes[:, :2] * spacing + origin - about) @ held.new_tensor([[cos, sin], [-sin, cos]])
    node = (way + about - origin) / spacing
    corner = node.floor()
    a, b = (node - corner).unbind(-1)
    near, far = held * (1 - a), held * a
    part = torch.stack((near * (1 - b), near * b, far * (1 - b), far * b))
    # what leaves the lattice gathers in a frame about it
    i, j = corner.long().unbind(-1)
    i, i1 = (rows + 2) * (i + 1).clamp(0, columns + 1), (rows + 2) * (i + 2).clamp(0, columns + 1)
    j, j1 = (j + 1).clamp(0, rows + 1), (j + 2).clamp(0, rows + 1)
    place = torch.stack((i + j, i + j1, i1 + j, i1 + j1)) * layers + z
    framed = held.new_zeros((columns + 2) * (rows + 2) * layers)
    framed = framed.index_add(0, place.flatten(), part.flatten())
    return framed.view(columns + 2, rows + 2, layers)[1:-1, 1:-1]
