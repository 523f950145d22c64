"""Bodies of simulated objects: collision geometry, mass and inertia, one entry a kind of shape."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import singledispatch
from itertools import pairwise
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.sim.settings import PhysicsSettings
from sdf import se3
from sdf.base import SDF
from sdf.mesh.convex import ConvexSettings, convex_pieces, hull
from sdf.mesh.mesh import TriangleMesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Capsule, Cup, Cylinder, Mug, Placed, Sphere, TorusArc, Union
from sdf.solid import Solid, solid

_FEET, _FOOT_M, _LOW_M = 12, 0.001, 0.001


@dataclass(frozen=True)
class Piece:
    """One geom of an object.

    Attributes:
        xml: its attributes; of a mesh none.
        volume: m^3, by which the object's mass is shared out; None where pieces overlap or do not fill the shape.
        floor: whether the floor bears it. As few as may be, which makes the contacts few and the steps quick.
        gripper: whether the gripper pushes it.
        seen: whether rays meet it.
        mesh: the triangles, whose convex hull collides and which rays meet as they are.
        object_T_piece: (4, 4), where its frame is.
    """

    xml: str = ""
    volume: float | None = None
    floor: bool = False
    gripper: bool = True
    seen: bool = True
    mesh: TriangleMesh | None = None
    object_T_piece: Float[Tensor, "4 4"] | None = None


@dataclass(frozen=True)
class Body:
    """An object that the simulator can build.

    Attributes:
        pieces: its geoms.
        solid: volume, middle and inertia; None where those of the pieces are right.
        low_m: lowest z of the upright object in its own frame.
    """

    pieces: tuple[Piece, ...]
    solid: Solid | None
    low_m: float


def body_of(shape: SDF, physics: PhysicsSettings, *, table: SDF | None = None, cache_dir: Path | None = None) -> Body:
    """The body of a shape.

    Args:
        shape: exact.
        physics: numbers of geoms.
        table: the same shape tabulated, for the sums over its inside; the shape itself by default.
        cache_dir: folder that keeps convex pieces of meshes; None keeps nothing.

    Raises:
        UsageError: for a kind of shape without an entry; the message lists those that have one.
    """
    parts = tuple(pieces(shape, physics, cache_dir))
    whole = all(part.volume is not None for part in parts)
    return Body(parts, None if whole else solid(shape if table is None else table), float(shape.bounds[0, 2]))


@singledispatch
def pieces(shape: SDF, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    """Geoms that collide as the shape does; one implementation a kind of shape."""
    known = ", ".join(sorted(kind.__name__ for kind in pieces.registry if kind not in (object, SDF)))
    raise UsageError(f"Expected a shape that the simulator can build ({known}), got {type(shape).__name__}")


@pieces.register
def _(shape: Sphere, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    return [Piece(f'type="sphere" size="{shape.radius:.9g}"', 4.0 / 3.0 * math.pi * shape.radius**3, floor=True)]


@pieces.register
def _(shape: Box, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    size = " ".join(f"{half:.9g}" for half in shape.half_extents)
    return [Piece(f'type="box" size="{size}"', 8.0 * math.prod(shape.half_extents), floor=True)]


@pieces.register
def _(shape: Cylinder, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    size = f"{shape.radius:.9g} {shape.half_height:.9g}"
    return [Piece(f'type="cylinder" size="{size}"', 2.0 * math.pi * shape.radius**2 * shape.half_height, floor=True)]


@pieces.register
def _(shape: Capsule, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    long = math.dist(shape.a, shape.b)
    volume = math.pi * shape.radius**2 * (long + 4.0 / 3.0 * shape.radius)
    if long < 1e-9:
        place = " ".join(f"{x:.9g}" for x in shape.a)
        return [Piece(f'type="sphere" size="{shape.radius:.9g}" pos="{place}"', volume, floor=True)]
    return [Piece(f"{_capsule(shape.radius, shape.a, shape.b)}", volume, floor=True)]


@pieces.register
def _(shape: TorusArc, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    x, y, z = shape.center
    return [
        Piece(_capsule(shape.tube_radius, start, end), floor=True)
        for start, end in pairwise(_arc(shape, (x, y, z), physics.handle_capsules))
    ]


@pieces.register
def _(shape: Cup, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    return list(_cup(shape, physics))


@pieces.register
def _(shape: Mug, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    parts = list(_cup(shape, physics))
    for start, end in pairwise(_arc(shape, (shape.outer_radius, 0.0, 0.5 * shape.height), physics.handle_capsules)):
        volume = math.pi * shape.tube_radius**2 * math.dist(start, end)
        parts.append(Piece(_capsule(shape.tube_radius, start, end), volume))
    return parts


@pieces.register
def _(shape: Union, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    """Members may overlap: their volumes do not add up."""
    members = [cast(SDF, member) for member in shape.members]
    return [replace(part, volume=None) for member in members for part in pieces(member, physics, cache_dir)]


@pieces.register
def _(shape: Placed, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    placed = se3.inverse(shape.member_T_object.double())
    parts = []
    for part in pieces(shape.member, physics, cache_dir):
        inner = part.object_T_piece
        parts.append(replace(part, object_T_piece=placed if inner is None else placed @ inner))
    return parts


@pieces.register
def _(shape: MeshSDF, physics: PhysicsSettings, cache_dir: Path | None = None) -> list[Piece]:
    """Rays meet the closed mesh, the gripper its convex pieces, the floor its hull and a few points of its base.

    A physics engine finds three contacts of a hull with the floor at most, close to each other where the base has
    many corners: too few to stand on.
    """
    settings = ConvexSettings(method=physics.collision, concavity=physics.concavity)
    outer = hull(shape.solid)
    feet = [
        Piece(
            f'type="sphere" size="{_FOOT_M}" pos="{x:.9g} {y:.9g} {z + _FOOT_M:.9g}"',
            floor=True,
            gripper=False,
            seen=False,
        )
        for x, y, z in _spread(outer.vertices[outer.vertices[:, 2] < outer.bounds[0, 2] + _LOW_M], _FEET).tolist()
    ]
    parts = convex_pieces(shape.solid, settings, cache_dir=cache_dir)
    return [
        Piece(mesh=shape.solid, gripper=False),
        Piece(mesh=outer, floor=True, gripper=False, seen=False),
        *feet,
        *(Piece(mesh=part, seen=False) for part in parts),
    ]


def _cup(shape: Cup | Mug, physics: PhysicsSettings) -> Iterator[Piece]:
    """A disc for the base and a ring of boxes for the wall."""
    count = physics.wall_boxes
    half = math.pi / count
    # the polygon's sides lie as far inside the circle as its corners lie outside, on average
    apothem = shape.outer_radius * (1.0 - half**2 / 6.0)
    middle, tall = apothem - 0.5 * shape.wall, 0.5 * (shape.height - shape.base)
    wide = apothem * math.tan(half)
    yield Piece(
        f'type="cylinder" size="{shape.outer_radius:.9g} {0.5 * shape.base:.9g}" pos="0 0 {0.5 * shape.base:.9g}"',
        math.pi * shape.outer_radius**2 * shape.base,
        floor=True,
        gripper=False,
    )
    for index in range(count):
        angle = 2.0 * index * half
        yield Piece(
            f'type="box" size="{0.5 * shape.wall:.9g} {wide:.9g} {tall:.9g}" '
            f'pos="{middle * math.cos(angle):.9g} {middle * math.sin(angle):.9g} {shape.base + tall:.9g}" '
            f'euler="0 0 {math.degrees(angle):.9g}"',
            8.0 * 0.5 * shape.wall * wide * tall,
        )


def _arc(shape: TorusArc | Mug, center: tuple[float, float, float], count: int) -> Iterator[tuple[float, float, float]]:
    """Corners of a way along an arc in the plane of constant y."""
    x, y, z = center
    for i in range(count + 1):
        angle = shape.half_angle * (2.0 * i / count - 1.0)
        yield x + shape.ring_radius * math.cos(angle), y, z + shape.ring_radius * math.sin(angle)


def _capsule(radius: float, start: tuple[float, ...], end: tuple[float, ...]) -> str:
    ends = " ".join(f"{x:.9g}" for x in (*start, *end))
    return f'type="capsule" size="{radius:.9g}" fromto="{ends}"'


def _spread(points: Float[Tensor, "N 3"], count: int) -> Float[Tensor, "M 3"]:
    """Some of the points, each as far as possible from those before it; all where they are few."""
    chosen = [int((points - points.mean(0)).norm(dim=-1).argmax())]
    far = (points - points[chosen[0]]).norm(dim=-1)
    while len(chosen) < min(count, len(points)) and float(far.max()) > 0:
        chosen.append(int(far.argmax()))
        far = torch.minimum(far, (points - points[chosen[-1]]).norm(dim=-1))
    return points[chosen]
