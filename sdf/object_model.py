"""Object model: signed distances, surface points, symmetries and size of one object."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.base import SDF
from sdf.grid_sdf import GridSDF
from sdf.mesh.build import from_mesh
from sdf.mesh.fill import Progress
from sdf.mesh.find_symmetry import mesh_symmetries
from sdf.mesh.mesh import TriangleMesh, load_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Mug
from sdf.surface import sample_surface, sample_triangles
from sdf.symmetry import Symmetries


@dataclass(frozen=True)
class MeshSource:
    """Source mesh of an object, and the pose of the object's frame in it.

    Attributes:
        file: name of the file, without its folder.
        sha256: of the file's content.
        faces: number of triangles.
        scale: metres that one unit of the file is.
        object_T_mesh: (4, 4), maps the scaled mesh's points to the object's frame, in which it stands.
        upright: how it was found out which way is up.
    """

    file: str
    sha256: str
    faces: int
    scale: float
    object_T_mesh: Float[Tensor, "4 4"]
    upright: str


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
        source: the mesh file that it came from, if it did.
    """

    name: str
    exact: SDF
    sdf: SDF
    surface_points: Float[Tensor, "S 3"]
    surface_normals: Float[Tensor, "S 3"]
    symmetries: Symmetries
    source: MeshSource | None = None

    @property
    def judge(self) -> SDF:
        """What metrics look up: the exact SDF where that is a formula; a mesh's costs too much to ask at every step.

        The table is off by a few tenths of a millimetre near the surface (`sdf.mesh.build`), where the metrics'
        tolerance is millimetres.
        """
        return self.sdf if isinstance(self.exact, MeshSDF) else self.exact

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


def mesh_model(
    source: str | Path | TriangleMesh | MeshSDF,
    *,
    name: str | None = None,
    spacing: float | None = None,
    points: int = 500,
    seed: int = 0,
    scale: float = 1.0,
    symmetries: Symmetries | None = None,
    cache_dir: Path | None = None,
    progress: Progress | None = None,
) -> ObjectModel:
    """Model of the object that a triangle mesh shows, in the mesh's frame; float32 on the CPU.

    Args:
        source: a file, a mesh, or its exact SDF.
        name: what users call it; by default the file's.
        spacing: of the tabulated SDF, metres; by default from the thinnest wall.
        points: number of surface points.
        seed: of the surface points.
        scale: metres that one unit of the mesh is.
        symmetries: rotations that leave it as it is; by default those that are found on its surface.
        cache_dir: folder to keep the table in; None keeps nothing.
        progress: called with what is done and how much of it, from 0 to 1.

    Raises:
        sdf.mesh.mesh.MeshError: if the mesh cannot be used.
    """
    if isinstance(source, str | Path):
        mesh, name = load_mesh(source, scale=scale), name or Path(source).stem
    else:
        mesh = (source.mesh if isinstance(source, MeshSDF) else source).scaled(scale)
    exact = source if isinstance(source, MeshSDF) and scale == 1.0 else MeshSDF(mesh)
    table = from_mesh(exact, spacing=spacing, cache_dir=cache_dir, progress=progress)
    generator = torch.Generator().manual_seed(seed)
    surface_points, surface_normals = sample_triangles(exact.repair.surface, points, generator=generator)
    if symmetries is None:
        symmetries = mesh_symmetries(exact, table).symmetries
    return ObjectModel(
        name or "mesh",
        exact,
        table,
        surface_points.float(),
        surface_normals.float(),
        symmetries.to(torch.float32),
    )
