"""One object's shape as every other part sees it."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.base import SDF
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Mug
from sdf.surface import sample_surface
from sdf.symmetry import Symmetries


@dataclass(frozen=True)
class ObjectModel:
    """Shape, surface samples and symmetries of one rigid object, in its own frame; metres.

    Attributes:
        name: what users call it.
        exact: SDF for simulators and metrics.
        sdf: SDF that estimation uses, tabulated (so that estimation is not judged by its own approximation).
        surface_points: (S, 3), uniform by area.
        surface_normals: (S, 3), outward, unit.
        symmetries: rotations that leave the shape as it is.
    """

    name: str
    exact: SDF
    sdf: SDF
    surface_points: Float[Tensor, "S 3"]
    surface_normals: Float[Tensor, "S 3"]
    symmetries: Symmetries

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, metres (RUMI's l_c)."""
        return self.exact.diagonal

    @property
    def radius(self) -> float:
        """Greatest distance of a surface point from the frame's origin, metres."""
        return float(self.surface_points.norm(dim=-1).max())

    def to(self, *targets: torch.device | torch.dtype | str) -> Self:
        """A copy on another device or of another floating dtype; the original stays as it is."""
        model = replace(self, exact=copy.deepcopy(self.exact), sdf=copy.deepcopy(self.sdf))
        for target in targets:
            model = replace(
                model,
                exact=model.exact.to(target),
                sdf=model.sdf.to(target),
                surface_points=model.surface_points.to(target),
                surface_normals=model.surface_normals.to(target),
                symmetries=model.symmetries.to(target),
            )
        return model


def object_model(
    name: str,
    exact: SDF,
    symmetries: Symmetries,
    *,
    spacing: float = 0.002,
    points: int = 500,
    seed: int = 0,
) -> ObjectModel:
    """Model of a shape given by an exact SDF; the same seed gives the same surface points, float32 on the CPU.

    Args:
        name: what users call it.
        exact: its SDF.
        symmetries: rotations that leave it as it is.
        spacing: of the tabulated SDF, metres; at most half of the thinnest wall.
        points: number of surface points.
        seed: of the surface points.
    """
    generator = torch.Generator().manual_seed(seed)
    surface_points, surface_normals = sample_surface(exact, points, generator=generator)
    dtype = exact.bounds.dtype
    return ObjectModel(
        name,
        exact,
        GridSDF.from_sdf(exact, spacing),
        surface_points.to(dtype),
        surface_normals.to(dtype),
        symmetries.to(dtype),
    )


def mug_model(spacing: float = 0.002, points: int = 500, *, mug: Mug | None = None, seed: int = 0) -> ObjectModel:
    """The built-in mug (or another of its kind); its handle leaves it no symmetry."""
    return object_model("mug", mug or Mug(), Symmetries.none(), spacing=spacing, points=points, seed=seed)


def box_model(
    half_extents: Sequence[float] = (0.030, 0.079, 0.105), spacing: float = 0.002, points: int = 500, *, seed: int = 0
) -> ObjectModel:
    """A box with edges of different lengths (a cracker box by default); half a turn about each axis maps it to itself.

    Raises:
        ValueError: if two edges are equally long, since the box has more symmetries then.
    """
    if len({round(h, 9) for h in half_extents}) < 3:
        raise ValueError(f"Expected three different half_extents, got {tuple(half_extents)}: use object_model")
    return object_model("box", Box(half_extents), Symmetries.parse("x2,y2"), spacing=spacing, points=points, seed=seed)
