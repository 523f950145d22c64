"""The versions for a GPU of what paths gather and of their cost.

`costs.py`, `reach_cost.py` and `objective.py` have the definitions.
Every cell keeps the first action that meets it, a number for each path and cell, which threads lower by an atomic
minimum; what it is worth is summed in a fixed order afterwards, so that a cost is the same whenever it is asked for.
"""

import math
from typing import Any

import torch

from sdf import gpu

wp = gpu.warp()

_CELLS = 1 << 28
"""Cells of paths that are marked at once: 1 GiB."""


@wp.func
def _cell(place: Any, start: Any, spacing: Any, count: int):
    """Cell of a coordinate along an axis of `count` nodes, -1 outside; a lone node holds every coordinate."""
    if count == 1:
        return int(0)
    index = int(wp.floor((place - start) / spacing + type(place)(0.5)))
    if index < 0 or index >= count:
        return int(-1)
    return index


@gpu.Kernel
def _meet(
    configurations: wp.array3d(dtype=Any),
    displacements: wp.array3d(dtype=Any),
    turns: wp.array2d(dtype=Any),
    pivot: wp.array(dtype=Any),
    turning: wp.bool,
    displaced: wp.bool,
    first: wp.int32,
    points: wp.array2d(dtype=Any),
    spatial: wp.bool,
    origin: wp.array(dtype=Any),
    spacing: Any,
    shape: wp.vec3i,
    met: wp.array2d(dtype=wp.int32),
):
    """Lower the number of the first action at which a path meets a cell; a thread a path, an action and a point."""
    r, h, m = wp.tid()
    t = h + first
    yaw = configurations[r, t, configurations.shape[2] - 1]
    x = configurations[r, t, 0] - pivot[0]
    y = configurations[r, t, 1] - pivot[1]
    if displaced:
        x = x - displacements[r, t, 0]
        y = y - displacements[r, t, 1]
        if turning:  # the field turns with the object: look from where it has not moved
            turn = turns[r, t]
            x_before = x
            x = wp.cos(turn) * x_before + wp.sin(turn) * y
            y = wp.cos(turn) * y - wp.sin(turn) * x_before
            yaw = yaw - turn
    cos, sin = wp.cos(yaw), wp.sin(yaw)
    z = points[m, 2]
    if spatial:
        z = z + configurations[r, t, 2]
    i = _cell(x + pivot[0] + cos * points[m, 0] - sin * points[m, 1], origin[0], spacing, shape[0])
    j = _cell(y + pivot[1] + sin * points[m, 0] + cos * points[m, 1], origin[1], spacing, shape[1])
    k = _cell(z, origin[2], spacing, shape[2])
    if i >= 0 and j >= 0 and k >= 0:
        wp.atomic_min(met, r, (i * shape[1] + j) * shape[2] + k, h)


@gpu.Kernel
def _worth(
    values: wp.array2d(dtype=Any),
    met: wp.array3d(dtype=wp.int32),
    horizon: wp.int32,
    discount: Any,
    worth: wp.array2d(dtype=Any),
):
    """Worth of the cells that a path meets in one slice of the lattice."""
    r, i = wp.tid()
    total = type(discount)(0.0)
    for cell in range(values.shape[1]):
        h = met[r, i, cell]
        if h < horizon:
            total += values[i, cell] * wp.pow(discount, type(discount)(h))
    worth[r, i] = total


@wp.func
def _share(table: wp.array3d(dtype=Any), u: Any, v: Any, w: Any):
    """Multilinear value of a table at lattice coordinates; zero fades in outside, an axis of one node is constant."""
    i0, j0, k0 = int(wp.floor(u)), int(wp.floor(v)), int(wp.floor(w))
    total = type(u)(0.0)
    for corner in range(8):
        di, dj, dk = corner // 4, (corner // 2) % 2, corner % 2
        i, j, k = i0 + di, j0 + dj, k0 + dk
        weight = type(u)(1.0)
        if table.shape[0] == 1:
            i = di
            weight *= type(u)(1 - di)
        else:
            weight *= type(u)(1.0) - wp.abs(u - type(u)(i))
        if table.shape[1] == 1:
            j = dj
            weight *= type(u)(1 - dj)
        else:
            weight *= type(u)(1.0) - wp.abs(v - type(u)(j))
        if table.shape[2] == 1:
            k = dk
            weight *= type(u)(1 - dk)
        else:
            weight *= type(u)(1.0) - wp.abs(w - type(u)(k))
        if i >= 0 and i < table.shape[0] and j >= 0 and j < table.shape[1] and k >= 0 and k < table.shape[2]:
            total += weight * table[i, j, k]
    return total


@wp.func
def _place(shift: Any, spacing: Any, count: int):
    """Lattice coordinate of a shift in a table whose middle node is no shift; what is not finite is outside."""
    place = shift / spacing + type(shift)(count // 2)
    far = type(shift)(2 * count + 2)
    return wp.where(place > -far and place < far, place, -far)


@gpu.Kernel
def _cost(
    worth: wp.array2d(dtype=Any),
    total: wp.array(dtype=Any),
    normalised: wp.bool,
    scale: Any,
    displacements: wp.array3d(dtype=Any),
    turns: wp.array2d(dtype=Any),
    turning: wp.bool,
    tables: wp.array3d(dtype=Any),
    reach_scale: Any,
    spacing: Any,
    cost: wp.array(dtype=Any),
):
    """Cost of a path: what it gathers, and the mean over its steps of what stays reachable; a thread a path."""
    r = wp.tid()
    gathered = type(scale)(0.0)
    for i in range(worth.shape[1]):
        gathered += worth[r, i]
    if normalised:
        gathered = wp.min(gathered / total[0], type(scale)(1.0))
    reached = type(scale)(0.0)
    horizon = displacements.shape[1] - 1
    if reach_scale > type(scale)(0.0):
        for t in range(1, horizon + 1):
            x, y, z = displacements[r, t, 0], displacements[r, t, 1], displacements[r, t, 2]
            if turning:
                u = _place(x, spacing, tables.shape[1])
                v = _place(y, spacing, tables.shape[2])
                step = type(scale)(2.0) * type(scale)(wp.pi) / type(scale)(tables.shape[0])
                turn = turns[r, t] / step
                below = wp.floor(turn)
                part = turn - below
                low = int(below) % tables.shape[0]
                if low < 0:
                    low += tables.shape[0]
                for up in range(2):
                    layer = (low + up) % tables.shape[0]
                    weight = wp.where(up == 0, type(scale)(1.0) - part, part)
                    i0, j0 = int(wp.floor(u)), int(wp.floor(v))
                    for corner in range(4):
                        i, j = i0 + corner // 2, j0 + corner % 2
                        near = (type(u)(1.0) - wp.abs(u - type(u)(i))) * (type(u)(1.0) - wp.abs(v - type(u)(j)))
                        if i >= 0 and i < tables.shape[1] and j >= 0 and j < tables.shape[2]:
                            reached += weight * near * tables[layer, i, j]
            else:
                u = _place(x, spacing, tables.shape[0])
                v = _place(y, spacing, tables.shape[1])
                w = _place(z, spacing, tables.shape[2])
                reached += _share(tables, u, v, w)
    cost[r] = -scale * gathered - reach_scale * reached / type(scale)(wp.max(horizon, 1))


@gpu.Kernel
def _turned(
    values: wp.array3d(dtype=Any),
    origin: wp.array(dtype=Any),
    spacing: Any,
    pivot: wp.array(dtype=Any),
    result: wp.array4d(dtype=Any),
):
    """Information turned about the pivot, by a step more in each layer; a thread a turn and a column of nodes."""
    n, i, j = wp.tid()
    angle = type(spacing)(2.0) * type(spacing)(wp.pi) * type(spacing)(n) / type(spacing)(result.shape[0])
    cos, sin = wp.cos(angle), wp.sin(angle)
    about_x, about_y = (pivot[0] - origin[0]) / spacing, (pivot[1] - origin[1]) / spacing
    x, y = type(spacing)(i) - about_x, type(spacing)(j) - about_y
    u, v = cos * x - sin * y + about_x, sin * x + cos * y + about_y
    i0, j0 = int(wp.floor(u)), int(wp.floor(v))
    for corner in range(4):
        i1, j1 = i0 + corner // 2, j0 + corner % 2
        near = (type(u)(1.0) - wp.abs(u - type(u)(i1))) * (type(u)(1.0) - wp.abs(v - type(u)(j1)))
        if i1 >= 0 and i1 < result.shape[1] and j1 >= 0 and j1 < result.shape[2]:
            for k in range(values.shape[2]):
                if values[i, j, k] != type(spacing)(0.0):
                    wp.atomic_add(result, n, i1, j1, k, near * values[i, j, k])


def gathered(cost, configurations, displacements):
    """Information of the cells that paths (R, H) meet, discounted from the first meeting."""
    worth = _worth_of_slices(cost, configurations, displacements, None, None, first=0, displaced=True)
    return worth.sum(-1)


def trajectory_cost(cost, rollouts):
    """Cost of each control sequence (*b, K)."""
    shape = rollouts.displacements.shape[:-2]
    configurations, displacements = _rows(rollouts.configurations, 2), _rows(rollouts.displacements, 2)
    turns = None if rollouts.turns is None else _rows(rollouts.turns, 1)
    information, reachability = cost.information, cost.reachability
    result = displacements.new_empty(len(displacements))
    if information is None:
        worth, total = displacements.new_empty(len(displacements), 0), None
    else:
        path = (configurations, displacements, turns, rollouts.pivot)
        worth = _worth_of_slices(information, *path, first=1, displaced=cost.displaced_information)
        total = information.total
    tables = cost.values
    if reachability is not None:
        tables = reachability.table if turns is None else _tables(reachability, rollouts.pivot)
    _cost.launch(
        len(result),
        worth,
        cost.values.view(-1)[:1] if total is None else total.view(1),
        total is not None,
        cost.information_scale if information is not None else 0.0,
        displacements,
        _or_else(turns, displacements),
        turns is not None,
        tables,
        0.0 if reachability is None else cost.reachability_scale,
        1.0 if reachability is None else reachability.information.spacing,
        result,
    )
    return result.view(shape).mean(-1)


def _worth_of_slices(cost, configurations, displacements, turns, pivot, *, first, displaced):
    """What the cells that paths meet are worth, (R, X)."""
    lattice, rows = cost.information, len(configurations)
    horizon, cells = configurations.shape[1] - first, lattice.values.numel()
    worth = displacements.new_empty(rows, lattice.shape[0])
    step = max(1, _CELLS // max(cells, 1))
    if pivot is None:
        pivot = torch.zeros(2, dtype=worth.dtype, device=worth.device)
    for begin in range(0, rows, step):
        part = slice(begin, begin + step)
        here = configurations[part]
        met = torch.full((len(here), cells), horizon, dtype=torch.int32, device=worth.device)
        _meet.launch(
            (len(here), horizon, len(cost.points_t)),
            here,
            displacements[part],
            _or_else(turns, displacements)[part],
            pivot,
            turns is not None,
            displaced,
            first,
            cost.points_t,
            cost.spatial,
            lattice.origin,
            lattice.spacing,
            wp.vec3i(*lattice.shape),
            met,
        )
        _worth.launch(
            (len(here), lattice.shape[0]),
            lattice.values.view(lattice.shape[0], -1),
            met.view(len(here), lattice.shape[0], -1),
            horizon,
            cost.discount,
            worth[part],
        )
    return worth


def _tables(reachability, pivot):
    """Tables of all turns (N, X2, Y2), made once."""
    if reachability.all_tables is None:
        lattice = reachability.information
        turned = lattice.values.new_zeros(reachability.steps, *lattice.shape)
        _turned.launch(
            (reachability.steps, *lattice.shape[:2]), lattice.values, lattice.origin, lattice.spacing, pivot, turned
        )
        reachability.all_tables = reachability.turned_tables(turned)
    return reachability.all_tables


def _rows(values, kept):
    """A tensor with one axis for all rollouts in front of the `kept` last ones."""
    return values.reshape(math.prod(values.shape[: values.ndim - kept]), *values.shape[values.ndim - kept :])


def _or_else(turns, displacements):
    """Turns (R, T), or numbers of their shape that nobody reads."""
    return displacements[..., 0] if turns is None else turns
