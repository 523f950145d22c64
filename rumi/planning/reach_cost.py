"""Reachability cost: information that is pushed to where the robot does not reach (RUMI, Alg 8)."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from rumi.dynamics.tool_lookup import FieldSampler
from sdf import backend, compiled
from sdf.check import check_shape, eager_only, is_eager
from sdf.voxel_grid import VoxelGrid


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
    fractional d this is, exactly, the same interpolation of a table over whole shifts, the cross-correlation of r and
    I: one Fourier transform for a plan and one look-up for a displacement. Turns of the object about an upright axis
    have a table for every `turn_step`, made where a turn needs it, with linear interpolation between; what turns stays
    at its height. The cost of a row is the same to the bit whatever other rows it is asked for with.

    Args:
        information: (X, Y, Z), 0 or more.
        reachability: (X, Y, Z) on the same lattice, in [0, 1].
        turn_step: between the turns that have a table, radians; rounded to a whole share of the turn.
    """

    def __init__(self, information: VoxelGrid, reachability: VoxelGrid, *, turn_step: float = math.radians(15)) -> None:
        if information.values.shape != reachability.values.shape:
            raise ValueError(
                f"Expected reachability to have the shape of information, {tuple(information.values.shape)}, "
                f"got {tuple(reachability.values.shape)}: sample both on one workspace"
            )
        self.points = information.values.numel()
        # a whole number of steps to the turn
        self._steps = max(1, round(2.0 * math.pi / turn_step))
        self.turn_step = 2.0 * math.pi / self._steps
        self.information, self._correlation = information, CrossCorrelation(reachability.values)
        total = information.values.sum()
        self._total = torch.where(total > 0, total, math.inf)  # without information all shares are 0
        # a table for every turn, and which of them are made
        self._stack, self._made = self._total.new_empty(0), [False] * self._steps
        self.all_tables: Tensor | None = None

    @_Once
    def table(self) -> Float[Tensor, "X2 Y2 Z2"]:
        """Share of the information that stays reachable, of every whole shift; the middle node is no shift."""
        return self._table(self.information.values)

    @_Once
    def _origin(self) -> Float[Tensor, "3"]:
        """Shift of the table's first node."""
        return self._total.new_tensor([-(n - 1.0) * self.information.spacing for n in self.information.shape])

    @_Once
    def _share(self) -> FieldSampler:
        return FieldSampler(VoxelGrid(self.table, self._origin, self.information.spacing))

    @_Once
    def _held(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
        """Nodes that have information, and what they have."""
        where = self.information.values.nonzero()
        return where.to(self.information.values), self.information.values[tuple(where.unbind(-1))]

    def turned_tables(self, turned: Float[Tensor, "*n X Y Z"]) -> Float[Tensor, "*n X2 Y2"]:
        """Tables of the share that stays reachable, for shifts by no height, of information that has been turned."""
        return self._table(turned)[..., self.information.shape[2] - 1]

    @property
    def steps(self) -> int:
        """Turns that have a table, equally far apart."""
        return self._steps

    def __call__(
        self,
        displacements: Float[Tensor, "*b H 3"],
        turns: Float[Tensor, "*b H"] | None = None,
        pivot: Float[Tensor, "2"] | None = None,
    ) -> Float[Tensor, "*b"]:
        """Cost in [-1, 0] after each of H steps; 0 where there is no information.

        Args:
            displacements: metres, of the object, or of the `pivot` where it is turned.
            turns: radians, about the pivot.
            pivot: (2,), needed with turns; the same at every call.
        """
        check_shape("displacements", displacements, "(*b, H, 3)", last=(3,))
        share = self._share(self._share.place(displacements.reshape(1, -1, 3))).view(displacements.shape[:-1])
        if turns is not None and pivot is not None:
            eager_only("the reachability cost of turns", "a turn's table is made where one first needs it")
            # each by itself: what a row costs must not hang on whether another one turns
            self._make_tables(turns, pivot)
            version = backend.dispatch("turned_shares", share, displacements, turns, self._stack)
            version(share, displacements, turns, Turned(self._stack, self._origin, self.information.spacing))
        return -share.mean(-1)

    def _table(self, information: Tensor) -> Tensor:
        return (self._correlation(information) / self._total).clamp(0.0, 1.0)

    def _make_tables(self, turns: Float[Tensor, "*b H"], pivot: Float[Tensor, "2"]) -> None:
        """The tables of the turns next to those given, where they are not made yet."""
        below = (turns[turns != 0] / self.turn_step).floor().long().unique()
        # whole turns leave the information where it was
        needed = (torch.cat((below, below + 1)) % self._steps).unique().tolist()
        missing = [index for index in needed if not self._made[index]]
        if not missing:
            return
        nodes, held = self._held
        turn = backend.dispatch("turned_information", held, pivot)
        about = pivot.to(held)
        found = turn(nodes, held, self.information, about, [index * self.turn_step for index in missing])
        for index, information in zip(missing, found, strict=True):
            # one by one: a transform of several may round otherwise
            table = self.turned_tables(information)
            if len(self._stack) == 0:
                columns, rows = table.shape
                self._stack = table.new_zeros(self._steps, columns + 2, rows + 2)
            self._stack[index, 1:-1, 1:-1] = table
            self._made[index] = True


class Turned(NamedTuple):
    """Tables of the share of turned information that stays reachable, for shifts by no height.

    Attributes:
        stack: of a turn each, all equally far apart, each within a frame of zeros; zeros where none asked for it yet.
        origin: shift of the tables' first node within the frame, metres.
        spacing: between nodes, metres.
    """

    stack: Float[Tensor, "N X Y"]
    origin: Float[Tensor, "3"]
    spacing: float

    @property
    def turn_step(self) -> float:
        """Between the tables' turns, radians."""
        return 2.0 * math.pi / len(self.stack)


@backend.register("turned_shares")
def _turned_shares(
    share: Float[Tensor, "*b H"], displacements: Float[Tensor, "*b H 3"], turns: Float[Tensor, "*b H"], tables: Turned
) -> None:
    """Enter the share that stays reachable where there is a turn, linear between the tables of two turns.

    Written out, element by element: the library's sampler would want the turns as a share of the stack's extent, and so
    round each by what the others are.
    """
    turned, stack = turns != 0, tables.stack
    if not bool(turned.any()):
        return
    place = turns[turned] / tables.turn_step
    below = place.floor()
    part, layer = place - below, below.long()
    last = stack.new_tensor([n - 1.0 for n in stack.shape[1:]])
    # in the frame of zeros about each table, on which all that lies outside lands
    node = (displacements[turned][:, :2] - tables.origin[:2]) / tables.spacing + 1.0
    node = torch.minimum(node.clamp_min(0.0), last)
    corner = torch.minimum(node.floor(), last - 1.0)
    a, b = (node - corner).unbind(-1)
    i, j = corner.long().unbind(-1)
    low, high = (_bilinear(stack, (layer + up) % len(stack), i, j, a, b) for up in (0, 1))
    share[turned] = low + part * (high - low)


@backend.register("turned_shares", "numba", compiled.supports)
def _turned_shares_numba(share: Tensor, displacements: Tensor, turns: Tensor, tables: Turned) -> None:
    from rumi.planning.reach_cost_numba import turned_shares

    if len(tables.stack) == 0:
        return
    kind = tables.stack.numpy().dtype.type
    turned_shares(
        displacements.reshape(-1, 3).contiguous().numpy(),
        turns.reshape(-1).contiguous().numpy(),
        tables.stack.numpy(),
        tables.origin.contiguous().numpy(),
        kind(tables.spacing),
        kind(tables.turn_step),
        share.view(-1).numpy(),
    )


@backend.register("turned_information")
def _turned(
    nodes: Float[Tensor, "N 3"],
    held: Float[Tensor, "N"],
    lattice: VoxelGrid,
    pivot: Float[Tensor, "2"],
    turns: list[float],
) -> list[Float[Tensor, "X Y Z"]]:
    """Information turned about the pivot: each node's value goes to the four nodes about its new place.

    Args:
        nodes: of the lattice that have information.
        held: what they have.
        lattice: of the nodes.
        pivot: (2,), metres.
        turns: radians.
    """
    origin, spacing, (columns, rows, layers) = lattice.origin[:2], lattice.spacing, lattice.shape
    from_pivot, z = nodes[:, :2] * spacing + origin - pivot, nodes[:, 2].long()
    found = []
    for turn in turns:
        cos, sin = math.cos(turn), math.sin(turn)
        way = from_pivot @ from_pivot.new_tensor([[cos, sin], [-sin, cos]])
        node = (way + pivot - origin) / spacing
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
        framed.index_add_(0, place.flatten(), part.flatten())
        found.append(framed.view(columns + 2, rows + 2, layers)[1:-1, 1:-1])
    return found


@backend.register("turned_information", "numba", compiled.supports)
def _turned_numba(
    nodes: Tensor, held: Tensor, lattice: VoxelGrid, pivot: Tensor, turns: list[float]
) -> list[Float[Tensor, "X Y Z"]]:
    from rumi.planning.reach_cost_numba import turned

    columns, rows, layers = lattice.shape
    found = held.new_empty(len(turns), columns + 2, rows + 2, layers)
    arrays = (x.contiguous().numpy() for x in (nodes, held, lattice.origin.to(held), pivot))
    turned(*arrays, held.numpy().dtype.type(lattice.spacing), np.array(turns), found.numpy())
    return list(found[:, 1:-1, 1:-1].unbind(0))


def _bilinear(
    stack: Float[Tensor, "N X Y"], layer: Tensor, i: Tensor, j: Tensor, a: Tensor, b: Tensor
) -> Float[Tensor, "E"]:
    """Values of layers between nodes (i, j) and (i + 1, j + 1), of which a and b are the shares of the latter."""
    v00, v01, v10, v11 = (stack[layer, i + di, j + dj] for di in (0, 1) for dj in (0, 1))
    near, far = v00 + b * (v01 - v00), v10 + b * (v11 - v10)
    return near + a * (far - near)
