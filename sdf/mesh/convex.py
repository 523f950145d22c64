"""Convex decomposition of a solid mesh, for a physics engine."""

import importlib.util
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Ge, Interval

from sdf.bounds import Checked
from sdf.cache import content_key, keep_arrays, load_arrays
from sdf.mesh.mesh import MeshError, TriangleMesh
from sdf.mesh.repair import enclosed_volume

VERSION = 2
"""Of what is kept: raise it when the same mesh gives other pieces."""

_MOST_PARTS = 32
_ARRAYS = ("vertices", "faces", "vertex_counts", "face_counts")

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ConvexSettings(Checked):
    """Settings of the convex decomposition.

    Attributes:
        method: "pieces", "hull" for the convex hull of all of it, or "auto": pieces where coacd is installed, else
            the hull with a warning.
        concavity: how far a piece may be from convex, relative to half of the mesh's longest side.
        iterations: of the search for a cut.
        nodes: directions that the search looks at.
    """

    method: Literal["auto", "pieces", "hull"] = "auto"
    concavity: Annotated[float, Interval(ge=0.01, le=1.0)] = 0.05
    iterations: Annotated[int, Ge(60)] = 60
    nodes: Annotated[int, Ge(10)] = 12


def convex_pieces(
    mesh: TriangleMesh, settings: ConvexSettings | None = None, *, cache_dir: str | Path | None = None
) -> tuple[TriangleMesh, ...]:
    """Convex meshes that together are about as large as a closed mesh, and nowhere smaller (CoACD, Wei et al. 2022).

    The same mesh gives the same pieces. Parts that overlap are taken apart each by itself. A part whose faces do not
    fit together (as where openings were closed) is remeshed first, which thickens thin walls by a millimetre or so.

    Args:
        mesh: closed, oriented outward (`MeshSDF.solid`).
        settings: how finely.
        cache_dir: folder to keep the pieces in, by the mesh's content; None keeps nothing. Working them out takes
            some seconds to a minute.

    Raises:
        ModuleNotFoundError: pieces are asked for without coacd, or a hull without scipy.
    """
    settings = settings or ConvexSettings()
    if settings.method == "hull":
        return (hull(mesh),)
    if settings.method == "auto" and importlib.util.find_spec("coacd") is None:
        _logger.warning(
            "coacd is not installed: the object collides as its convex hull, which fills hollows and handles "
            "(pip install coacd)"
        )
        return (hull(mesh),)
    path = None
    if cache_dir is not None:
        asked = repr((VERSION, settings.concavity, settings.iterations, settings.nodes))
        content = mesh.vertices.numpy().tobytes(), mesh.faces.numpy().tobytes()
        path = Path(cache_dir) / f"convex-{content_key(asked, *content)}.npz"
        kept = _load(path)
        if kept is not None:
            return kept
    pieces = tuple(piece for part in _parts(mesh) for piece in _decomposed(part, settings))
    if path is not None:
        _save(path, pieces)
    return pieces


def hull(mesh: TriangleMesh) -> TriangleMesh:
    """The convex hull, oriented outward.

    Raises:
        ModuleNotFoundError: without scipy.
        MeshError: if the mesh is flat.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        found = ConvexHull(mesh.vertices.numpy())
    except QhullError as error:
        raise MeshError(f"Expected a mesh that encloses a volume, got a flat one: {error}") from error
    used, faces = np.unique(found.simplices, return_inverse=True)
    vertices, faces = found.points[used], faces.reshape(-1, 3)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * found.equations[:, :3]).sum(-1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return TriangleMesh(torch.from_numpy(vertices), torch.from_numpy(faces))


def _parts(mesh: TriangleMesh) -> list[TriangleMesh]:
    """The parts of a mesh, of faces with common vertices; all as one where some bound a hollow, or they are many."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = mesh.faces.numpy()
    ends = faces[:, :2].T.reshape(-1), faces[:, 1:].T.reshape(-1)
    graph = coo_matrix((np.ones(len(ends[0]), dtype=bool), ends), shape=(len(mesh.vertices),) * 2)
    label = torch.from_numpy(connected_components(graph, directed=False)[1])[mesh.faces[:, 0]]
    which = label.unique().tolist()
    if len(which) > _MOST_PARTS:
        return [mesh]
    parts = []
    for one in which:
        used, own = mesh.faces[label == one].unique(return_inverse=True)
        parts.append(TriangleMesh(mesh.vertices[used], own))
    return parts if all(enclosed_volume(part.corners) > 0 for part in parts) else [mesh]


def _decomposed(mesh: TriangleMesh, settings: ConvexSettings) -> tuple[TriangleMesh, ...]:
    import coacd

    library: Any = coacd
    library.set_log_level("error")
    parts = library.run_coacd(
        library.Mesh(mesh.vertices.numpy(), mesh.faces.numpy().astype(np.int32)),
        threshold=settings.concavity,
        mcts_iterations=settings.iterations,
        mcts_nodes=settings.nodes,
        seed=0,
    )
    return tuple(
        TriangleMesh(torch.from_numpy(np.asarray(vertices)), torch.from_numpy(np.asarray(faces, dtype=np.int64)))
        for vertices, faces in parts
    )


def _load(path: Path) -> tuple[TriangleMesh, ...] | None:
    arrays = load_arrays(path, _ARRAYS)
    if arrays is None:
        return None
    try:
        vertices, faces = (
            np.split(arrays[name], np.cumsum(arrays[counts])[:-1])
            for name, counts in (("vertices", "vertex_counts"), ("faces", "face_counts"))
        )
        pieces = zip(vertices, faces, strict=True)
        return tuple(TriangleMesh(torch.from_numpy(v), torch.from_numpy(f)) for v, f in pieces)
    except (ValueError, TypeError, RuntimeError) as error:
        _logger.warning("%s holds no convex pieces (%s): working them out again", path, error)
        return None


def _save(path: Path, pieces: tuple[TriangleMesh, ...]) -> None:
    parts = [(piece.vertices.numpy(), piece.faces.numpy()) for piece in pieces]
    vertices, faces = zip(*parts, strict=True)
    keep_arrays(
        path,
        {
            "vertices": np.concatenate(vertices),
            "faces": np.concatenate(faces),
            "vertex_counts": np.array([len(v) for v in vertices]),
            "face_counts": np.array([len(f) for f in faces]),
        },
    )
