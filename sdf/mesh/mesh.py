"""Triangle meshes, and reading them from a file."""

import contextlib
import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf import se3
from sdf.check import check_shape
from sdf.extras import optional
from sdf.mesh.off import read_off

SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb")
SMALLEST_M, LARGEST_M = 0.003, 5.0
"""Diagonals of the meshes that are taken for what they say."""

_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "metres": 1.0, "kilometres": 1000.0}
# of the diagonal: vertices that agree to this are one; three coordinates of so many bits fit one integer
_MERGE_BITS = 21


class MeshError(ValueError):
    """A mesh that cannot be used: the message says what came, what was expected and what to do."""


@dataclass(frozen=True)
class TriangleMesh:
    """A surface of triangles, in the object's own frame.

    Attributes:
        vertices: (V, 3), metres, float64.
        faces: (F, 3), int64, indices of vertices, counter-clockwise from outside.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]

    def __post_init__(self) -> None:
        check_shape("vertices", self.vertices, "(V, 3)")
        check_shape("faces", self.faces, "(F, 3)")
        object.__setattr__(self, "vertices", self.vertices.detach().double().cpu())
        object.__setattr__(self, "faces", self.faces.detach().long().cpu())
        if len(self.vertices) == 0 or len(self.faces) == 0:
            raise MeshError(f"Expected vertices and faces, got {len(self.vertices)} and {len(self.faces)}")
        bad = int((~torch.isfinite(self.vertices)).any(-1).sum())
        if bad:
            raise MeshError(
                f"Expected finite vertices, got {bad} of {len(self.vertices)} with NaN or infinity: export the mesh "
                "again, or remove them"
            )
        low, high = int(self.faces.min()), int(self.faces.max())
        if low < 0 or high >= len(self.vertices):
            raise MeshError(f"Expected faces of vertices 0 to {len(self.vertices) - 1}, got {low} to {high}")

    @classmethod
    def box(cls, low: Sequence[float], high: Sequence[float]) -> Self:
        """The surface of a box along the axes, between two of its corners (x, y, z)."""
        vertices = torch.tensor(list(itertools.product(*zip(low, high, strict=True))), dtype=torch.float64)
        sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        faces = [face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))]
        return cls(vertices, torch.tensor(faces))

    @property
    def corners(self) -> Float[Tensor, "F 3 3"]:
        """Corner points of each face, metres."""
        return self.vertices[self.faces]

    @property
    def bounds(self) -> Float[Tensor, "2 3"]:
        """Lower and upper corner of what the faces use, metres."""
        used = self.vertices[self.faces.unique()]
        return torch.stack((used.amin(0), used.amax(0)))

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, metres."""
        low, high = self.bounds
        return float((high - low).norm())

    def scaled(self, scale: float) -> Self:
        """The mesh so many times as large."""
        if not scale > 0:
            raise ValueError(f"Expected a scale above 0, got {scale}")
        return replace(self, vertices=self.vertices * scale)

    def moved(self, new_T_old: Float[Tensor, "4 4"]) -> Self:
        """The mesh in another frame."""
        return replace(self, vertices=se3.apply(new_T_old.double().cpu(), self.vertices))


def load_mesh(path: str | Path, *, scale: float = 1.0) -> TriangleMesh:
    """Read a mesh; all its parts together, vertices that lie on each other merged.

    Args:
        path: of a file with one of the endings in `SUFFIXES`.
        scale: metres that one unit of the file is, such as 0.001 for millimetres.

    Raises:
        MeshError: if there is no such file, or no mesh in it.
        ModuleNotFoundError: without trimesh.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(f"Expected a mesh ending in {', '.join(SUFFIXES)}, got {path}")
    if not path.is_file():
        what = "a folder" if path.is_dir() else "no such file"
        raise MeshError(f"Expected a mesh in {path}, got {what}")
    if path.stat().st_size == 0:
        raise MeshError(f"Expected a mesh in {path}, got an empty file")
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise MeshError(f"Cannot read {path}: {error.strerror or error}") from error
    vertices, faces = _read(path)
    try:
        mesh = TriangleMesh(torch.from_numpy(vertices), torch.from_numpy(faces))
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None
    return merged(mesh).scaled(scale)


def check_size(mesh: TriangleMesh, scale: float = 1.0) -> None:
    """Refuse a mesh that is no object of a table-top in metres.

    Args:
        mesh: in metres, as far as is known.
        scale: by which it was read from its file.

    Raises:
        MeshError: with the scale that would make it one.
    """
    size = mesh.diagonal
    if SMALLEST_M <= size <= LARGEST_M:
        return
    fits = [f"{name} ({unit:g})" for name, unit in _UNITS.items() if 0.01 <= unit * size / scale <= 1.0]
    guess = f"it looks as if it were in {' or '.join(fits)}" if fits else "what unit is it in?"
    raise MeshError(
        f"Expected a mesh in metres between {SMALLEST_M:g} and {LARGEST_M:g} m across, got {size:.4g} m: {guess}; "
        "say how many metres a unit is (scale=..., on the command line --scale ...), or give a spacing if it is right"
    )


def merged(mesh: TriangleMesh) -> TriangleMesh:
    """The same surface with vertices that agree to half a millionth of the diagonal made one, unused ones left out.

    Files store a vertex once for each texture or normal that it has; without this their seams look like cuts.
    """
    used, faces = mesh.faces.unique(return_inverse=True)
    vertices = mesh.vertices[used]
    low = vertices.amin(0)
    step = max(float((vertices.amax(0) - low).norm()), 1e-300) / ((1 << _MERGE_BITS) - 1)
    cell = ((vertices - low) / step).round().long()
    key = (cell[:, 0] << (2 * _MERGE_BITS)) | (cell[:, 1] << _MERGE_BITS) | cell[:, 2]
    _, first, which = np.unique(key.numpy(), return_index=True, return_inverse=True)
    return TriangleMesh(vertices[torch.from_numpy(first)], torch.from_numpy(which.reshape(-1))[faces])


def _off(text: str) -> tuple[list[list[float]], list[list[int]]]:
    """Vertices and triangles of an OFF file that stricter readers refuse, such as one that does not begin with OFF.

    Polygons of more corners become fans.
    """
    points, polygons = read_off(text if "OFF" in text.upper() else f"OFF\n{text}")
    faces = []
    for _, numbers in polygons:
        first, *others = map(int, numbers[1 : 1 + int(numbers[0])])
        faces += [[first, a, b] for a, b in itertools.pairwise(others)]
    return [numbers[:3] for _, numbers in points], faces


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of all that is in a file."""
    trimesh = optional("trimesh", "Reading a mesh")
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # it logs what is raised here
    try:
        loaded: Any = trimesh.load(path, process=False, skip_materials=True)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry() if loaded.geometry else None
    except Exception as error:  # whatever its parsers stumble over
        if path.suffix.lower() == ".off":
            with contextlib.suppress(ValueError, IndexError, OverflowError):
                vertices, faces = _off(path.read_text(errors="replace"))
                loaded = trimesh.Trimesh(vertices, faces, process=False)
                return _arrays(loaded, path)
        raise MeshError(f"Expected a mesh in {path}, could not read it as {path.suffix.lower()}: {error}") from error
    return _arrays(loaded, path)


def _arrays(loaded: Any, path: Path) -> tuple[np.ndarray, np.ndarray]:  # noqa: ANN401  (trimesh comes without types)
    """Vertices and triangles of what trimesh gave."""
    vertices = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
    faces = getattr(loaded, "faces", None)
    if faces is None or len(faces) == 0:
        if len(vertices):
            raise MeshError(
                f"Expected a mesh in {path}, got a cloud of {len(vertices)} points without faces: reconstruct its "
                "surface first"
            )
        raise MeshError(f"Expected a mesh in {path}, found no vertices in it: is it what its ending says?")
    return vertices.reshape(-1, 3).copy(), np.array(faces, dtype=np.int64)
