"""Scene in space: which way up the object may lie, where a view from above does not tell."""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.records import StepRecord
from rumi.runs.scene_geometry import SceneGeometry
from rumi.viz import style
from rumi.viz.outlines import heaviest, placed, upright
from rumi.viz.scene import Extent
from sdf import se3

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d.axes3d import Axes3D  # type: ignore[import-untyped]

BOXES = 12  # particles that are drawn
_POINTS = 400  # of the true surface


def tips(steps: Sequence[StepRecord]) -> bool:
    """Whether a pose that was believed or true in some step is not upright."""
    likely = (step.belief.world_T_object[heaviest(step.belief.log_weights, BOXES)] for step in steps)
    return any(not upright(pose) for poses in likely for pose in poses)


def scene_in_space(step: StepRecord, geometry: SceneGeometry, ax: "Axes3D", extent: Extent) -> "Axes3D":
    """Bounding boxes of the heaviest particles, the true object and the tool at its height, obliquely from above.

    Args:
        step: of a run.
        geometry: of its scene.
        ax: where to draw; with three axes.
        extent: what to show of x and y.
    """
    belief = step.belief
    relative = (belief.log_weights - belief.log_weights.max()).exp()
    colours = style.likelihood_map()
    for index in heaviest(belief.log_weights, BOXES).tolist():
        _edges(ax, belief.world_T_object[index], geometry, color=colours(float(relative[index])), lw=0.8, alpha=0.7)
    if step.truth is not None:
        _edges(ax, step.truth, geometry, color=style.TRUTH, lw=1.2, ls=(0, (4, 1.5)))
        points = geometry.surface_points[:: max(1, len(geometry.surface_points) // _POINTS)]
        ax.scatter(*_moved(step.truth, points).T, s=1.5, color=style.TRUTH, alpha=0.25, lw=0)
    pose = step.reading.tool_pose[-1]
    for line in placed(geometry.tool, pose):
        ax.plot(*line.T, zs=float(pose[2, 3]), color=style.TOOL, lw=1.4)
    left, right, bottom, top = extent
    height = 1.1 * float((geometry.surface_points.amax(0) - geometry.surface_points.amin(0)).norm())
    ax.set(xlim=(left, right), ylim=(bottom, top), zlim=(0.0, height))
    ax.set_box_aspect((right - left, top - bottom, height), zoom=1.1)
    ax.view_init(elev=24.0, azim=-62.0)
    for axis, name in zip((ax.xaxis, ax.yaxis, ax.zaxis), "xyz", strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_major_locator(_ticks())
        axis.set_tick_params(labelsize=6, pad=-3)
        axis.set_label_text(f"{name} [m]", fontsize=7)
        axis.labelpad = -8
    if not ax.get_subplotspec().is_first_col():  # beside the last one there is no room
        ax.set_zlabel("")
    return ax


def _edges(ax: "Axes3D", pose: Float[Tensor, "4 4"], geometry: SceneGeometry, **kind: Any) -> None:  # noqa: ANN401
    """The twelve edges of the object's bounding box at a pose, as one line."""
    low, high = geometry.surface_points.amin(0), geometry.surface_points.amax(0)
    signs = torch.tensor(list(itertools.product((False, True), repeat=3)))
    corners = torch.where(signs, high, low)
    placed_at = _moved(pose, corners)
    gap = np.full((1, 3), np.nan)
    pairs = [(a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b) in (1, 2, 4)]
    ax.plot(*np.concatenate([part for a, b in pairs for part in (placed_at[[a, b]], gap)]).T, **kind)


def _moved(pose: Float[Tensor, "4 4"], points: Float[Tensor, "S 3"]) -> np.ndarray:
    moved: np.ndarray = se3.apply(pose.cpu().double(), points.cpu().double()).numpy()
    return moved


def _ticks() -> Any:  # noqa: ANN401  (of matplotlib)
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(3)
