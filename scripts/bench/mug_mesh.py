"""Meshes to try things on: a mug whose exact distance is known, and damage to any mesh."""

import itertools
import math
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf.mesh.mesh import TriangleMesh
from sdf.primitives import Mug


def mug_mesh(mug: Mug, pitch: float = 0.003) -> TriangleMesh:
    """A mug as two closed surfaces, a cup and a handle that ends within its wall.

    Args:
        mug: the shape; every vertex lies on the cup's or the handle's surface.
        pitch: edges are about so long, metres.
    """
    radius, inner = mug.outer_radius, mug.outer_radius - mug.wall
    corners = [(0.0, 0.0), (radius, 0.0), (radius, mug.height), (inner, mug.height), (inner, mug.base), (0.0, mug.base)]
    profile = torch.tensor(
        [p for a, b in itertools.pairwise(corners) for p in _between(a, b, pitch)] + [corners[-1]],
        dtype=torch.float64,
    )
    around = _circle(max(12, math.ceil(2 * math.pi * radius / pitch)))
    rings = torch.stack(
        (
            profile[1:-1, None, 0] * around[:, 0],
            profile[1:-1, None, 0] * around[:, 1],
            profile[1:-1, None, 1].expand(-1, len(around)),
        ),
        -1,
    )
    ends = torch.nn.functional.pad(profile[[0, -1], 1:], (2, 0))
    cup, handle = _closed_tube(rings, ends), _handle(mug, pitch)
    return TriangleMesh(
        torch.cat((cup.vertices, handle.vertices)), torch.cat((cup.faces, handle.faces + len(cup.vertices)))
    )


def damaged(mesh: TriangleMesh, *, share: float = 0.01, hole_m: float = 0.012, seed: int = 0) -> TriangleMesh:
    """The mesh without a share of its faces, and without those whose middle is within a ball about a surface point.

    Args:
        mesh: any.
        share: of its faces, drawn at random.
        hole_m: the ball's diameter, metres.
        seed: of the draws.
    """
    random = torch.Generator().manual_seed(seed)
    middle = mesh.corners.mean(-2)
    at = middle[int(torch.randint(len(middle), (), generator=random))]
    keep = (middle - at).norm(dim=-1) > 0.5 * hole_m
    keep &= torch.rand(len(middle), generator=random) >= share
    return TriangleMesh(mesh.vertices, mesh.faces[keep])


def write_obj(mesh: TriangleMesh, path: Path) -> None:
    """Write a mesh as a Wavefront file, metres."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _handle(mug: Mug, pitch: float) -> TriangleMesh:
    """The tube along its arc with half a sphere at each end."""
    steps = max(8, math.ceil(2 * mug.half_angle * mug.ring_radius / pitch))
    caps = max(3, math.ceil(0.5 * math.pi * mug.tube_radius / pitch))
    rows = []  # angle along the arc, way beyond its end, radius there
    for i in range(1, caps):
        turn = 0.5 * math.pi * i / caps
        rows.append((-mug.half_angle, -mug.tube_radius * math.cos(turn), mug.tube_radius * math.sin(turn)))
    rows += [(mug.half_angle * (2 * i / steps - 1), 0.0, mug.tube_radius) for i in range(steps + 1)]
    rows += [(-angle, -beyond, radius) for angle, beyond, radius in reversed(rows[: caps - 1])]
    around = _circle(max(8, math.ceil(2 * math.pi * mug.tube_radius / pitch)))
    center = torch.tensor((mug.outer_radius, 0.0, 0.5 * mug.height), dtype=torch.float64)

    def at(angle: float, beyond: float) -> tuple[Tensor, Tensor]:
        out = torch.tensor((math.cos(angle), 0.0, math.sin(angle)), dtype=torch.float64)
        along = torch.tensor((-math.sin(angle), 0.0, math.cos(angle)), dtype=torch.float64)
        return center + mug.ring_radius * out + beyond * along, out

    side = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
    rings = []
    for angle, beyond, radius in rows:
        middle, out = at(angle, beyond)
        rings.append(middle + radius * (around[:, :1] * side + around[:, 1:] * out))
    ends = torch.stack([at(sign * mug.half_angle, sign * mug.tube_radius)[0] for sign in (-1, 1)])
    return _closed_tube(torch.stack(rings), ends)


def _closed_tube(rings: Float[Tensor, "R n 3"], ends: Float[Tensor, "2 3"]) -> TriangleMesh:
    """Rings joined one to the next, a fan at each end; turned so that the volume is positive."""
    count, n = rings.shape[:2]
    row, column = torch.meshgrid(torch.arange(count - 1), torch.arange(n), indexing="ij")
    a, b = row * n + column, row * n + (column + 1) % n
    sides = torch.cat((torch.stack((a, b, b + n), -1), torch.stack((a, b + n, a + n), -1))).reshape(-1, 3)
    first, last = torch.arange(n), (count - 1) * n + torch.arange(n)
    low = torch.stack((torch.full_like(first, count * n), first.roll(-1), first), -1)
    high = torch.stack((torch.full_like(last, count * n + 1), last, last.roll(-1)), -1)
    faces: Int[Tensor, "F 3"] = torch.cat((sides, low, high))
    vertices = torch.cat((rings.reshape(-1, 3), ends))
    x, y, z = vertices[faces].unbind(-2)
    if float((x * torch.linalg.cross(y, z)).sum()) < 0:
        faces = faces.flip(-1)
    return TriangleMesh(vertices, faces)


def _circle(count: int) -> Float[Tensor, "n 2"]:
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    return torch.stack((angle.cos(), angle.sin()), -1)


def _between(a: tuple[float, float], b: tuple[float, float], pitch: float) -> list[tuple[float, float]]:
    """Points from a to b without b, evenly."""
    count = max(1, math.ceil(math.dist(a, b) / pitch))
    return [(a[0] + (b[0] - a[0]) * i / count, a[1] + (b[1] - a[1]) * i / count) for i in range(count)]
