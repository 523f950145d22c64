"""Geoms of the objects that are made of solid parts: they slide, turn and tip."""

import math

from rumi.sim.scene import PhysicsSettings, Piece, pieces
from sdf.drill import Drill
from sdf.primitives import Box


def _block(half: tuple[float, ...], z: float) -> Piece:
    size = " ".join(f"{h:.9g}" for h in half)
    return Piece(f'type="box" size="{size}" pos="0 0 {z:.9g}"', 8.0 * math.prod(half), tips=True)


@pieces.register
def _(shape: Box, physics: PhysicsSettings) -> list[Piece]:
    return [_block(shape.half_extents, 0.0)]


@pieces.register
def _(shape: Drill, physics: PhysicsSettings) -> list[Piece]:
    parts = [_block(tuple(0.5 * side for side in shape.base), 0.5 * shape.base[2])]
    for start, end, radius in shape.capsules:
        ends = " ".join(f"{x:.9g}" for x in (*start, *end))
        volume = math.pi * radius**2 * (math.dist(start, end) + 4.0 / 3.0 * radius)
        parts.append(Piece(f'type="capsule" size="{radius:.9g}" fromto="{ends}"', volume, tips=True))
    return parts
