"""Symmetry detection: rotations and mirrors of an object within a tolerance, found on its surface."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import so3
from sdf.base import SDF
from sdf.mesh.build import from_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.solid import solid
from sdf.surface import sample_triangles
from sdf.symmetry import SAME_RAD, Symmetries, closure

# a turn whose multiples fill the circle evenly and that is part of no finite group
_GOLDEN = math.pi * (3.0 - math.sqrt(5.0))
_DIRECTIONS = 800  # over half a sphere: one within 4 degrees of every axis
_ORDERS, _ORDERS_OF_MAIN_AXES = range(2, 7), range(7, 13)
_SAMPLE, _KEPT, _ITERATIONS = 150, 24, 8
_TILT = 1e-4  # radians, of the differences that the refinement takes
_CHUNK = 1 << 18


class FoundSymmetries(NamedTuple):
    """Symmetries of an object, with the tolerance at which they were detected.

    Attributes:
        symmetries: the rotations.
        mirrors: (M, 3), unit normals of planes through `symmetries.center` that mirror the object to itself; of the
            planes that contain `symmetries.axis` one. A mirror is no rigid motion, so that no pose is mistaken for it.
        worst_m: how far a turned surface point is from the surface at most, metres; 0 where nothing was found.
        tolerance_m: what was allowed.
    """

    symmetries: Symmetries
    mirrors: Float[Tensor, "M 3"]
    worst_m: float
    tolerance_m: float

    def words(self) -> str:
        """For people, one line."""
        count = len(self.mirrors)
        planes = f"; {count} mirror plane{'s' if count != 1 else ''}" if count else ""
        if count and self.symmetries.axis is not None:
            planes = "; mirror planes"
        return f"{self.symmetries.words()}{planes} (within {1e3 * self.tolerance_m:g} mm)"


def find_symmetries(
    sdf: SDF,
    points: Float[Tensor, "S 3"],
    *,
    tolerance_m: float = 0.002,
    center: Float[Tensor, "3"] | None = None,
) -> FoundSymmetries:
    """Rotations about the centre of mass after which every surface point is on the surface again.

    Half and whole-number turns up to a sixth about every axis, up to a twelfth about the axes of inertia, and free
    turns. A feature that no point is on, or that is smaller than the tolerance, is not seen.

    Args:
        sdf: of the object.
        points: (S, 3), evenly over its surface; some thousands, so that small features have some.
        tolerance_m: greatest distance of a turned point from the surface, metres.
        center: (3,); by default the centre of mass.

    Raises:
        ValueError: no points, or a tolerance of 0 or less.
    """
    if len(points) == 0 or not tolerance_m > 0:
        raise ValueError(f"Expected points and a tolerance above 0, got {len(points)} points and {tolerance_m} m")
    body = solid(sdf)
    middle = body.center if center is None else center.double()
    look = _Look(sdf, middle, points.detach().double().cpu(), tolerance_m)
    mains = torch.linalg.eigh(body.inertia).eigenvectors.mT
    lines = torch.cat((mains, _half_sphere(_DIRECTIONS)))
    rotations = torch.eye(3, dtype=torch.float64)[None]
    axis, ball = None, look.all_fit(_even_rotations(32))
    if not ball:
        axis = look.free_axis(lines)
        if axis is not None:
            across = torch.linalg.eigh(axis[:, None] * axis).eigenvectors[:, 0]
            flip = so3.exp(math.pi * across)[None]
            rotations = torch.cat((rotations, flip)) if look.all_fit(flip) else rotations
        else:
            rotations = look.group(lines, mains)
    found = Symmetries(rotations, middle, axis, bool(ball))
    if ball or axis is not None:
        normals = mains[:1] if axis is None else torch.stack((axis, across))
        mirrors = normals[look.worst(_mirror(normals)) <= tolerance_m]
    else:
        mirrors = look.lines(lines, math.pi, -1.0)
    worst = float(look.worst(rotations[1:]).amax()) if len(rotations) > 1 else 0.0
    if axis is not None:
        worst = max(worst, float(look.worst(_multiples(axis)).amax()))
    return FoundSymmetries(found, mirrors, worst, tolerance_m)


def mesh_symmetries(
    shape: MeshSDF, table: SDF | None = None, *, tolerance_m: float = 0.002, points: int = 3000
) -> FoundSymmetries:
    """Symmetries of a mesh, looked up in a table of its distances.

    Args:
        shape: the mesh.
        table: of its distances; None makes one with a node every 80th of the diagonal.
        tolerance_m: greatest distance of a turned point from the surface, metres.
        points: of the surface, that are turned.
    """
    if table is None:
        table = from_mesh(shape, spacing=shape.diagonal / 80.0)
    surface, _ = sample_triangles(shape.repair.surface, points, generator=torch.Generator().manual_seed(0))
    return find_symmetries(table, surface, tolerance_m=tolerance_m)


class _Look:
    """Turns surface points and sees how far from the surface they are."""

    def __init__(self, sdf: SDF, center: Tensor, points: Tensor, tolerance: float) -> None:
        self.sdf, self.center, self.points, self.tolerance = sdf, center, points - center, tolerance
        self.sample = self.points[:: max(1, len(points) // _SAMPLE)]

    def off(self, turns: Float[Tensor, "N 3 3"], points: Float[Tensor, "S 3"]) -> Float[Tensor, "N S"]:
        """Signed distance of turned points, metres."""
        parts = []
        with torch.no_grad():
            for part in turns.split(max(1, _CHUNK // len(points))):
                parts.append(self.sdf.distance((points @ part.mT + self.center).to(self.sdf.bounds)).double().cpu())
        return torch.cat(parts)

    def worst(self, turns: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N"]:
        return self.off(turns, self.points).abs().amax(-1)

    def all_fit(self, turns: Float[Tensor, "N 3 3"]) -> bool:
        # most fail at the first few points
        return bool((self.off(turns, self.sample).abs() <= self.tolerance).all()) and bool(
            (self.worst(turns) <= self.tolerance).all()
        )

    def lines(self, lines: Float[Tensor, "N 3"], angle: float, sign: float = 1.0) -> Float[Tensor, "M 3"]:
        """Lines about which a turn (a mirrored one for a sign of -1) leaves the object as it is, the best first."""
        rough = self.off(sign * so3.exp(angle * lines), self.sample).square().mean(-1)
        best = self._refined(lines[rough.argsort()[:_KEPT]], angle, sign)
        turns = sign * so3.exp(angle * best)
        good = self.worst(turns) <= self.tolerance
        best, turns = best[good], turns[good]
        order = self.off(turns, self.points).square().mean(-1).argsort() if len(best) else torch.arange(0)
        kept: list[Tensor] = []
        for line in best[order]:
            if all(float((line @ other).abs()) < math.cos(SAME_RAD) for other in kept):
                kept.append(line)
        return torch.stack(kept) if kept else lines.new_zeros(0, 3)

    def _refined(self, lines: Float[Tensor, "N 3"], angle: float, sign: float) -> Float[Tensor, "N 3"]:
        """Gauss-Newton in the two directions in which a line can tilt, on some of the points."""
        points = self.points[:: max(1, len(self.points) // (2 * _SAMPLE))]

        def off(at: Tensor) -> Tensor:
            return self.off(sign * so3.exp(angle * at), points)

        now = off(lines)
        for _ in range(_ITERATIONS):
            least = torch.eye(3).to(lines)[lines.abs().argmin(-1)]
            first = torch.nn.functional.normalize(torch.linalg.cross(lines, least), dim=-1)
            across = torch.stack((first, torch.linalg.cross(lines, first)), -2)
            tilted = torch.nn.functional.normalize(lines[:, None] + _TILT * across, dim=-1)
            slopes = (off(tilted.reshape(-1, 3)).unflatten(0, (-1, 2)) - now[:, None]) / _TILT
            normal = slopes @ slopes.mT
            normal = normal + 1e-3 * normal.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-12)[:, None, None] * (
                torch.eye(2).to(normal)
            )
            step = -torch.linalg.solve(normal, (slopes @ now[..., None]))[..., 0].clamp(-0.1, 0.1)
            trial = torch.nn.functional.normalize(lines + (step[:, None] @ across)[:, 0], dim=-1)
            after = off(trial)
            better = after.square().sum(-1) < now.square().sum(-1)
            lines, now = torch.where(better[:, None], trial, lines), torch.where(better[:, None], after, now)
        return lines

    def free_axis(self, lines: Float[Tensor, "N 3"]) -> Float[Tensor, "3"] | None:
        """The axis about which every turn leaves the object as it is, if there is one."""
        for line in self.lines(lines, _GOLDEN):
            if self.all_fit(_multiples(line)):
                return line
        return None

    def group(self, lines: Float[Tensor, "N 3"], mains: Float[Tensor, "3 3"]) -> Float[Tensor, "K 3 3"]:
        """All rotations of the finite group, as far as their products fit too."""
        turns: list[Tensor] = []
        for among, orders in ((lines, _ORDERS), (mains, _ORDERS_OF_MAIN_AXES)):
            for order in orders:
                angle = 2.0 * math.pi / order
                turns += list(so3.exp(angle * self.lines(among, angle)))
        kept: list[Tensor] = []
        group = torch.eye(3, dtype=torch.float64)[None]
        for turn in _by(turns, self.worst(torch.stack(turns)) if turns else ()):
            if float(so3.angle(group.mT @ turn).min()) < SAME_RAD:
                continue
            larger = closure(torch.stack([*kept, turn]))
            if larger is not None and self.all_fit(larger):
                kept.append(turn)
                group = larger
        return group


def _by(turns: Sequence[Tensor], worst: Tensor | Sequence[float]) -> list[Tensor]:
    """Ordered, the best first."""
    return [turns[i] for i in torch.as_tensor(worst).argsort().tolist()]


def _multiples(line: Float[Tensor, "3"]) -> Float[Tensor, "24 3 3"]:
    return so3.exp(torch.arange(1, 25)[:, None] * _GOLDEN % (2.0 * math.pi) * line)


def _mirror(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    return -so3.exp(math.pi * normals)


def _half_sphere(count: int) -> Float[Tensor, "N 3"]:
    """Directions evenly over the upper half of the unit sphere (a Fibonacci spiral)."""
    index = torch.arange(count, dtype=torch.float64)
    height = 1.0 - (index + 0.5) / count
    across, angle = (1.0 - height**2).sqrt(), _GOLDEN * index
    return torch.stack((across * angle.cos(), across * angle.sin(), height), -1)


def _even_rotations(count: int) -> Float[Tensor, "N 3 3"]:
    """Rotations by all angles about directions all over."""
    lines = _half_sphere(count)
    return so3.exp(lines * (_GOLDEN * torch.arange(1, count + 1, dtype=torch.float64) % math.pi)[:, None])
