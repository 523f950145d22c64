"""Tabulated signed distance function: trilinear interpolation on a lattice, with a bound beyond it."""

from typing import Self, TypeGuard

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.base import SDF, SDFQuery, Sized
from sdf.check import check_shape, is_eager, keep_within_reach
from sdf.lattice import Lattice, lattice_about
from sdf.lookup import interpolate, interpolate_with_slopes

_CHUNK = 1 << 18
# squared metres: less than any distance that matters, more than float32 loses
_TINY = 1e-30
# fine spacings from the lattice's end within which points are not taken as within it: more than rounding moves them
_EDGE = 1e-2
# lattices of more nodes than 32 bits can count are left to the plain version
_MOST_NODES = 2**31 - 1


class GridSDF(Sized):
    """Trilinear interpolation between distances at the nodes of a lattice, finite and continuous everywhere.

    The lattice is fine around the object and, where asked, goes on with a few wide cells on every side, node by
    node on the same axes, so that nothing jumps where the spacing changes. Beyond its last node, with c the
    nearest point of the lattice's box, s_i how far x is from c along axis i and p the distance from the box's
    faces to the object's bounds,

        distance(x) = sqrt(distance(c)^2 + sum_i s_i (s_i + 2 p)),

    which joins without a jump, is a lower bound of the true distance and has slope at most 1 wherever
    the table is a true distance: every surface point is at least p behind each face, so the law of cosines gives
    the bound. Trilinear values themselves are steeper than 1 only within a cell of a sharp edge (by less than
    sqrt 3). A point that is not finite counts as very far outside: never NaN.

    Args:
        values: (X, Y, Z), metres, at the nodes; at least two along each axis.
        origin: metres, the lower corner of the fine part.
        spacing: metres between the nodes of the fine part.
        bounds: (2, 3), metres, of the object; must lie within the fine part.
        outer: number of wide cells on every side; they are part of `values`.
        outer_spacing: their width, metres.
    """

    values: Float[Tensor, "X Y Z"]
    numbers = ("origin", "spacing", "outer", "outer_spacing", "inset")

    def __init__(
        self,
        values: Float[Tensor, "X Y Z"],
        origin: tuple[float, float, float],
        spacing: float,
        bounds: Float[Tensor, "2 3"],
        *,
        outer: int = 0,
        outer_spacing: float = 0.02,
    ) -> None:
        check_shape("values", values, "(X, Y, Z)")
        check_shape("bounds", bounds, "(2, 3)")
        super().__init__(bounds)
        if not spacing > 0 or (outer and outer_spacing < spacing):
            raise ValueError(f"Expected 0 < spacing <= outer_spacing, got {spacing} and {outer_spacing} m")
        if min(values.shape) < 2 * outer + 2:
            raise ValueError(f"Expected at least {2 * outer + 2} nodes along each axis, got {tuple(values.shape)}")
        self.register_buffer("values", values)
        self.origin = tuple(float(x) for x in origin)
        self.spacing, self.outer, self.outer_spacing = float(spacing), int(outer), float(outer_spacing)
        low, high = bounds.tolist()
        insets = [
            min(a - start, start + spacing * (n - 1 - 2 * outer) - b)
            for a, b, start, n in zip(low, high, self.origin, values.shape, strict=True)
        ]
        if min(insets) < -2e-3 * spacing:
            raise ValueError(
                f"Expected bounds within the fine lattice, got {bounds.tolist()} outside by {-min(insets):g} m: pad it"
            )
        self.inset = max(min(insets), 0.0) + outer * self.outer_spacing

    def resized(self, factor: float) -> Self:
        """The same shape in another size, with as many nodes."""
        wide = factor * self.outer_spacing
        origin = tuple(factor * x for x in self.origin)
        low = (origin[0], origin[1], origin[2])
        return type(self)(
            factor * self.values, low, factor * self.spacing, factor * self.bounds, outer=self.outer, outer_spacing=wide
        )

    @classmethod
    def from_sdf(
        cls,
        sdf: SDF,
        spacing: float = 0.002,
        padding: float = 0.02,
        *,
        outer: float = 0.25,
        outer_spacing: float = 0.02,
    ) -> Self:
        """Tabulate another SDF, in its dtype and on its device.

        Args:
            sdf: any; exact outside, so that the table is a true distance there.
            spacing: metres; at most half of the thinnest wall, else the wall is lost.
            padding: metres of fine lattice beyond the SDF's bounds.
            outer: metres, at least, of wide cells beyond that; 0 for none.
            outer_spacing: width of these, metres.

        Raises:
            ValueError: if the SDF gives a distance that is not finite.
        """
        lattice = lattice_about(sdf.bounds, spacing, padding, outer=outer, outer_spacing=outer_spacing)
        axes = [axis.to(sdf.bounds) for axis in lattice.axes]
        nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
        with torch.no_grad():
            values = torch.cat([sdf.distance(part) for part in nodes.reshape(-1, 3).split(_CHUNK)])
        if not bool(torch.isfinite(values).all()):
            raise ValueError(f"Expected finite distances from {type(sdf).__name__}, got NaN or infinity")
        return cls.on_lattice(values.reshape(nodes.shape[:-1]), lattice, sdf.bounds.clone())

    @classmethod
    def on_lattice(cls, values: Float[Tensor, "X Y Z"], lattice: Lattice, bounds: Float[Tensor, "2 3"]) -> Self:
        """From distances, metres, at the nodes of a lattice about an object's bounds."""
        return cls(
            values,
            lattice.origin,
            lattice.spacing,
            bounds,
            outer=lattice.outer,
            outer_spacing=lattice.outer_spacing,
        )

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres; differentiable (twice) to points and to `values`."""
        cells, offsets = self._cells(points_o)
        return self._join(interpolate(self.values, cells), offsets)[0]

    def forward(self, points_o: Float[Tensor, "*b 3"]) -> SDFQuery:
        """Signed distance (*b), metres, and the exact gradient (*b, 3) of what `distance` gives."""
        cells, offsets = self._cells(points_o)
        rates = [self._rates(axis, points_o) for axis in range(3)]
        value, slopes = interpolate_with_slopes(self.values, cells, rates)
        return self._query(value, slopes, offsets)

    def distance_at_height(self, xy: Float[Tensor, "*b 2"], z: float | Float[Tensor, ""]) -> Float[Tensor, "*b"]:
        """What `distance` gives at points (x, y, z) of one height: four corners a point instead of eight."""
        cells, offsets = self._cells(xy, z)
        low, high, share, _ = self._layers(cells[2])
        return self._join(interpolate(torch.lerp(low, high, share), cells), offsets)[0]

    def query_at_height(self, xy: Float[Tensor, "*b 2"], z: float | Float[Tensor, ""]) -> SDFQuery:
        """What `forward` gives at points (x, y, z) of one height, gradient (*b, 3)."""
        cells, offsets = self._cells(xy, z)
        low, high, share, rate = self._layers(cells[2])
        rates = [self._rates(axis, xy) for axis in range(3)]
        value, slopes = interpolate_with_slopes(torch.lerp(low, high, share), cells, rates)
        slopes[2] = interpolate((high - low) * rate, cells)
        return self._query(value, slopes, offsets)

    def layer(self, z: Float[Tensor, ""]) -> tuple[Float[Tensor, "X Y"], Float[Tensor, "X Y"], Float[Tensor, "2"]]:
        """The table at one height, in the dtype of `z`: what look-ups at that height draw on.

        Args:
            z: height, metres.

        Returns:
            values, metres, at the nodes; their slopes along z, metres a cell; and along z the offset beyond the
            lattice, fine spacings, with the cells a fine spacing there.
        """
        cell, offset = self._along(2, z, within=False)
        assert offset is not None
        low, high, share, rate = self._layers(cell)
        cells = rate * self.spacing * (offset == 0)
        return torch.lerp(low, high, share)[..., 0], (high - low)[..., 0], torch.stack((offset, cells))

    def box_of(self) -> Float[Tensor, "2 3"]:
        """Lower and upper corner, object frame, of the box that the table bounds its values by; float64.

        Within the lattice no point is deeper than it is behind any of the faces, in front of which that is negative:
        nodes make it so, and interpolation between them keeps it so. Beyond the lattice none is deeper than at its end.
        """
        low, high = (corner.tolist() for corner in self.bounds.double())
        values, corners = self.values.detach().double(), []
        for axis in range(3):
            others = [other for other in range(3) if other != axis]
            least = values.amin(others)
            nodes = self._nodes(axis).to(least)
            up, down = float((nodes - least).amax()), float((nodes + least).amin())
            corners.append((min(low[axis], down), max(high[axis], up)))
        return torch.tensor(corners, dtype=torch.float64).T.contiguous()

    def _nodes(self, axis: int) -> Float[Tensor, "n"]:
        """Coordinates of an axis's nodes, metres."""
        count = self.values.shape[axis]
        place = torch.arange(count, dtype=torch.float64) - self.outer
        fine = place.clamp(0, count - 1 - 2 * self.outer)
        return self.origin[axis] + fine * self.spacing + (place - fine) * self.outer_spacing

    def _cells(self, points: Tensor, z: float | Tensor | None = None) -> tuple[list[Tensor], list[Tensor | None]]:
        """By axis: lattice coordinates, and offsets beyond the lattice, None where no point is beyond it.

        Offsets are in fine spacings. In lattice coordinates a wide cell is one unit, as a fine one is. What is
        skipped: clamping, and joining what is beyond, along an axis on which every point is within the lattice.
        That is looked up only where no graph is kept.
        """
        check_shape("points", points, "(*b, 3)" if z is None else "(*b, 2)")
        planes = list(points.unbind(-1))
        if z is not None:
            planes.append(torch.as_tensor(z, dtype=points.dtype, device=points.device))
        within = self._within(planes)
        along = [
            self._along(axis, plane, inner) for axis, (plane, inner) in enumerate(zip(planes, within, strict=True))
        ]
        cells, offsets = zip(*along, strict=True)
        return list(cells), list(offsets)

    def _within(self, planes: list[Tensor]) -> list[bool]:
        """By axis, whether all points are within the lattice; False where that may not or need not be known."""
        graph = torch.is_grad_enabled() and any(plane.requires_grad for plane in planes)
        if graph or not all(plane.numel() for plane in planes) or not is_eager():
            return [False] * len(planes)
        extremes = torch.stack([extreme for plane in planes for extreme in torch.aminmax(plane)]).tolist()
        reach = self.outer * self.outer_spacing - _EDGE * self.spacing
        starts = [start - reach for start in self.origin]
        ends = [
            start + (n - 1 - 2 * self.outer) * self.spacing + reach
            for start, n in zip(self.origin, self.values.shape, strict=True)
        ]
        # never so for NaN
        return [
            start < low and high < end
            for low, high, start, end in zip(extremes[::2], extremes[1::2], starts, ends, strict=True)
        ]

    def _along(self, axis: int, plane: Tensor, within: bool) -> tuple[Tensor, Tensor | None]:
        """Lattice coordinate and offset of one axis.

        Which cell a point is in, `floor` of its coordinate decides, for the derivative too: at the node where fine and
        wide cells meet, or an ulp beside it, a derivative of the one with the slope of the other would be wrong by the
        ratio of their widths.
        """
        last, ratio = self.values.shape[axis] - 1 - self.outer, self.spacing / self.outer_spacing
        scale, reach = 1.0 / self.spacing, self.outer / ratio
        # in fine spacings, such that the first fine node, number `outer`, is at `outer`
        place = (plane if within else keep_within_reach(plane)) * scale + (self.outer - self.origin[axis] * scale)
        if within:
            return torch.lerp(place.clamp(self.outer, last), place, ratio) if self.outer else place, None
        cell = fine = place.clamp(self.outer, last)
        kept = place.clamp(self.outer - reach, last + reach) if self.outer else fine
        offset = place - kept
        if self.outer:
            cell = torch.lerp(fine, kept, ratio)
            if place.requires_grad or not is_eager():
                in_fine = ((cell >= self.outer) & (cell < last)).to(cell.dtype)
                rate = (ratio + (1.0 - ratio) * in_fine) * (offset.detach() == 0)
                cell = cell.detach() + rate * (place - place.detach())
        return cell, offset

    def _rates(self, axis: int, like: Tensor) -> Tensor:
        """(n - 1,), cells a metre in each cell of an axis."""
        rates = like.new_full((self.values.shape[axis] - 1,), 1.0 / self.spacing)
        if self.outer:
            rates[: self.outer] = rates[-self.outer :] = 1.0 / self.outer_spacing
        return rates

    def _layers(self, cell: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Nodes (X, Y, 1) below and above a lattice height, how far between them it is, and the cells a metre there."""
        below = cell.detach().floor().clamp(0.0, self.values.shape[2] - 2.0)
        values, index = self.values.to(cell.dtype), below.long()[None]
        low, high = values.index_select(2, index), values.index_select(2, index + 1)
        return low, high, cell - below, self._rates(2, cell)[index[0]]

    def _join(self, value: Tensor, offsets: list[Tensor | None]) -> tuple[Tensor, Tensor | None]:
        """The distance from the clamped point's value and the offsets beyond the lattice; and its size, if any is.

        Without branches, which cost more than the sums: where nothing is beyond, the root is |value| to the bit.
        """
        sizes = [offset.abs() for offset in offsets if offset is not None]
        if not sizes:
            return value, None
        twice = 2.0 * self.inset / self.spacing
        total = sizes[0] * (sizes[0] + twice)
        for size in sizes[1:]:
            total = torch.addcmul(total, size, size + twice)
        far = torch.addcmul(total * self.spacing**2, value, value).clamp_min(_TINY).sqrt()
        return value + (far - value.abs()), far

    def _query(self, value: Tensor, slopes: list[Tensor], offsets: list[Tensor | None]) -> SDFQuery:
        """Distance and gradient from the look-up's value and slopes a metre, by the chain rule."""
        distance, far = self._join(value, offsets)
        if far is None:
            return SDFQuery(distance, _vectors(slopes))
        inverse = 1.0 / far
        # less than 1 where the value counts for less of the distance
        share = 1.0 + (value * inverse - value.sign())
        spread = inverse * self.spacing
        inset = self.inset / self.spacing
        gradient = []
        for slope, offset in zip(slopes, offsets, strict=True):
            along = slope * share
            if offset is not None:
                beyond = torch.add(offset, offset.sign(), alpha=inset)
                along = torch.addcmul(along * (offset.detach() == 0), spread, beyond)
            gradient.append(along)
        return SDFQuery(distance, _vectors(gradient))


def tabulated(sdf: SDF) -> GridSDF:
    """The same, known to be a table.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(sdf, GridSDF):
        raise TypeError(f"Expected an object whose distances are tabulated, got {type(sdf).__name__}")
    return sdf


def takes(sdf: SDF, *tensors: Tensor) -> TypeGuard[GridSDF]:
    """Whether compiled look-ups apply: the SDF is a table, not too large, and the tensors are of one float type."""
    return isinstance(sdf, GridSDF) and sdf.values.numel() <= _MOST_NODES and len({t.dtype for t in tensors}) == 1


def lattice_numbers(sdf: GridSDF) -> tuple[list[float], list[int]]:
    """The numbers of a table's lattice, in the order of `grid_numba.lattice_of`, and its sizes."""
    scale = 1.0 / sdf.spacing
    ratio = sdf.spacing / sdf.outer_spacing if sdf.outer else 1.0
    sizes = list(sdf.values.shape)
    numbers = [
        scale,
        *(sdf.outer - start * scale for start in sdf.origin),
        float(sdf.outer),
        *(float(n - 1 - sdf.outer) for n in sizes),
        sdf.outer / ratio,
        ratio,
        sdf.spacing,
        sdf.inset / sdf.spacing,
        *(float(n - 2) for n in sizes),
    ]
    return numbers, sizes


def _vectors(planes: list[Tensor]) -> Tensor:
    """Vectors (*b, 3) of three planes (*b), kept plane by plane: copied in one go."""
    return torch.stack(planes).movedim(0, -1)
