"""Shapes that differ from those they were made from: in another size, or worn."""

from functools import singledispatch

from rumi.errors import UsageError
from sdf.base import SDF
from sdf.drill import Drill
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Mug


@singledispatch
def resized(shape: SDF, factor: float) -> SDF:
    """A shape in another size.

    Raises:
        UsageError: of a kind that has none.
    """
    raise UsageError(f"Expected an object that comes in other sizes (a box, a mug, a drill, a mesh), got {shape}")


@resized.register
def _(shape: Box, factor: float) -> SDF:
    return Box([factor * half for half in shape.half_extents])


@resized.register
def _(shape: Mug, factor: float) -> SDF:
    own = (shape.outer_radius, shape.height, shape.wall, shape.base, shape.tube_radius, shape.ring_radius)
    return Mug(*(factor * length for length in own))


@resized.register
def _(shape: Drill, factor: float) -> SDF:
    first, second = shape.capsules[1], shape.capsules[2]
    return Drill(
        tuple(factor * side for side in shape.base),  # type: ignore[arg-type]
        factor * shape.capsules[0][2],
        factor * shape.body_radius,
        factor * (first[1][0] - first[0][0]),
        factor * first[0][2],
        factor * 0.5 * (first[1][0] + first[0][0]),
        factor * second[2],
        factor * (second[1][0] - second[0][0]),
    )


@resized.register
def _(shape: MeshSDF, factor: float) -> SDF:
    return MeshSDF(shape.mesh.scaled(factor))


@singledispatch
def worn(shape: SDF, depth_m: float) -> SDF:
    """A shape whose surface lies deeper by `depth_m` all over, lowered onto the plane that the first stands on.

    A mug's handle goes in with the wall, so that its outermost part lies deeper by twice as much.

    Raises:
        UsageError: of a kind that cannot be worn.
    """
    raise UsageError(f"Expected an object that can be worn (a box, a mug, a drill), got {shape}")


@worn.register
def _(shape: Box, depth_m: float) -> SDF:
    return Box([half - depth_m for half in shape.half_extents])


@worn.register
def _(shape: Mug, depth_m: float) -> SDF:
    return Mug(
        shape.outer_radius - depth_m,
        shape.height - 2.0 * depth_m,
        shape.wall - 2.0 * depth_m,
        shape.base - 2.0 * depth_m,
        shape.tube_radius - depth_m,
        shape.ring_radius,
    )


@worn.register
def _(shape: Drill, depth_m: float) -> SDF:
    first, second = shape.capsules[1], shape.capsules[2]
    return Drill(
        tuple(side - 2.0 * depth_m for side in shape.base),  # type: ignore[arg-type]
        shape.capsules[0][2] - depth_m,
        shape.body_radius - depth_m,
        first[1][0] - first[0][0],
        first[0][2] - depth_m,
        0.5 * (first[1][0] + first[0][0]),
        second[2] - depth_m,
        second[1][0] - second[0][0],
    )
