"""A table of signed distances from a triangle mesh."""

from collections.abc import Callable
from pathlib import Path

from sdf.grid_sdf import GridSDF
from sdf.mesh import TriangleMesh, load_mesh
from sdf.mesh_sdf import MeshSDF

Progress = Callable[[str, float], None]
"""Called with what is being done and how much of it is, from 0 to 1."""


def from_mesh(
    source: str | Path | TriangleMesh | MeshSDF,
    *,
    spacing: float | None = None,
    padding: float = 0.02,
    scale: float = 1.0,
    cache_dir: Path | None = None,
    progress: Progress | None = None,
) -> GridSDF:
    """Tabulate the signed distances of a mesh, float32."""
    if isinstance(source, str | Path):
        source = load_mesh(source)
    shape = source if isinstance(source, MeshSDF) else MeshSDF(source.scaled(scale))
    return GridSDF.from_sdf(shape, spacing or 0.002, padding)
