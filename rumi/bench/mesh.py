"""A triangle mesh from a file as a table of signed distances; it need not be watertight."""

import itertools
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf.base import SDF
from sdf.grid_sdf import GridSDF

_NEAREST = 10


def read_obj(path: Path) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
    """Vertices, metres, and triangles of a Wavefront file, float64; faces of more corners become fans."""
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            vertices.append([float(x) for x in rest[:3]])
        elif kind == "f":
            corners = [int(corner.partition("/")[0]) - 1 for corner in rest]
            faces += [[corners[0], a, b] for a, b in itertools.pairwise(corners[1:])]
    if not vertices or not faces:
        raise ValueError(f"Expected a mesh with vertices and faces in {path}, got {len(vertices)} and {len(faces)}")
    return torch.tensor(vertices, dtype=torch.float64), torch.tensor(faces)


class MeshDistance(SDF):
    """Distance to the nearest triangle; inside is what cannot be reached from far away.

    Exact to the nearest of the triangles whose middles are near. For filling a table: no gradients.

    Args:
        vertices: (V, 3), metres.
        faces: (F, 3), indices of vertices, counter-clockwise from outside.
        spacing: metres; triangles with longer edges have several middles, of their parts.
    """

    def __init__(self, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], spacing: float = 0.004) -> None:
        from scipy.spatial import cKDTree

        corners = vertices[faces]
        super().__init__(torch.stack((corners.amin((0, 1)), corners.amax((0, 1)))))
        normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        keep = normal.norm(dim=-1) > 1e-12
        self.corners, self.normals = corners[keep], torch.nn.functional.normalize(normal[keep], dim=-1)
        self.samples, self.owner = _samples(self.corners, spacing)
        self.tree = cKDTree(self.samples.numpy())

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Unsigned distance of points, metres."""
        points = points_o.reshape(-1, 3).double()
        _, index = self.tree.query(points.numpy(), k=_NEAREST, workers=torch.get_num_threads())
        result = _to_triangles(points[:, None], self.corners[self.owner[torch.from_numpy(index)]]).amin(-1)
        return result.view(points_o.shape[:-1]).to(points_o)

    def side(self, points_o: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """1 or -1: on which side of the triangles about it a point is, most of them say."""
        _, index = self.tree.query(points_o.numpy(), k=_NEAREST)
        index = torch.from_numpy(index)
        above = ((points_o[:, None] - self.samples[index]) * self.normals[self.owner[index]]).sum(-1)
        return torch.where(above.sum(-1) < 0, -1.0, 1.0)


def mesh_table(path: Path, spacing: float = 0.0025) -> GridSDF:
    """Signed distances of a mesh in a file, float32.

    Nodes further from the surface than half a cell's diagonal are inside if no way of such nodes leads to them from
    outside; the others are on the side that the triangles face.
    """
    from scipy.ndimage import label

    mesh = MeshDistance(*read_obj(path))
    table = GridSDF.from_sdf(mesh, spacing, 0.01, outer=0.06)
    distance = table.values
    axes = [
        torch.tensor([table.origin[k] + _along(i, n, table) for i in range(n)], dtype=torch.float64)
        for k, n in enumerate(distance.shape)
    ]
    clear = distance > 0.87 * spacing
    regions, _ = label(clear.numpy())
    inside = clear & torch.from_numpy(regions != regions[0, 0, 0])
    shell = (~clear).nonzero()
    nodes = torch.stack([axis[shell[:, k]] for k, axis in enumerate(axes)], -1)
    sign = torch.where(inside, -1.0, 1.0).to(distance)
    sign[shell.unbind(-1)] = mesh.side(nodes).to(distance)
    x, y, z = table.origin
    return GridSDF(
        (sign * distance).float(),
        (x, y, z),
        spacing,
        mesh.bounds.float(),
        outer=table.outer,
        outer_spacing=table.outer_spacing,
    )


def _along(i: int, n: int, table: GridSDF) -> float:
    """Where node i of an axis of n is, from the lower corner of the fine part."""
    fine = min(max(i, table.outer), n - 1 - table.outer)
    return (fine - table.outer) * table.spacing + (i - fine) * table.outer_spacing


def _samples(corners: Float[Tensor, "F 3 3"], spacing: float) -> tuple[Float[Tensor, "N 3"], Int[Tensor, "N"]]:
    """Middles of the parts of each triangle, as many as its longest edge needs, and whose they are."""
    longest = (corners - corners.roll(1, 1)).norm(dim=-1).amax(-1)
    parts = torch.ceil(longest / spacing).long().clamp_min(1)
    points, owners = [], []
    for n in parts.unique().tolist():
        which = (parts == n).nonzero()[:, 0]
        i, j = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
        first, second = i[i + j < n] + 1 / 3, j[i + j < n] + 1 / 3
        shares = torch.stack((n - first - second, first, second), -1).double() / n
        points.append(torch.einsum("sk,fkd->fsd", shares, corners[which]).reshape(-1, 3))
        owners.append(which.repeat_interleave(len(shares)))
    return torch.cat(points), torch.cat(owners)


def _to_triangles(points: Float[Tensor, "*#b 3"], corners: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*b"]:
    """Distance of points from triangles: from the plane where the foot is within, else from the nearest edge."""
    edges = corners.roll(-1, -2) - corners
    offset = points[..., None, :] - corners
    share = ((offset * edges).sum(-1) / (edges * edges).sum(-1).clamp_min(1e-30)).clamp(0.0, 1.0)
    to_edges = (offset - share[..., None] * edges).norm(dim=-1).amin(-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(edges[..., 0, :], edges[..., 1, :]), dim=-1)
    within = (torch.linalg.cross(edges, offset) * normal[..., None, :]).sum(-1).amin(-1) >= 0
    height = (offset[..., 0, :] * normal).sum(-1).abs()
    return torch.where(within, height, to_edges)
