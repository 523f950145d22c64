"""Reachability cost: information that is pushed to where the robot does not reach (RUMI, Alg 8)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from rumi.dynamics.tool_lookup import FieldSampler
from sdf.check import check_shape, eager_only
from sdf.voxel_grid import VoxelGrid


def cross_correlation(
    reachability: Float[Tensor, "X Y Z"], information: Float[Tensor, "*n X Y Z"]
) -> Float[Tensor, "*n X2 Y2 Z2"]:
    """`sum_x r(x) I(x - k)` for every whole shift k, -(n - 1) .. n - 1 along an axis of n nodes; zero outside."""
    shape = reachability.shape
    axes = [axis - 3 for axis, n in enumerate(shape) if n > 1]
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
        self._information, self._reachability = information, reachability
        self._total = information.values.sum()
        self._origin = self._total.new_tensor([-(n - 1.0) * information.spacing for n in information.shape])
        self._share = FieldSampler(VoxelGrid(self._table(information.values), self._origin, information.spacing))
        self._turned: dict[int, Tensor] = {}

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
            turned = turns != 0
            if bool(turned.any()):
                share[turned] = self._turned_shares(displacements[turned][:, :2], turns[turned], pivot)
        return -share.mean(-1)

    def _table(self, information: Tensor) -> Tensor:
        share = cross_correlation(self._reachability.values, information)
        return torch.where(self._total > 0, share / self._total, torch.zeros_like(share)).clamp(0.0, 1.0)

    def _turned_shares(
        self, displacements: Float[Tensor, "E 2"], turns: Float[Tensor, "E"], pivot: Float[Tensor, "2"]
    ) -> Float[Tensor, "E"]:
        """Share that stays reachable after each displacement and turn, linear between the tables of two turns.

        Written out, element by element: the library's sampler would want the turns as a share of the stack's extent,
        and so round each by what the others are.
        """
        place = turns / self.turn_step
        below = place.floor()
        first, part = int(below.min()), place - below
        # whole turns leave the information where it was
        needed = [index % self._steps for index in range(first, int(below.max()) + 2)]
        for index in needed:
            if index not in self._turned:
                # one by one: a transform of several may round otherwise
                self._turned[index] = self._flat_table(self._turn(index * self.turn_step, pivot))
        stack = torch.stack([self._turned[index] for index in needed])
        last = stack.new_tensor([n - 1.0 for n in stack.shape[1:]])
        # in the frame of zeros about each table, on which all that lies outside lands
        node = (displacements - self._origin[:2]) / self._information.spacing + 1.0
        node = torch.minimum(node.clamp_min(0.0), last)
        corner = torch.minimum(node.floor(), last - 1.0)
        a, b = (node - corner).unbind(-1)
        i, j = corner.long().unbind(-1)
        layer = below.long() - first
        low, high = (_bilinear(stack, layer + up, i, j, a, b) for up in (0, 1))
        return low + part * (high - low)

    def _flat_table(self, information: Float[Tensor, "X Y Z"]) -> Float[Tensor, "X3 Y3"]:
        """Table of the shifts by no height, within a frame of zeros."""
        return functional.pad(self._table(information)[..., information.shape[2] - 1], (1, 1, 1, 1))

    def _turn(self, turn: float, pivot: Tensor) -> Tensor:
        """The information turned about the pivot: each node's value goes to the four nodes about its new place."""
        return torch.stack([self._turned_layer(layer, turn, pivot) for layer in self._information.values.unbind(2)], -1)

    def _turned_layer(self, values: Tensor, turn: float, pivot: Tensor) -> Tensor:
        origin = self._information.origin
        x, y = values.nonzero().unbind(-1)
        held, spacing = values[x, y], self._information.spacing
        from_pivot = torch.stack((x, y), -1).to(values) * spacing + origin[:2] - pivot
        cos, sin = math.cos(turn), math.sin(turn)
        way = from_pivot @ from_pivot.new_tensor([[cos, sin], [-sin, cos]])
        node = (way + pivot - origin[:2]) / spacing
        corner = node.floor()
        share = node - corner
        result = torch.zeros_like(values)
        for dx in (0, 1):
            for dy in (0, 1):
                i, j = corner[:, 0].long() + dx, corner[:, 1].long() + dy
                part = held * (share[:, 0] if dx else 1 - share[:, 0]) * (share[:, 1] if dy else 1 - share[:, 1])
                inside = (i >= 0) & (j >= 0) & (i < values.shape[0]) & (j < values.shape[1])
                result.index_put_((i[inside], j[inside]), part[inside], accumulate=True)
        return result


def _bilinear(
    stack: Float[Tensor, "N X Y"], layer: Tensor, i: Tensor, j: Tensor, a: Tensor, b: Tensor
) -> Float[Tensor, "E"]:
    """Values of layers between nodes (i, j) and (i + 1, j + 1), of which a and b are the shares of the latter."""
    v00, v01, v10, v11 = (stack[layer, i + di, j + dj] for di in (0, 1) for dj in (0, 1))
    near, far = v00 + b * (v01 - v00), v10 + b * (v11 - v10)
    return near + a * (far - near)
