"""Meshes to measure distances with; `mug_mesh.py` has the mug that tasks run with, and damage."""

import math

import numpy as np
import torch

from sdf.mesh.mesh import TriangleMesh, merged
from sdf.primitives import Mug


def box(half_extents: tuple[float, float, float]) -> TriangleMesh:
    """A box of 12 triangles about the origin."""
    corners = torch.cartesian_prod(*(torch.tensor([-h, h], dtype=torch.float64) for h in half_extents))
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return TriangleMesh(corners, torch.tensor([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))]))


def tetrahedron(side: float) -> TriangleMesh:
    """A regular one about the origin."""
    corners = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return TriangleMesh(corners * side / math.sqrt(8.0), faces)


def cup_part(mug: Mug, sections: int = 96) -> TriangleMesh:
    """The mug's cup as drawing programs turn it: faces as long as the cup is tall, and narrow."""
    inner = mug.outer_radius - mug.wall
    profile = [(mug.outer_radius, 0.0), (mug.outer_radius, mug.height), (inner, mug.height), (inner, mug.base)]
    turns = torch.arange(sections, dtype=torch.float64) * (2.0 * math.pi / sections)
    rings = [torch.stack((r * turns.cos(), r * turns.sin(), torch.full_like(turns, z)), -1) for r, z in profile]
    ends = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, mug.base]], dtype=torch.float64)
    return TriangleMesh(torch.cat((*rings, ends)), torch.tensor(_tube(sections, len(rings))))


def _tube(sections: int, rings: int) -> list[tuple[int, int, int]]:
    """Faces of rings one after the other, closed by fans about the last two vertices."""
    first, last = sections * rings, sections * rings + 1
    faces = []
    for j in range(sections):
        k = (j + 1) % sections
        faces += [(first, k, j), (last, (rings - 1) * sections + j, (rings - 1) * sections + k)]
        for i in range(rings - 1):
            a, b = i * sections + j, i * sections + k
            faces += [(a, b, b + sections), (a, b + sections, a + sections)]
    return faces


def parts_of(mesh: TriangleMesh) -> list[TriangleMesh]:
    """The parts of a mesh whose faces share vertices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = mesh.faces.numpy()
    links = (np.ones(2 * len(faces)), (np.repeat(faces[:, 0], 2), faces[:, 1:].reshape(-1)))
    count, label = connected_components(coo_matrix(links, (len(mesh.vertices),) * 2), directed=False)
    which = torch.from_numpy(label[faces[:, 0]])
    found = [
        TriangleMesh(mesh.vertices, mesh.faces[which == number]) for number in range(count) if (which == number).any()
    ]
    return [merged(part) for part in found]


def together(*meshes: TriangleMesh) -> TriangleMesh:
    """All of them as one mesh, parts as they were."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + int(start) for mesh, start in zip(meshes, starts, strict=False)]
    return TriangleMesh(torch.cat([mesh.vertices for mesh in meshes]), torch.cat(faces))


def one_surface(mug: Mug, spacing: float = 0.002) -> TriangleMesh:
    """The mug as one closed surface of many small faces, by marching cubes (libigl's), on the closed form."""
    import igl

    low, high = (mug.bounds.double() + torch.tensor([[-2.5], [2.5]]) * spacing).tolist()
    axes = [torch.arange(a, b, spacing, dtype=torch.float64) for a, b in zip(low, high, strict=True)]
    z, y, x = torch.meshgrid(*reversed(axes), indexing="ij")
    nodes = torch.stack((x, y, z), -1).reshape(-1, 3)
    distance = mug.distance(nodes).numpy()
    vertices, faces, _ = igl.marching_cubes(distance, nodes.numpy(), *(len(axis) for axis in axes), 0.0)
    points = torch.from_numpy(np.asarray(vertices)).double()
    for _ in range(3):
        query = mug(points)
        points = points - query.distance[:, None] * query.gradient
    return merged(TriangleMesh(points, torch.from_numpy(np.asarray(faces)).long()))


def turned(mesh: TriangleMesh, share: float = 1.0, *, generator: torch.Generator) -> TriangleMesh:
    """Some of its faces inside out."""
    which = torch.rand(len(mesh.faces), generator=generator) < share
    return TriangleMesh(mesh.vertices, torch.where(which[:, None], mesh.faces.flip(-1), mesh.faces))
