"""What a figure needs to know of a scene that no step records: the lattice, the object's outline, the tool's."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.fields.workspace import Workspace
from sdf.object_model import ObjectModel
from sdf.symmetry import Symmetries

_MARGIN = 0.012  # metres around a shape, so that its outline closes inside the map
_SPACING = 0.0015  # metres; well under what a figure shows
_LAYERS = 24
_BAND = 4  # cells beside the border that tell where it is, to .04 mm
_CLOSING = 0.004  # metres; dents narrower than twice this are closed in the outline of points
_AT_ONCE = 512  # points whose distances to all others are kept


@dataclass(frozen=True, eq=False)
class OutlineMap:
    """A map over x and y that is negative inside a shape: its zero line is the outline.

    Attributes:
        values: (X, Y), metres.
        origin: (2,), x and y of the first value, in the shape's own frame.
        spacing: metres between neighbours.
    """

    values: Float[Tensor, "X Y"]
    origin: Float[Tensor, "2"]
    spacing: float


@dataclass(frozen=True)
class SceneGeometry:
    """A scene as figures and viewers need it; it holds no truth.

    Attributes:
        workspace: the lattice on which a plan's fields live.
        surface_points: (S, 3), of the object, object frame, metres.
        silhouette: the object from above.
        section: the object cut at the workspace's height.
        tool: the tool from above.
        reachability: (V,), r(x) of the workspace's points, None where nothing limits the tool.
        thresholds: lines to draw beside a curve, by the name of the curve.
        symmetries: of the object; None where they are not known.
        tolerance: of a pose that counts as right, by `PoseBelief.summary`'s names for it; empty for that one's own.
    """

    workspace: Workspace
    surface_points: Float[Tensor, "S 3"]
    silhouette: OutlineMap
    section: OutlineMap
    tool: OutlineMap
    reachability: Float[Tensor, "V"] | None = None
    thresholds: dict[str, float] = field(default_factory=dict)
    symmetries: Symmetries | None = None
    tolerance: dict[str, float] = field(default_factory=dict)


def make_geometry(
    model: ObjectModel,
    workspace: Workspace,
    tool_points: Float[Tensor, "H 3"],
    *,
    height_m: float,
    reachability: Float[Tensor, "V"] | None = None,
    thresholds: dict[str, float] | None = None,
    tolerance: dict[str, float] | None = None,
) -> SceneGeometry:
    """The geometry of a scene.

    Args:
        model: the object.
        workspace: the lattice of the fields.
        tool_points: (H, 3), points that fill the tool's body about evenly, tool frame.
        height_m: z of the object's origin in the world, to know where the workspace cuts it.
        reachability: (V,), r(x) of the workspace's points.
        thresholds: lines to draw beside a curve, by the name of the curve.
        tolerance: of a pose that counts as right.
    """
    bounds = model.exact.bounds
    xy, origin = _raster(bounds[:, :2])

    def layer(z: Tensor) -> Tensor:
        return model.exact.distance(torch.cat((xy, z.to(xy).expand(*xy.shape[:-1], 1)), -1))

    with torch.no_grad():
        heights = torch.linspace(float(bounds[0, 2]), float(bounds[1, 2]), _LAYERS)
        silhouette = torch.stack([layer(z) for z in heights]).amin(0)
        section = layer(workspace.origin[2] - height_m)
    return SceneGeometry(
        workspace,
        model.surface_points,
        OutlineMap(silhouette, origin, _SPACING),
        OutlineMap(section, origin, _SPACING),
        outline_of_points(tool_points),
        reachability,
        dict(thresholds or {}),
        model.symmetries,
        dict(tolerance or {}),
    )


def outline_of_points(points: Float[Tensor, "H 3"]) -> OutlineMap:
    """Outline from above of the shape that points fill about evenly, narrow dents closed.

    Grown until the points touch each other, then shrunk by as much, so that the shape keeps its size.
    """
    flat = points[:, :2].double()
    # points above each other are one point here
    spread = float(_least(flat, flat, lambda apart: torch.where(apart > 1e-6, apart, torch.inf)).max())
    spread = spread if len(flat) > 1 else 0.0
    grown = max(0.9 * spread, _CLOSING)
    xy, origin = _raster(torch.stack((flat.amin(0) - grown, flat.amax(0) + grown)))
    cells = xy.reshape(-1, 2)
    beyond = _least(cells, flat) - grown
    # way to the grown shape's border: from inside past it to a cell outside, less that cell's own way back
    inside, near = beyond <= 0, (beyond > 0) & (beyond <= _BAND * _SPACING)
    back = beyond[near]
    depth = -beyond
    depth[inside] = _least(cells[inside], cells[near], lambda apart: apart - back)
    return OutlineMap((grown - depth).reshape(xy.shape[:-1]).float(), origin.float(), _SPACING)


def _least(
    points: Float[Tensor, "N 2"], others: Float[Tensor, "M 2"], of: Callable[[Tensor], Tensor] = lambda apart: apart
) -> Float[Tensor, "N"]:
    """Least of what is made of each point's distances to the others, few points at a time, for the memory's sake."""
    return torch.cat([of(torch.cdist(some, others)).amin(-1) for some in points.split(_AT_ONCE)])


def _raster(bounds: Float[Tensor, "2 2"]) -> tuple[Float[Tensor, "X Y 2"], Float[Tensor, "2"]]:
    """Points of a map that holds a box with some margin, and the first of them."""
    low, high = bounds[0] - _MARGIN, bounds[1] + _MARGIN
    axes = [torch.arange(float(low[axis]), float(high[axis]) + _SPACING, _SPACING).to(bounds) for axis in (0, 1)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1), low
