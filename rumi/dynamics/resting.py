"""Stable resting poses of a rigid object on a floor, and how it topples from one to the next.

A resting pose stands on the convex hull of what touches the floor, with the centre of mass above it. Pushed high
enough it pivots about an edge of that hull; once the centre of mass is beyond the edge, it falls on and rolls from edge
to edge until it rests again (Goldberg and others, "Part pose statistics", 1999, have the graph of these).
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf import se3
from sdf.base import SDF
from sdf.symmetry import Symmetries

_SPACING_M = 0.003  # of the lattice from which surface points are found
_FLOOR_M = 0.0012  # what reaches down to this above the lowest point rests on the floor
_SAME_RAD = 0.12  # resting poses whose up directions are nearer than this are one
_EDGE_M = 0.004  # edges of a hull shorter than this are no edges to topple over
_LEVER_M = 0.02  # what is nearer to the edge that it rolls over tells its angle badly
_ROLLS, _MOST = 8, 16


class Edges(NamedTuple):
    """Edges of the hulls of F resting poses, E of each; those of no length have a tip angle of infinity.

    Attributes:
        point: (F, E, 2), on the edge nearest to below the centre of mass, metres; resting frame.
        normal: (F, E, 2), outward, unit.
        tip_rad: (F, E), tilt about the edge at which the centre of mass is above it.
        next: (F, E), resting pose after it toppled over the edge.
        change: (F, E, 3), planar pose (x, y, yaw) afterwards in the frame of the planar pose before.
    """

    point: Float[Tensor, "F E 2"]
    normal: Float[Tensor, "F E 2"]
    tip_rad: Float[Tensor, "F E"]
    next: Int[Tensor, "F E"]
    change: Float[Tensor, "F E 3"]


@dataclass(frozen=True, eq=False)
class RestingPoses:
    """F resting poses; float64. A resting frame has the floor as z = 0 and the object's origin above its own.

    Attributes:
        turn: (F, 3, 3), rotation from the object's frame to the resting frame.
        height_m: (F), of the object's origin.
        centre: (F, 2), below the centre of mass, resting frame.
        spread_m: (F), mean distance of the hull's area from there.
        edges: of the hulls.
    """

    turn: Float[Tensor, "F 3 3"]
    height_m: Float[Tensor, "F"]
    centre: Float[Tensor, "F 2"]
    spread_m: Float[Tensor, "F"]
    edges: Edges

    def __len__(self) -> int:
        """Number of resting poses."""
        return len(self.turn)

    @classmethod
    def of(cls, sdf: SDF, ways: Float[Tensor, "R 4 4"], symmetries: Symmetries | None = None) -> Self:
        """Those that an object of even density comes to by toppling from some, which are the first.

        Args:
            sdf: of the object.
            ways: poses above the world's origin in which it rests at first.
            symmetries: rotations after which it looks the same; poses that they map to each other are one.
        """
        inside, surface = _points(sdf)
        mass, rotations = inside.mean(0), torch.eye(3, dtype=torch.float64)[None]
        if symmetries is not None:
            rotations = symmetries.rotations.double()
        turns = [way[:3, :3].double() for way in ways]
        known, edges, at = len(turns), [], 0
        while at < len(turns):
            found = []
            for point, normal, tip in _hull_edges(turns[at], surface, mass):
                rolled = _toppled(turns[at], surface, mass, point, normal)
                if rolled is None:
                    continue
                which = _matching(turns, rolled[:3, :3], rotations)
                if which is None:
                    if len(turns) >= known + _MOST:
                        continue
                    turns.append(rolled[:3, :3])
                    which = len(turns) - 1, 0.0
                found.append((point, normal, tip, which[0], torch.tensor([*rolled[:2, 3].tolist(), which[1]])))
            edges.append(found)
            at += 1
        turn = torch.stack(turns)
        heights = torch.stack([-(surface @ one.T)[:, 2].min() for one in turn])
        centres = torch.stack([(one @ mass)[:2] for one in turn])
        spread = [_spread(one, surface, centre) for one, centre in zip(turn, centres, strict=True)]
        return cls(turn, heights, centres, torch.tensor(spread, dtype=torch.float64), _padded(edges))

    def resized(self, factor: float) -> Self:
        """The same shape in another size."""
        edges, lengths = self.edges, self.edges.change.new_tensor((factor, factor, 1.0))
        edges = edges._replace(point=factor * edges.point, change=lengths * edges.change)
        height_m, centre, spread_m = factor * self.height_m, factor * self.centre, factor * self.spread_m
        return replace(self, height_m=height_m, centre=centre, spread_m=spread_m, edges=edges)

    def world_T_object(self, planar: Float[Tensor, "*b 3"], lying: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
        """Poses of objects.

        Args:
            planar: (x, y, yaw).
            lying: resting pose, edge about which it leans (-1 for none), and by what angle.
        """
        rest, edge = lying[..., 0].long(), lying[..., 1].long()
        leans, level = edge.clamp_min(0), (edge < 0)[..., None]
        point = torch.where(level, 0.0, self.edges.point[rest, leans])
        normal = torch.where(level, point.new_tensor((1.0, 0.0)), self.edges.normal[rest, leans])
        angle = torch.where(edge < 0, 0.0, lying[..., 2])
        # rows of turn and place, seen from the edge: along its normal, along itself, and up
        lying_T_object = torch.cat(
            (self.turn[rest], torch.cat((-point, self.height_m[rest][..., None]), -1)[..., None]), -1
        )
        x, y, up = lying_T_object.unbind(-2)
        (nx, ny), cos, sin = normal[..., None, :].unbind(-1), angle.cos()[..., None], angle.sin()[..., None]
        out, along = nx * x + ny * y, nx * y - ny * x
        out, up = cos * out + sin * up, cos * up - sin * out
        x, y = nx * out - ny * along, nx * along + ny * out
        x[..., 3] += point[..., 0]
        y[..., 3] += point[..., 1]
        cos, sin = planar[..., 2:].cos(), planar[..., 2:].sin()
        x, y = cos * x - sin * y, sin * x + cos * y
        x[..., 3] += planar[..., 0]
        y[..., 3] += planar[..., 1]
        last = up.new_tensor((0.0, 0.0, 0.0, 1.0)).expand_as(up)
        return torch.stack((x, y, up, last), -2)


def tilted(
    point: Float[Tensor, "*b 2"], normal: Float[Tensor, "*b 2"], angle: Float[Tensor, "*b"]
) -> Float[Tensor, "*b 4 4"]:
    """Turn about a level edge through a point of the floor, towards its outward normal, radians."""
    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    x, y = normal.unbind(-1)
    rows = (
        (cos + (1.0 - cos) * y * y, (cos - 1.0) * x * y, sin * x),
        ((cos - 1.0) * x * y, cos + (1.0 - cos) * x * x, sin * y),
        (-sin * x, -sin * y, cos),
    )
    turn = torch.stack([torch.stack(row, -1) for row in rows], -2)
    at = torch.cat((point, zero[..., None]), -1)
    return se3.make(turn, at - (turn @ at[..., None])[..., 0])


def _points(sdf: SDF) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "m 3"]]:
    """Even points in an object, and on its surface."""
    low, high = sdf.bounds.double()
    counts = [math.ceil(float(high[k] - low[k]) / _SPACING_M) + 2 for k in range(3)]
    axes = [  # about the middle, so that the shape's symmetries are the lattice's
        0.5 * float(low[k] + high[k]) + _SPACING_M * (torch.arange(counts[k]) - 0.5 * (counts[k] - 1)) for k in range(3)
    ]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).to(sdf.bounds)
    with torch.no_grad():
        found = sdf(nodes)
    near = (found.distance.abs() < 0.9 * _SPACING_M).nonzero()[:, 0]
    slope = found.gradient[near]
    slope = slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    surface = nodes[near] - found.distance[near, None] * slope
    bounds = sdf.bounds
    surface = surface.clamp(bounds[0], bounds[1])
    return nodes[found.distance <= 0].double(), surface.double()


def _hull(points: Float[Tensor, "n 2"]) -> Float[Tensor, "k 2"]:
    """Convex hull, counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted({(round(x, 5), round(y, 5)) for x, y in points.tolist()})
    if len(ordered) < 3:
        return torch.tensor(ordered, dtype=torch.float64)

    def chain(sequence: list[tuple[float, float]]) -> list[tuple[float, float]]:
        out: list[tuple[float, float]] = []
        for x, y in sequence:
            while len(out) > 1 and (out[-1][0] - out[-2][0]) * (y - out[-2][1]) <= (out[-1][1] - out[-2][1]) * (
                x - out[-2][0]
            ):
                out.pop()
            out.append((x, y))
        return out[:-1]

    return torch.tensor(chain(ordered) + chain(ordered[::-1]), dtype=torch.float64)


def _edges_of(base: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 2"]]:
    """Starts and outward normals of the hull's edges; nearly parallel short ones are left out."""
    hull = _hull(base)
    if len(hull) < 3:
        return hull.new_zeros(0, 2), hull.new_zeros(0, 2)
    way = hull.roll(-1, 0) - hull
    length = way.norm(dim=-1)
    kept = length > _EDGE_M
    way = way[kept] / length[kept, None]
    return hull[kept], torch.stack((way[:, 1], -way[:, 0]), -1)


def _hull_edges(
    turn: Float[Tensor, "3 3"], surface: Float[Tensor, "m 3"], mass: Float[Tensor, "3"]
) -> list[tuple[Tensor, Tensor, float]]:
    """Nearest point, outward normal and tip angle of the edges of a resting pose, one for each direction."""
    placed, middle = surface @ turn.T, turn @ mass
    floor = placed[:, 2].min()
    starts, normals = _edges_of(placed[placed[:, 2] <= floor + _FLOOR_M][:, :2])
    found: list[tuple[Tensor, Tensor, float]] = []
    for start, normal in zip(starts, normals, strict=True):
        off = float((start - middle[:2]) @ normal)
        tip = math.atan2(off, float(middle[2] - floor))
        if any(float(normal @ other) > 0.95 for _, other, _ in found):
            continue
        found.append((middle[:2] + off * normal, normal, max(tip, 0.0)))
    return found


def _toppled(
    turn: Float[Tensor, "3 3"],
    surface: Float[Tensor, "m 3"],
    mass: Float[Tensor, "3"],
    point: Float[Tensor, "2"],
    normal: Float[Tensor, "2"],
) -> Float[Tensor, "4 4"] | None:
    """Pose, above the floor, after an object rolled over an edge until it rests; None where it does not."""
    pose = se3.make(turn, torch.zeros(3, dtype=torch.float64))
    pose[2, 3] = -(surface @ turn.T)[:, 2].min()
    for _ in range(_ROLLS):
        placed = se3.apply(pose, surface)
        along = (placed[:, :2] - point) @ normal
        height = placed[:, 2]
        off = torch.hypot(along, height) > _LEVER_M  # what is not at the edge itself comes down, or is down
        angle = torch.atan2(height[off], along[off]).min()
        pose = tilted(point, normal, angle.clamp_min(0.0)) @ pose
        placed, middle = se3.apply(pose, surface), se3.apply(pose, mass[None])[0]
        pose[2, 3] -= placed[:, 2].min()
        base = placed[placed[:, 2] <= placed[:, 2].min() + _FLOOR_M][:, :2]
        starts, normals = _edges_of(base)
        if not len(starts):
            return None
        off = ((starts - middle[:2]) * normals).sum(-1)
        if float(off.min()) > 0:
            return pose
        worst = int(off.argmin())
        normal = normals[worst]
        point = middle[:2] + off[worst] * normal
    return None


def _matching(
    turns: list[Tensor], turn: Float[Tensor, "3 3"], rotations: Float[Tensor, "K 3 3"]
) -> tuple[int, float] | None:
    """Which known resting pose a rotation is, at what yaw; None if it is new."""
    for index, known in enumerate(turns):
        for rotation in rotations:
            yaw_turn = turn @ rotation @ known.T
            if float(yaw_turn[2, 2]) > math.cos(_SAME_RAD):
                return index, math.atan2(float(yaw_turn[1, 0] - yaw_turn[0, 1]), float(yaw_turn[0, 0] + yaw_turn[1, 1]))
    return None


def _spread(turn: Float[Tensor, "3 3"], surface: Float[Tensor, "m 3"], centre: Float[Tensor, "2"]) -> float:
    """Mean distance of what rests on the floor from below the centre of mass."""
    placed = surface @ turn.T
    base = placed[placed[:, 2] <= placed[:, 2].min() + _FLOOR_M][:, :2]
    return max(float((base - centre).norm(dim=-1).mean()), 1e-3)


def _padded(edges: list[list[tuple[Tensor, Tensor, float, int, Tensor]]]) -> Edges:
    """Edges of all resting poses as tensors."""
    most = max(1, *(len(found) for found in edges)) if edges else 1
    count, kind = len(edges), torch.float64
    point, normal, change = (torch.zeros(count, most, size, dtype=kind) for size in (2, 2, 3))
    tip, following = torch.full((count, most), math.inf, dtype=kind), torch.zeros(count, most, dtype=torch.long)
    for rest, found in enumerate(edges):
        for index, (at, outward, angle, which, moved) in enumerate(found):
            point[rest, index], normal[rest, index], change[rest, index] = at, outward, moved.double()
            tip[rest, index], following[rest, index] = angle, which
    return Edges(point, normal, tip, following, change)
