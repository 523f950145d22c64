"""Convex tool surfaces: the first intersection of a line with a ball or polyhedron."""

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf.check import check_finite, check_shape
from sdf.mesh.mesh import MeshError, TriangleMesh
from sdf.mesh.triangles import area_vectors

# planes that differ by less than this (of unit normals, and of the diagonal) are one
_SAME = 1e-7
# share of the diagonal by which a corner may stand out of a face's plane
_CONVEX = 1e-5
# of the search for where a line comes nearest; each step takes another face, and few are needed
_STEPS = 64


class LineIntersection(NamedTuple):
    """First intersections of lines with a surface.

    Attributes:
        point: (*b, 3), on the surface, metres; where the line misses it, a point next to where it comes nearest.
        normal: (*b, 3), outward there, unit; it faces the line.
        gap: (*b), metres that the surface would have to grow outward for the line to meet it; 0 or less where it does.
    """

    point: Float[Tensor, "*b 3"]
    normal: Float[Tensor, "*b 3"]
    gap: Float[Tensor, "*b"]


@runtime_checkable
class ToolSurface(Protocol):
    """A convex surface in the sensor's frame: a sphere, or the planes of a polyhedron."""

    sphere: Float[Tensor, "4"]  # centre and radius, metres; a radius of 0 for a polyhedron
    planes: Float[Tensor, "F 4"]  # outward unit normals and offsets: inside is n . x <= offset; none for a sphere

    def strike(self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]) -> LineIntersection:
        """Where lines that come from afar along unit directions first meet the surface."""
        ...

    def normal_sd(
        self, struck: LineIntersection, direction: Float[Tensor, "*b 3"], roots: Float[Tensor, "*b 2 3"], least: float
    ) -> Float[Tensor, "*b"]:
        """Standard deviation (*b) of the normal about each axis, radians, of lines displaced by +- the two roots.

        `least` is the least cosine between a line and the normal, of which a touch can be.
        """
        ...


class SphereTool:
    """A ball.

    Args:
        center_s: (3,), in the sensor's frame, metres.
        radius_m: above 0.
    """

    def __init__(self, center_s: Float[Tensor, "3"], radius_m: float) -> None:
        check_shape("center_s", center_s, "(3,)", last=(3,))
        check_finite("center_s", center_s)
        if not 0 < radius_m < math.inf:
            raise ValueError(f"Expected a radius above 0 and below infinity, got {radius_m}")
        self.sphere = torch.cat((center_s.double().cpu(), torch.tensor([float(radius_m)], dtype=torch.float64)))
        self.planes = torch.zeros(0, 4, dtype=torch.float64)

    def strike(self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]) -> LineIntersection:
        """In closed form; see `ToolSurface`."""
        center, radius = self.sphere[:3].to(origin), self.sphere[3].to(origin)
        apart = origin - center
        foot = apart - _dot(apart, direction)[..., None] * direction
        square = foot.square().sum(-1)
        meets = square <= radius**2
        far = torch.where(meets, radius**2, square).sqrt()
        depth = torch.where(meets, radius**2 - square, torch.zeros_like(square))
        # no square root of 0 on the way of a gradient
        deep = depth > 0
        back = torch.where(deep, torch.where(deep, depth, 1.0).sqrt(), 0.0)
        normal = torch.where(meets[..., None], (foot - back[..., None] * direction) / radius, foot / far[..., None])
        some = square > 0
        distance = torch.where(some, torch.where(some, square, 1.0).sqrt(), 0.0)
        return LineIntersection(center + radius * normal, normal, distance - radius)

    def normal_sd(
        self, struck: LineIntersection, direction: Float[Tensor, "*b 3"], roots: Float[Tensor, "*b 2 3"], least: float
    ) -> Float[Tensor, "*b"]:
        """In closed form, to first order; see `ToolSurface`."""
        slant = _dot(struck.normal, direction).clamp(max=-least)
        along = (roots @ struck.normal[..., None])[..., 0] / slant[..., None]
        moved = roots - along[..., None] * direction[..., None, :]
        return (0.5 * moved.square().sum((-1, -2))).sqrt() / self.sphere[3].to(moved)


class ConvexTool:
    """A convex polyhedron.

    Args:
        planes: (F, 4), outward unit normals and offsets in the sensor's frame, metres: inside is n . x <= offset.
    """

    def __init__(self, planes: Float[Tensor, "F 4"]) -> None:
        check_shape("planes", planes, "(F, 4)", last=(4,))
        check_finite("planes", planes)
        if len(planes) < 4:
            raise ValueError(f"Expected at least 4 planes, got {len(planes)}: fewer enclose nothing")
        self.sphere = torch.zeros(4, dtype=torch.float64)
        self.planes = planes.double().cpu()

    @classmethod
    def of(cls, mesh: TriangleMesh, sensor_T_tool: Float[Tensor, "4 4"] | None = None) -> "ConvexTool":
        """The tool with the shape of a mesh.

        Args:
            mesh: convex, closed, oriented outward; `sdf.mesh.convex.hull` makes one of any mesh.
            sensor_T_tool: (4, 4), from the mesh's frame to the sensor's; None where they are one.

        Raises:
            MeshError: if it is not convex.
        """
        if sensor_T_tool is not None:
            mesh = mesh.moved(sensor_T_tool)
        vectors = area_vectors(mesh.corners)
        size = vectors.norm(dim=-1)
        # slivers have no normal to speak of, and their neighbours the same plane
        kept = size > 1e-9 * size.max()
        normals = vectors[kept] / size[kept, None]
        offsets = (normals * mesh.corners[kept].mean(-2)).sum(-1)
        used = mesh.vertices[mesh.faces.unique()]
        out = float((used @ normals.T - offsets).max())
        if out > _CONVEX * mesh.diagonal:
            raise MeshError(
                f"Expected a convex mesh, got one with corners {1e3 * out:.3g} mm in front of a face: take its hull "
                "(sdf.mesh.convex.hull), or look whether its faces point outward"
            )
        planes = torch.cat((normals, offsets[:, None]), -1)
        scaled = planes / torch.tensor([1.0, 1.0, 1.0, mesh.diagonal], dtype=planes.dtype)
        first: dict[tuple[int, ...], int] = {}
        for index, key in enumerate(map(tuple, (scaled / _SAME).round().long().tolist())):
            first.setdefault(key, index)
        return cls(planes[list(first.values())])

    def strike(self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]) -> LineIntersection:
        """By the planes: a line is inside between the last that it enters by and the first that it leaves by."""
        normals, offsets = self.planes[:, :3].to(origin), self.planes[:, 3].to(origin)
        rate, room = direction @ normals.mT, offsets - origin @ normals.mT
        time = room / torch.where(rate == 0, 1.0, rate)
        into, out = rate < 0, rate > 0
        enter = time.masked_fill(~into, -torch.inf).max(-1)
        leave = time.masked_fill(~out, torch.inf).min(-1)
        beside = ((rate == 0) & (room < 0)).any(-1)
        meets = (enter.values <= leave.values) & ~beside
        at, face, gap = _nearest_approach(rate, room, enter.indices, leave.indices, meets)
        normal = normals[face]
        point = origin + torch.where(meets, enter.values, at)[..., None] * direction
        point = torch.where(meets[..., None], point, point - gap[..., None] * normal)
        return LineIntersection(point, normal, gap)

    def normal_sd(
        self, struck: LineIntersection, direction: Float[Tensor, "*b 3"], roots: Float[Tensor, "*b 2 3"], least: float
    ) -> Float[Tensor, "*b"]:
        """By striking with the displaced lines, which may meet other faces; see `ToolSurface`."""
        total = torch.zeros_like(struck.gap)
        for axis in (0, 1):
            for sign in (1.0, -1.0):
                other = self.strike(struck.point + sign * roots[..., axis, :], direction)
                total = total + 0.5 * _angle(other.normal, struck.normal).square()
        return (0.5 * total).sqrt()


def _nearest_approach(
    rate: Float[Tensor, "*b F"], room: Float[Tensor, "*b F"], enter: Tensor, leave: Tensor, meets: Bool[Tensor, "*b"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Where a line is least outside of the planes, the face by which it would enter, and by how much it is outside.

    The least of max(rate t - room) over t: the falling and the rising plane that meet highest, found by taking in
    the plane that is highest where the last two meet.
    """
    values: Callable[[Tensor, Tensor], Tensor] = lambda source, index: source.gather(-1, index[..., None])[..., 0]  # noqa: E731
    done = meets
    for _ in range(_STEPS):
        if bool(done.all()):
            break
        at = (values(room, enter) - values(room, leave)) / (values(rate, enter) - values(rate, leave))
        height = values(rate, enter) * at - values(room, enter)
        highest = (rate * at[..., None] - room).max(-1)
        scale = room.abs().amax(-1) * torch.finfo(room.dtype).eps * 8.0
        done = done | (highest.values <= height + scale)
        falls = values(rate, highest.indices) <= 0
        enter = torch.where(~done & falls, highest.indices, enter)
        leave = torch.where(~done & ~falls, highest.indices, leave)
    at = (values(room, enter) - values(room, leave)) / (values(rate, enter) - values(rate, leave))
    gap = values(rate, enter) * at - values(room, enter)
    return at, enter, torch.where(meets, gap.clamp(max=0.0), gap)


def _dot(a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    return (a * b).sum(-1)


def _angle(a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Between unit vectors; exact for small angles too."""
    return 2.0 * torch.asin((0.5 * (a - b).norm(dim=-1)).clamp(max=1.0))
