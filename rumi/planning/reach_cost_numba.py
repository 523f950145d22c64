"""The compiled CPU version of the share of turned information that stays reachable; `reach_cost.py` has the definition.

Sums are taken at the nodes alone that paths come to: whole turns by `turn_step` and whole shifts. Each is taken once.
"""

import math

import numpy as np
import torch

from sdf.compiled import Kernel, bare, inner
from sdf.intrinsics_numba import at
from sdf.part_numba import indices


def _turned(nodes, values, start, pivot, spacing, step, numbers, result, bounds, part):
    kind = values.dtype.type
    columns, rows = result.shape[1] - 2, result.shape[2] - 2
    low_x, low_y = start[0], start[1]
    pivot_x, pivot_y, one = (pivot[0] - low_x) / spacing, (pivot[1] - low_y) / spacing, kind(1.0)
    for number in indices(part, len(numbers)):
        found, ends, turn = result[numbers[number]], bounds[numbers[number]], numbers[number] * step
        for i in range(columns + 2):
            ends[i, 0], ends[i, 1] = rows + 1, 0
            for j in range(rows + 2):
                for k in range(found.shape[2]):
                    found[i, j, k] = kind(0.0)
        cos, sin = kind(math.cos(turn)), kind(math.sin(turn))
        for n in range(len(values)):
            x, y = nodes[n, 0] - pivot_x, nodes[n, 1] - pivot_y
            u, v = cos * x - sin * y + pivot_x, sin * x + cos * y + pivot_y
            i, j = math.floor(u), math.floor(v)
            a, b = u - kind(i), v - kind(j)
            near, far = values[n] * (one - a), values[n] * a
            # what leaves the lattice gathers in a frame about it
            i, i1 = min(max(i + 1, 0), columns + 1), min(max(i + 2, 0), columns + 1)
            j, j1 = min(max(j + 1, 0), rows + 1), min(max(j + 2, 0), rows + 1)
            z = np.int64(nodes[n, 2])
            found[i, j, z] += near * (one - b)
            found[i, j1, z] += near * b
            found[i1, j, z] += far * (one - b)
            found[i1, j1, z] += far * b
            ends[i, 0], ends[i, 1] = min(ends[i, 0], j), max(ends[i, 1], j1)
            ends[i1, 0], ends[i1, 1] = min(ends[i1, 0], j), max(ends[i1, 1], j1)


turned = Kernel(_turned)


@bare
def _node(displacements, turns, n, sizes, spacing, step):
    """Turn and shift below an entry, with the shares of the next ones."""
    kind = turns.dtype.type
    layers, columns, rows = sizes[0], sizes[1], sizes[2]
    place = turns[n] / step
    below = math.floor(place)
    last_x, last_y = kind(columns), kind(rows)
    u, v = displacements[n, 0] / spacing, displacements[n, 1] / spacing
    # at shifts by the whole lattice nothing is left, and beyond neither
    u, v = u if u > -last_x else -last_x, v if v > -last_y else -last_y
    u, v = u if u < last_x else last_x, v if v < last_y else last_y
    i, j = math.floor(u), math.floor(v)
    layer = np.int64(below) % layers
    return layer, np.int64(i), np.int64(j), place - kind(below), u - kind(i), v - kind(j)


def _missing(displacements, turns, sizes, spacing, step, known, found, part):
    layers, columns, rows = sizes[0], sizes[1], sizes[2]
    none = turns.dtype.type(0.0)
    for _ in indices(part, 1):
        count = 0
        for n in range(len(turns)):
            x, y = displacements[n, 0], displacements[n, 1]
            if n > 0 and turns[n] == turns[n - 1] and x == displacements[n - 1, 0] and y == displacements[n - 1, 1]:
                continue  # most stand still
            layer, i, j, up, a, b = _node(displacements, turns, n, sizes, spacing, step)
            for higher in range(2 if up != none else 1):
                own = known[(layer + higher) % layers]
                for di in range(2 if a != none else 1):
                    for dj in range(2 if b != none else 1):
                        if not own[i + di + columns, j + dj + rows]:
                            own[i + di + columns, j + dj + rows] = True
                            found[1 + count, 0], found[1 + count, 1] = (layer + higher) % layers, i + di
                            found[1 + count, 2] = j + dj
                            count += 1
        found[0, 0] = count


missing = Kernel(_missing)


@inner(_nrt=False, fastmath={"reassoc", "contract", "nsz"})
def _product(one, begin, other, start, count):
    """Sum of products of two rows; vector instructions."""
    total = one.dtype.type(0.0)
    for n in range(count):
        total += at(one, begin + n) * at(other, start + n)
    return total


def _sums(nodes, information, bounds, reach, sizes, total, sums, part):
    columns, rows, tall = sizes[1], sizes[2], sizes[3]
    size, kind = (columns + 2) * (rows + 2) * tall, sums.dtype.type
    for n in indices(part, len(nodes)):
        layer, di, dj = nodes[n, 0], nodes[n, 1], nodes[n, 2]
        whole = 0.0
        for i in range(max(0, -di), min(columns, columns - di)):
            first, last = max(bounds[layer, i + 1, 0] - 1, 0, -dj), min(bounds[layer, i + 1, 1], rows, rows - dj)
            if first < last:
                begin = layer * size + ((i + 1) * (rows + 2) + first + 1) * tall
                whole += _product(
                    information, begin, reach, ((i + di) * rows + first + dj) * tall, (last - first) * tall
                )
        sums[layer, di + columns, dj + rows] = min(max(kind(whole) / total, kind(0.0)), kind(1.0))


sums = Kernel(_sums)


def _shares(displacements, turns, sizes, spacing, step, sums, share, part):
    layers, columns, rows = sizes[0], sizes[1], sizes[2]
    kind = sums.dtype.type
    none = kind(0.0)
    for n in indices(part, len(turns)):
        layer, i, j, up, a, b = _node(displacements, turns, n, sizes, spacing, step)
        i, j = i + columns, j + rows
        low, high = none, none
        # sums that weigh nothing were not taken
        for higher in range(2 if up != none else 1):
            own = sums[(layer + higher) % layers]
            near = own[i, j]
            if b != none:
                near += b * (own[i, j + 1] - near)
            if a != none:
                far = own[i + 1, j]
                if b != none:
                    far += b * (own[i + 1, j + 1] - far)
                near += a * (far - near)
            low, high = high, near
        share[n] = low + up * (high - low) if up != none else high


shares = Kernel(_shares)


class CompiledShares:
    """The compiled version of `turned_shares` of one cost and pivot; it keeps the sums that it took.

    Args:
        cost: whose maps are used.
        pivot: of the turns.
    """

    def __init__(self, cost, pivot):
        lattice = cost.information
        nodes, held = cost.held
        kind = held.numpy().dtype.type
        columns, rows, tall = lattice.shape
        places = (nodes, held, lattice.origin.to(held), pivot.to(held))
        self._places = tuple(part.contiguous().numpy() for part in places)
        self._spacing, self._step, self._total = kind(lattice.spacing), kind(cost.turn_step), kind(cost.total.item())
        self._turn_step, self._sizes = cost.turn_step, np.array((cost.steps, columns, rows, tall))
        self._reach = cost.reachability.values.to(held).contiguous().view(-1).numpy()
        # of which the pages that nobody comes to are never there
        shape = (cost.steps, 2 * columns + 2, 2 * rows + 2)
        self._known, self._sums = np.zeros(shape, np.bool_), np.empty(shape, kind)
        self._information = np.empty((cost.steps, columns + 2, rows + 2, tall), kind)
        self._bounds, self._made = np.empty((cost.steps, columns + 2, 2), np.int64), np.zeros(cost.steps, np.bool_)

    def __call__(self, displacements, turns):
        """Share that stays reachable after each displacement and turn."""
        kind = self._sums.dtype.type
        shape, share = turns.shape, torch.from_numpy(np.empty(turns.numel(), kind))
        displacements = displacements.reshape(-1, displacements.shape[-1]).contiguous().numpy().astype(kind, copy=False)
        turns = turns.reshape(-1).contiguous().numpy().astype(kind, copy=False)
        where = (displacements, turns, self._sizes, self._spacing, self._step)
        found = np.empty((1 + min(8 * len(turns), self._known.size), 3), np.int64)
        missing(*where, self._known, found)
        nodes = found[1 : 1 + found[0, 0]]
        if len(nodes):
            needed = np.bincount(nodes[:, 0], minlength=len(self._made)) > 0
            numbers = np.flatnonzero(needed & ~self._made)
            turned(*self._places, self._spacing, self._turn_step, numbers, self._information, self._bounds)
            self._made[numbers] = True
            flat = self._information.reshape(-1)
            sums(nodes, flat, self._bounds, self._reach, self._sizes, self._total, self._sums)
        shares(*where, self._sums, share.numpy())
        return share.view(shape)
