"""Outlines of an object at the height of the tool, and its support on the floor."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as nnf
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.dynamics.sliding import OutlineQuery
from sdf.base import SDF
from sdf.primitives import rectangle

_LAYERS = 4  # of a lattice across what is thin, at least


@dataclass(frozen=True)
class RectangleOutline:
    """A rectangle about the origin, in closed form.

    Attributes:
        half: half of its length along x and along y, metres.
    """

    half: tuple[float, float]

    @property
    def radius(self) -> float:
        """Distance of its corners from the origin, metres."""
        return float(torch.tensor(self.half).norm())

    def __call__(self, points_o: Float[Tensor, "*b 2"]) -> OutlineQuery:
        """Signed distance and gradient."""
        excess = points_o.abs() - points_o.new_tensor(self.half)
        distance, outside = rectangle(excess), excess.clamp_min(0.0)
        length = outside.norm(dim=-1, keepdim=True)
        nearest = torch.nn.functional.one_hot(excess.argmax(-1), 2).to(points_o)
        away = torch.where(length > 0, outside / length.clamp_min(1e-12), nearest)
        return OutlineQuery(distance, away * torch.where(points_o < 0, -1.0, 1.0).to(away))

    def to(self, like: Tensor) -> "RectangleOutline":
        """Itself: it is of no device and of no dtype."""
        return self


@dataclass(frozen=True, eq=False)
class GridOutline:
    """An outline as a table of signed distances, bilinear between nodes.

    Attributes:
        values: (X, Y), metres; positive on the border.
        origin: (2,), where node (0, 0) is.
        spacing: metres between nodes.
        radius: greatest distance of the region from the frame's origin, metres.
    """

    values: Float[Tensor, "X Y"]
    origin: Float[Tensor, "2"]
    spacing: float
    radius: float

    @classmethod
    def of_slice(cls, sdf: SDF, height: float, *, spacing: float = 0.001, margin: float = 0.012) -> "GridOutline":
        """What a tool meets of an upright object at one height: cavities that it could only jump into are filled.

        Args:
            sdf: of the object.
            height: of the slice, object frame, metres.
            spacing: of the table.
            margin: of free space about the object's bounds.

        Raises:
            ValueError: the object is not met at that height.
        """
        found = slice_of(sdf, height, spacing=spacing, margin=margin)
        if found is None:
            above = height - float(sdf.bounds[0, 2])
            raise ValueError(
                f"Expected the object to have walls {1e3 * above:.0f} mm above its lowest point, where the tool "
                "is, got nothing there: choose another height of the tool, or a finer table of distances"
            )
        values, nodes, spacing = found
        low = nodes[0, 0]
        outside = _outside(values)
        values = _filled(values, outside, nodes, spacing)
        radius = float(nodes[~outside].norm(dim=-1).max()) + spacing
        return cls(values, low.clone(), spacing, radius)

    def __call__(self, points_o: Float[Tensor, "*b 2"]) -> OutlineQuery:
        """Signed distance and gradient; beyond the table, a positive lower bound of the distance."""
        last = self.values.new_tensor([float(n - 1) for n in self.values.shape])
        place = (points_o - self.origin) / self.spacing
        inside = torch.minimum(place.clamp_min(0.0), last)
        corner = torch.minimum(inside.floor(), last - 1.0)
        a, b = (inside - corner).unbind(-1)
        i, j = corner.long().unbind(-1)
        v00, v01, v10, v11 = (self.values[i + di, j + dj] for di in (0, 1) for dj in (0, 1))
        low, high = v00 + b * (v01 - v00), v10 + b * (v11 - v10)
        along = torch.stack((high - low, (1.0 - a) * (v01 - v00) + a * (v11 - v10)), -1) / self.spacing
        beyond = (place - inside).norm(dim=-1) * self.spacing
        there = low + a * (high - low)
        # the way to the table and the one on from there are at a right angle at least
        return OutlineQuery(torch.where(beyond > 0, torch.hypot(there, beyond), there), along)

    @cached_property
    def slack(self) -> float:
        """Metres by which the value at the node next to a place may exceed the distance there, and 1-Lipschitz ones.

        Tables are off by rounding, and their bilinear values are steeper than distances here and there.
        """
        along, across = (float(self.values.diff(dim=axis).abs().max()) for axis in (0, 1))
        return self.spacing + math.sqrt(0.5) * math.hypot(along, across)

    @cached_property
    def steepness(self) -> float:
        """Lipschitz constant of the bilinear values where the object is not: a cell is steepest in a corner."""
        values = self.values
        along, across = (values.diff(dim=axis) / self.spacing for axis in (0, 1))
        slopes = [torch.hypot(a, b) for a in (along[:, :-1], along[:, 1:]) for b in (across[:-1], across[1:])]
        free = nnf.max_pool2d((values >= 0).to(values)[None, None], 2, stride=1)[0, 0] > 0
        steepest = torch.where(free, torch.stack(slopes).amax(0), 0.0).max()
        return max(1.0, float(steepest)) * (1.0 + 1e-4)  # against rounding

    def to(self, like: Tensor) -> "GridOutline":
        """Itself, or a copy, on the device and of the dtype of a tensor."""
        if self.values.dtype == like.dtype and self.values.device == like.device:
            return self
        return GridOutline(self.values.to(like), self.origin.to(like), self.spacing, self.radius)


def slice_of(
    sdf: SDF, height: float, *, spacing: float = 0.001, margin: float = 0.012
) -> tuple[Float[Tensor, "X Y"], Float[Tensor, "X Y 2"], float] | None:
    """Signed distances of a level slice of an object on a lattice, its nodes and their spacing; None if it is empty.

    Args:
        sdf: of the object.
        height: of the slice, object frame, metres.
        spacing: of the lattice, metres; a quarter of it where that is what it takes to meet a thin wall.
        margin: of free space about the object's bounds.
    """
    low, high = sdf.bounds[0, :2] - margin, sdf.bounds[1, :2] + margin
    for step in (spacing, 0.5 * spacing, 0.25 * spacing):
        counts = torch.ceil((high - low) / step).long() + 1
        axes = [low[i] + step * torch.arange(int(counts[i]), dtype=low.dtype, device=low.device) for i in range(2)]
        nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        points = torch.cat((nodes, torch.full_like(nodes[..., :1], height)), -1)
        with torch.no_grad():
            values = sdf.distance(points)
        if bool((values <= 0).any()):
            return values, nodes, step
    return None


class Support(NamedTuple):
    """Support of an object on the floor: its centre and extent.

    Attributes:
        centre: (2,), below the centre of mass, object frame, metres.
        spread: mean distance of what rests on the floor from there, metres.
        elongation: (2,), of the base's second moments: (yy - xx, -2 xy) over their trace; (-1, 0) for a rod along x.
    """

    centre: Float[Tensor, "2"]
    spread: float
    elongation: Float[Tensor, "2"]

    @classmethod
    def of_base(cls, base: Float[Tensor, "n 2"], centre: Float[Tensor, "2"]) -> "Support":
        """Of even points of what rests on the floor, and the point below the centre of mass."""
        off = base - centre
        xx, yy, xy = off[:, 0].square().mean(), off[:, 1].square().mean(), (off[:, 0] * off[:, 1]).mean()
        return cls(centre, float(off.norm(dim=-1).mean()), torch.stack((yy - xx, -2.0 * xy)) / (xx + yy))

    def cpu(self) -> "Support":
        """The same, where the host reads it without waiting for a GPU."""
        return self._replace(centre=self.centre.cpu(), elongation=self.elongation.cpu())


class Base(NamedTuple):
    """Base of an upright object.

    Attributes:
        points: (B, 2), evenly over what rests on the floor, object frame, metres.
        centre: (2,), below the centre of mass.
    """

    points: Float[Tensor, "B 2"]
    centre: Float[Tensor, "2"]


def base_of(sdf: SDF, *, spacing: float = 0.002, above_m: float = 0.001) -> Base:
    """Base of an upright object of even density, from its signed distances on a lattice.

    Args:
        sdf: of the object.
        spacing: of the lattice, metres; finer across what is thin.
        above_m: what reaches down to this height above the lowest point rests on the floor.

    Raises:
        ValueError: the object has no inside.
    """
    low, high = sdf.bounds
    axes = []
    for i in range(3):
        step = min(spacing, float(high[i] - low[i]) / _LAYERS)
        axes.append(torch.arange(float(low[i]), float(high[i]), step, dtype=low.dtype) + 0.5 * step)
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).to(low)
    with torch.no_grad():
        inside = points[sdf.distance(points) <= 0]
    if len(inside) == 0:
        raise ValueError("Expected an object with an inside, got none: are its walls too thin for the table?")
    rests = inside[:, 2] <= inside[:, 2].min() + above_m
    return Base(inside[rests, :2], inside[:, :2].mean(0))


def support_of(sdf: SDF, *, spacing: float = 0.002, above_m: float = 0.001) -> Support:
    """Centre of mass and extent of the base of an upright object; arguments and errors as of `base_of`."""
    return Support.of_base(*base_of(sdf, spacing=spacing, above_m=above_m))


def _outside(values: Float[Tensor, "X Y"]) -> Bool[Tensor, "X Y"]:
    """Free nodes that are joined to the border by free ones."""
    free = values > 0
    reached = torch.zeros_like(free)
    reached[0] = reached[-1] = True
    reached[:, 0] = reached[:, -1] = True
    reached &= free
    while True:
        grown = nnf.max_pool2d(reached.to(values.dtype)[None, None], 3, stride=1, padding=1)[0, 0] > 0
        grown &= free
        if bool((grown == reached).all()):
            return reached
        reached = grown


def _filled(
    values: Float[Tensor, "X Y"], outside: Bool[Tensor, "X Y"], nodes: Float[Tensor, "X Y 2"], spacing: float
) -> Float[Tensor, "X Y"]:
    """Minus the distance to the outer border inside of it, where that is not what the table holds already."""
    slope = torch.stack(torch.gradient(values, spacing=spacing), -1)
    slope = slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    near = outside & (values < 2.0 * spacing)
    feet = nodes[near] - values[near, None] * slope[near]
    within = ~outside
    depth = torch.cdist(nodes[within], feet).amin(-1)
    known = values[within]
    filled = torch.where((known <= 0) & (depth < spacing - known), known, -depth)
    return values.masked_scatter(within, filled)
