"""Tabulated signed distances of a triangle mesh."""

import logging
import math
from pathlib import Path

import torch

from sdf.cache import content_key, load_table, save_table
from sdf.grid_sdf import GridSDF
from sdf.lattice import Lattice, lattice_about
from sdf.mesh.fill import Progress, inside_nodes, unsigned_distances
from sdf.mesh.mesh import MeshError, TriangleMesh, check_size, load_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.mesh.walls import thinnest_wall

VERSION = 1
"""Of the tables' contents: raise it when the same mesh gives other numbers."""

SPACING_M = 0.002
"""The widest spacing that is chosen by itself."""

MOST_BYTES = 128 << 20
"""What a table takes at most, unless told otherwise."""

# metres: no finer than this by itself; and of the diagonal: no wider
_FINEST, _STEPS = 0.0005, 1.0 / 50.0
# nodes and faces: a table of more is exact only near the surface, unless told otherwise; and how near, metres
_MANY, _MANY_FACES, _BAND = 8_000_000, 200_000, 0.02

_logger = logging.getLogger(__name__)


def from_mesh(
    source: str | Path | TriangleMesh | MeshSDF,
    *,
    spacing: float | None = None,
    padding: float = 0.02,
    outer: float = 0.25,
    scale: float = 1.0,
    band: float | None = None,
    most_bytes: int = MOST_BYTES,
    cache_dir: str | Path | None = None,
    progress: Progress | None = None,
) -> GridSDF:
    """Tabulate the signed distances of a mesh, float32 on the CPU.

    The mesh may be open, overlapping or badly oriented (`sdf.mesh.repair`, which `sdf.mesh.mesh_report` tells about).

    Args:
        source: a file (.obj, .stl, .ply, .off, .glb), a mesh, or its exact SDF.
        spacing: of the fine part, metres. By default half of the thinnest wall, at most 2 mm and 1/50 of the diagonal
            and at least 0.5 mm, but as wide as the bytes allow.
        padding: metres of fine lattice beyond the mesh.
        outer: metres, at least, of cells 20 mm wide beyond that; 0 for none.
        scale: metres that one unit of the file or mesh is.
        band: metres from the surface within which distances are exact; beyond, they are interpolated between nodes
            four times as far apart: the sign is right, and the error some hundredths of the distance at most. By
            default everywhere in a table of up to 8 million nodes of up to 200 000 faces, else 20 mm.
        most_bytes: that the table may take.
        cache_dir: folder to keep the table in, by the content of the file or mesh; None keeps nothing.
        progress: called with what is being done and how much of it is done, from 0 to 1.

    Raises:
        sdf.mesh.mesh.MeshError: if the mesh cannot be used, or the table would be too large.
    """
    if spacing is not None and not spacing > 0:
        raise ValueError(f"Expected a spacing above 0, got {spacing}")
    if min(padding, outer) < 0 or (band is not None and band < 0):
        raise ValueError(f"Expected padding, outer and band not below 0, got {padding}, {outer} and {band}")
    path = None
    if cache_dir is not None:
        asked = repr((VERSION, spacing, float(padding), float(outer), float(scale), band, most_bytes))
        path = Path(cache_dir) / f"mesh-{content_key(asked, *_content(source))}.npz"
        kept = load_table(path)
        if kept is not None:
            return kept
    if progress is not None:
        progress("mesh", 0.0)
    shape = _shape(source, scale)
    if progress is not None:
        progress("mesh", 1.0)
    table = _build(shape, spacing, (padding, outer), band, most_bytes, progress)
    if path is not None:
        save_table(path, table)
    return table


def choose_spacing(
    shape: MeshSDF, padding: float = 0.02, outer: float = 0.25, *, most_bytes: int = MOST_BYTES
) -> float:
    """The spacing, metres, that a mesh is tabulated with unless it is given."""
    diagonal = shape.mesh.diagonal
    wall = thinnest_wall(shape.repair.surface, diagonal)
    wanted = min(SPACING_M, _STEPS * diagonal, *([] if wall is None else [0.5 * wall]))
    spacing = max(wanted, _FINEST)
    while _bytes(shape, spacing, (padding, outer)) > most_bytes:
        spacing *= 1.05
    if wall is not None and spacing > 0.5 * wall * 1.001:
        _logger.warning(
            "walls of %.2g mm are lost in a table with a node every %.2g mm: give a spacing of %.2g m",
            1e3 * wall,
            1e3 * spacing,
            0.5 * wall,
        )
    return spacing


def _build(
    shape: MeshSDF,
    spacing: float | None,
    margins: tuple[float, float],
    band: float | None,
    most: int,
    progress: Progress | None,
) -> GridSDF:
    if spacing is None:
        check_size(shape.mesh)
        spacing = choose_spacing(shape, *margins, most_bytes=most)
    size = _bytes(shape, spacing, margins)
    if size > most:
        raise MeshError(
            f"Expected a table of at most {most / 2**20:.0f} MiB, a spacing of {spacing:g} m would take "
            f"{size / 2**20:.3g} MiB: widen the spacing, or raise most_bytes; or is the mesh not in metres (scale)?"
        )
    lattice = _lattice(shape, spacing, margins)
    if band is None and (size > 4 * _MANY or len(shape.mesh.faces) > _MANY_FACES):
        band = _BAND
    distance = unsigned_distances(lattice, shape.repair.surface, band, progress)
    inside = inside_nodes(lattice, shape.repair, shape.mesh.bounds, distance, progress)
    distance[inside] *= -1.0
    return GridSDF.on_lattice(torch.from_numpy(distance), lattice, shape.mesh.bounds.float())


def _lattice(shape: MeshSDF, spacing: float, margins: tuple[float, float]) -> Lattice:
    padding, outer = margins
    return lattice_about(shape.mesh.bounds, spacing, padding, outer=outer)


def _bytes(shape: MeshSDF, spacing: float, margins: tuple[float, float]) -> int:
    """What a table takes."""
    return 4 * math.prod(len(axis) for axis in _lattice(shape, spacing, margins).axes)


def _shape(source: str | Path | TriangleMesh | MeshSDF, scale: float) -> MeshSDF:
    if isinstance(source, MeshSDF):
        if scale != 1.0:
            raise ValueError("Expected a scale of 1 with a MeshSDF, which has its size already")
        return source
    if isinstance(source, str | Path):
        return MeshSDF(load_mesh(source, scale=scale))
    return MeshSDF(source.scaled(scale))


def _content(source: str | Path | TriangleMesh | MeshSDF) -> tuple[bytes, ...]:
    """What the table depends on: of a file its bytes, so that it need not be understood to find its table."""
    if isinstance(source, str | Path):
        path = Path(source)
        if not path.is_file():
            load_mesh(path)  # says what is wrong
        return path.suffix.lower().encode(), path.read_bytes()
    mesh = source.mesh if isinstance(source, MeshSDF) else source
    return b"mesh", mesh.vertices.numpy().tobytes(), mesh.faces.numpy().tobytes()
