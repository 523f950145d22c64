"""Small meshes, each with its closed form somewhere."""

import pytest
import torch

from sdf.mesh.mesh import TriangleMesh


class Shapes:
    """Makes meshes, oriented outward."""

    @staticmethod
    def box(half=(0.03, 0.04, 0.05), center=(0.0, 0.0, 0.0)):
        """A box of 12 triangles."""
        signs = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=torch.float64)
        vertices = signs * torch.tensor(half, dtype=torch.float64) + torch.tensor(center, dtype=torch.float64)
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
        return TriangleMesh(vertices, torch.tensor(faces))

    @staticmethod
    def sphere(radius=0.04, rings=24):
        """A ball by meridians and parallels."""
        polar = torch.linspace(0, torch.pi, rings + 1, dtype=torch.float64)[1:-1]
        around = torch.arange(2 * rings, dtype=torch.float64) * torch.pi / rings
        grid = torch.stack(torch.meshgrid(polar, around, indexing="ij"), -1)
        ring = torch.stack(
            (grid[..., 0].sin() * grid[..., 1].cos(), grid[..., 0].sin() * grid[..., 1].sin(), grid[..., 0].cos()), -1
        ).reshape(-1, 3)
        vertices = torch.cat((ring, torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)))
        n, north = 2 * rings, len(ring)
        faces = []
        for j in range(n):
            k = (j + 1) % n
            faces += [(north, j, k), (north + 1, (rings - 2) * n + k, (rings - 2) * n + j)]
            for i in range(rings - 2):
                a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + k, i * n + k
                faces += [(a, b, c), (a, c, d)]
        return TriangleMesh(radius * vertices, torch.tensor(faces))

    @staticmethod
    def tetrahedron(side=0.06):
        """A regular one about the origin."""
        vertices = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)
        return TriangleMesh(vertices * side / 8**0.5, torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))

    @staticmethod
    def together(*meshes):
        """All of them in one mesh, nothing merged."""
        starts = torch.tensor([0, *(len(mesh.vertices) for mesh in meshes)]).cumsum(0)
        faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
        return TriangleMesh(torch.cat([mesh.vertices for mesh in meshes]), torch.cat(faces))

    @staticmethod
    def turned(mesh, which=slice(None)):
        """Some of its faces inside out."""
        faces = mesh.faces.clone()
        faces[which] = faces[which].flip(-1)
        return TriangleMesh(mesh.vertices, faces)

    @staticmethod
    def without(mesh, *which):
        """Some of its faces left out."""
        keep = torch.ones(len(mesh.faces), dtype=torch.bool)
        keep[list(which)] = False
        return TriangleMesh(mesh.vertices, mesh.faces[keep])


@pytest.fixture(scope="session")
def shapes():
    """`shapes.box()` and others."""
    return Shapes
