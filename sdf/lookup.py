"""Multilinear look-up in a lattice of values: value and the exact gradient of what is interpolated.

By gathers, not by `grid_sample`: differentiable twice, to points and to values, at a cost that depends on the
number of points alone. Everything is plain torch on coordinate planes (all x, all y, all z), so points whose
planes lie apart in memory, such as `planes.movedim(0, -1)`, are quickest. Without a graph nothing is kept.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def interpolate(values: Float[Tensor, "X Y Z *C"], cells: list[Tensor]) -> Float[Tensor, "..."]:
    """Value (*b, *C) at lattice coordinates: three planes (*b), each within [0, n - 1] of its axis (not checked).

    The plane of an axis with a single node is not looked at.
    """
    flat, base, axes, _ = _locate(values, cells)
    return _value(flat, base, axes, 0).reshape((*cells[0].shape, *values.shape[3:]))


def interpolate_with_slopes(
    values: Float[Tensor, "X Y Z"], cells: list[Tensor], rates: list[Tensor] | None = None
) -> tuple[Tensor, list[Tensor]]:
    """The same with the slopes along the three axes; 0 along an axis with a single node.

    Args:
        values: (X, Y, Z), at the nodes.
        cells: lattice coordinates.
        rates: by axis, (n - 1,): cells a unit of length, of each cell, where their widths differ. Slopes are then
            by that unit, otherwise a cell each.
    """
    flat, base, axes, lowers = _locate(values, cells)
    value, slopes = _value_and_slopes(flat, base, axes, 0)
    if rates is not None:
        used = [rate for rate, n in zip(rates, values.shape, strict=True) if n > 1]
        slopes = [slope * rate.index_select(0, lower) for slope, rate, lower in zip(slopes, used, lowers, strict=True)]
    shape, rest = cells[0].shape, iter(slopes)
    zero = torch.zeros_like(cells[0])
    return value.reshape(shape), [next(rest).reshape(shape) if n > 1 else zero for n in values.shape]


def _locate(values: Tensor, cells: list[Tensor]) -> tuple[Tensor, Tensor, list[tuple[int, Tensor]], list[Tensor]]:
    """Flat values, flat index of each point's lower corner; of each axis of more nodes stride and fraction, and index.

    The last is the lower corner's along the axis.
    """
    x, y, z = values.shape[:3]
    # 32 bits are quicker, where they reach
    kind = torch.int32 if x * y * z < 2**31 else torch.int64
    channels = (1,) * (values.ndim - 3)
    base = torch.zeros(cells[0].numel(), dtype=kind, device=values.device)
    axes: list[tuple[int, Tensor]] = []
    lowers: list[Tensor] = []
    for cell, n, stride in zip(cells, (x, y, z), (y * z, z, 1), strict=True):
        if n > 1:
            plane = cell.reshape(-1)
            lower = plane.detach().to(kind).clamp_max_(n - 2)
            base = lower * stride if not axes else base.add_(lower, alpha=stride)
            axes.append((stride, (plane - lower).reshape(-1, *channels)))
            lowers.append(lower)
    return values.reshape(x * y * z, *values.shape[3:]).to(cells[0].dtype), base, axes, lowers


def _value(flat: Tensor, base: Tensor, axes: list[tuple[int, Tensor]], offset: int) -> Tensor:
    if not axes:
        # a shifted view of the values, so that one index serves all eight corners
        return flat[offset:].index_select(0, base)
    (stride, fraction), rest = axes[0], axes[1:]
    return torch.lerp(_value(flat, base, rest, offset), _value(flat, base, rest, offset + stride), fraction)


def _value_and_slopes(
    flat: Tensor, base: Tensor, axes: list[tuple[int, Tensor]], offset: int
) -> tuple[Tensor, list[Tensor]]:
    if not axes:
        return flat[offset:].index_select(0, base), []
    (stride, fraction), rest = axes[0], axes[1:]
    low, low_slopes = _value_and_slopes(flat, base, rest, offset)
    high, high_slopes = _value_and_slopes(flat, base, rest, offset + stride)
    slopes = [torch.lerp(a, b, fraction) for a, b in zip(low_slopes, high_slopes, strict=True)]
    return torch.lerp(low, high, fraction), [high - low, *slopes]
