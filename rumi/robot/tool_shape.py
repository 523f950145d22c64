"""Shape of a tool: what a planner, a filter and free space have to know of it, and tools of any solids."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from sdf.base import SDF
from sdf.primitives import Union

_NEWTON = 8  # steps that bring a point within half a cell onto a surface
_ON_M = 1e-5  # metres from a surface that count as on it


@runtime_checkable
class ToolShape(Protocol):
    """A tool as points of its frame, x forward and z up, about `spacing` metres apart; its pads sense touch.

    A tool in the plane pushes with its section at z = 0.
    """

    def section(self, spacing: float) -> Float[Tensor, "n 2"]:
        """Points of the section at z = 0, borders included."""
        ...

    def pad_section(self, spacing: float) -> Float[Tensor, "n 2"]:
        """Those of them that sense touch."""
        ...

    def outline(self, spacing: float) -> Float[Tensor, "n 2"]:
        """Points on the border of the section."""
        ...

    def solid(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Points of the whole, borders included."""
        ...

    def pad_solid(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Those of them that sense touch."""
        ...

    def surface(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Points on the surface."""
        ...

    def pad_shell(self, spacing: float) -> Float[Tensor, "n 3"]:
        """Those of them that sense touch."""
        ...


class SolidTool:
    """A tool of any solids, such as a stick, a ball or a hand: convex parts, primitives or meshes in the tool frame.

    Points come from a lattice and, by Newton steps along the distance's gradient, from the surface; so an edge is met
    within half of the spacing.

    Args:
        parts: signed distances of the solids (`sdf.primitives`, `sdf.mesh.mesh_sdf.MeshSDF`, `rumi.robot.urdf.Hull`).
        feels: where the tool senses touch: what of it lies in this region is its pads; None for all of it.

    Raises:
        UsageError: the tool does not cross z = 0, or no part of it there feels.
    """

    def __init__(self, parts: Sequence[SDF], feels: SDF | None = None) -> None:
        if not parts:
            raise UsageError("Expected a tool of at least one solid, got none")
        self.body, self.feels = Union(parts), feels
        size = float((self.body.bounds[1] - self.body.bounds[0]).min())
        fine = min(0.005, 0.25 * size)
        if len(self.section(fine)) == 0:
            low, high = self.body.bounds[:, 2].tolist()
            raise UsageError(
                f"Expected a tool that crosses z = 0 of its frame, where it pushes, got {low:g} to {high:g} m: "
                "put the frame's origin where the tool touches"
            )
        if len(self.pad_section(fine)) == 0:
            raise UsageError(
                "Expected the tool to feel somewhere at z = 0 of its frame, got a region without any of it"
            )

    @classmethod
    def of_mesh(
        cls,
        file: str | Path,
        *,
        scale: float = 1.0,
        tool_T_mesh: Float[Tensor, "4 4"] | None = None,
        feels: SDF | None = None,
    ) -> "SolidTool":
        """A tool with the shape of a mesh; needs the extra `mesh`.

        Args:
            file: of the mesh (.obj, .stl, .ply, .off, .glb).
            scale: metres that one unit of the file is.
            tool_T_mesh: from the mesh's frame to the tool's; None where they are one.
            feels: see `SolidTool`.

        Raises:
            UsageError: the mesh cannot be used.
        """
        from sdf.mesh.mesh import MeshError, check_size, load_mesh
        from sdf.mesh.mesh_sdf import MeshSDF

        try:
            mesh = load_mesh(Path(file), scale=scale)
            check_size(mesh, scale)
            made = MeshSDF(mesh)
        except MeshError as error:
            raise UsageError(str(error)) from error
        return cls([made if tool_T_mesh is None else made.moved(tool_T_mesh)], feels)

    def section(self, spacing: float) -> Float[Tensor, "n 2"]:
        """See `ToolShape`."""
        return self._filled(spacing, 2)

    def pad_section(self, spacing: float) -> Float[Tensor, "n 2"]:
        """See `ToolShape`."""
        return self._felt(self.section(spacing))

    def outline(self, spacing: float) -> Float[Tensor, "n 2"]:
        """See `ToolShape`."""
        return self._border(spacing, 2)

    def solid(self, spacing: float) -> Float[Tensor, "n 3"]:
        """See `ToolShape`."""
        return self._filled(spacing, 3)

    def pad_solid(self, spacing: float) -> Float[Tensor, "n 3"]:
        """See `ToolShape`."""
        return self._felt(self.solid(spacing))

    def surface(self, spacing: float) -> Float[Tensor, "n 3"]:
        """See `ToolShape`."""
        return self._border(spacing, 3)

    def pad_shell(self, spacing: float) -> Float[Tensor, "n 3"]:
        """See `ToolShape`."""
        return self._felt(self.surface(spacing))

    def _felt(self, points: Tensor) -> Tensor:
        return points if self.feels is None else points[self.feels.distance(_raised(points)) <= _ON_M]

    def _filled(self, spacing: float, axes: int) -> Tensor:
        nodes = _lattice(self.body.bounds, spacing, axes)
        inside = nodes[self.body.distance(_raised(nodes)) < -0.25 * spacing]
        return torch.cat((inside, self._border(spacing, axes)))

    def _border(self, spacing: float, axes: int) -> Tensor:
        return border_points(self.body, spacing, axes)


def border_points(solid: SDF, spacing: float, axes: int = 3) -> Float[Tensor, "n D"]:
    """Points on a solid's surface, or with two axes on the border of its section at z = 0, float64.

    Lattice nodes next to the surface go onto it by Newton steps; of those that end in one cell, one is kept.

    Args:
        solid: signed distance, whose gradient autograd can have.
        spacing: about that of the points, metres.
        axes: 3, or 2 for the section.
    """
    points = _lattice(solid.bounds, 0.7 * spacing, axes)
    with torch.no_grad():
        points = points[solid.distance(_raised(points)).abs() <= 0.5 * spacing * axes**0.5]
    for _ in range(_NEWTON):
        distance, gradient = solid(_raised(points))
        slope = gradient[:, :axes]
        points = points - (distance / slope.square().sum(-1).clamp_min(1e-4))[:, None] * slope
    points = points[solid.distance(_raised(points)).abs() <= _ON_M].detach()
    cells = (points / (0.7 * spacing)).round().long()
    _, owner = cells.unique(dim=0, return_inverse=True)
    first = owner.new_full((int(owner.max()) + 1 if len(owner) else 0,), len(points))
    return points[first.scatter_reduce(0, owner, torch.arange(len(points)), "amin")]


def _lattice(bounds: Float[Tensor, "2 3"], spacing: float, axes: int) -> Float[Tensor, "n D"]:
    """Nodes over a box and half a cell beyond it, evenly about its middle."""
    low, high = bounds.detach().double().cpu()[:, :axes]
    counts = ((high - low) / spacing).ceil().long() + 2
    lines = [
        0.5 * (a + b) + spacing * (torch.arange(int(n), dtype=torch.float64) - 0.5 * (int(n) - 1))
        for a, b, n in zip(low.tolist(), high.tolist(), counts, strict=True)
    ]
    return torch.stack(torch.meshgrid(*lines, indexing="ij"), -1).reshape(-1, axes)


def _raised(points: Float[Tensor, "n D"]) -> Float[Tensor, "n 3"]:
    """Points of the section at z = 0 in space."""
    return torch.nn.functional.pad(points, (0, 3 - points.shape[-1]))
