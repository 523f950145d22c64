"""Geometric primitives of a viewer: polylines, points and arrows in a frame, metres, with their colours."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Colour = tuple[int, ...]
"""Red, green and blue, 0 to 255."""

_CORNERS = 32  # of a circle


@dataclass(frozen=True, eq=False)
class Lines:
    """Polylines.

    Attributes:
        lines: each (M, 3).
        colours: of each, or one for all.
        radius_m: that they are drawn with.
    """

    lines: Sequence[np.ndarray]
    colours: Colour | Sequence[Colour]
    radius_m: float


@dataclass(frozen=True, eq=False)
class Points:
    """Points.

    Attributes:
        points: (N, 3).
        colours: of each, or one for all.
        radius_m: that they are drawn with.
    """

    points: Float[Tensor, "N 3"]
    colours: Colour | Sequence[Colour]
    radius_m: float


@dataclass(frozen=True, eq=False)
class Arrows:
    """Arrows of one colour.

    Attributes:
        origins: (N, 3).
        vectors: (N, 3), from there.
        colour: of all.
    """

    origins: Float[Tensor, "N 3"]
    vectors: Float[Tensor, "N 3"]
    colour: Colour


Shape = Lines | Points | Arrows


def rgb(colour: str) -> Colour:
    """A colour of the house style, such as "#0b5fa5"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def shades(colour: str, strength: Float[Tensor, "N"]) -> list[Colour]:
    """Colours from white (0) to the colour itself (1): the viewer does not blend what is see-through."""
    full = torch.tensor(rgb(colour), dtype=torch.float64)
    mixed = 255 + strength.double()[:, None] * (full - 255)
    return [tuple(int(part) for part in one) for one in mixed.round().tolist()]


def at_height(line: np.ndarray, z: float) -> np.ndarray:
    """A line (M, 2) as one (M, 3) at a height."""
    return np.column_stack((line, np.full(len(line), z)))


def circle(centre: Sequence[float], radius_m: float, z: float) -> np.ndarray:
    """A closed level circle (M, 3)."""
    turn = np.linspace(0.0, 2.0 * math.pi, _CORNERS + 1)
    return at_height(np.column_stack((centre[0] + radius_m * np.cos(turn), centre[1] + radius_m * np.sin(turn))), z)


def block_edges(half: Sequence[float], height_m: float) -> list[np.ndarray]:
    """Edges (M, 3) of a block that stands on its frame's z = 0: base, top and the four between."""
    base = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1)]) * np.asarray(half)
    low, high = at_height(base, 0.0), at_height(base, height_m)
    return [low, high, *(np.stack(pair) for pair in zip(low[:4], high[:4], strict=True))]
