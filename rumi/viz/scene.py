"""Scene from above: the belief, the observations, the information field and the tool's path."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rumi.records import StepRecord
from rumi.runs.memory import memory
from rumi.runs.scene_geometry import SceneGeometry
from rumi.viz import style
from rumi.viz.curves import touched
from rumi.viz.outlines import bounding_box, heaviest, object_outline, object_section, placed
from sensors.semantics import Semantics

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Extent = tuple[float, float, float, float]
"""Left, right, bottom, top, metres."""

REACH_LEVELS = (0.25, 0.5, 0.75, 0.9)
_FAR_M = 1.0  # outside of the workspace, from where on nothing matters
_PARTICLES, _POINTS = 40, 4000  # that are drawn: the heaviest, and of a kind at most


def scene_from_above(
    steps: Sequence[StepRecord],
    geometry: SceneGeometry,
    ax: "Axes",
    *,
    information: Tensor | None = None,
    extent: Extent | None = None,
) -> "Axes":
    """Draw the last of some steps, with the observations and the path of all of them.

    Particles are coloured by weight relative to the heaviest.

    Args:
        steps: of a run, from the first view up to the one to draw.
        geometry: of its scene.
        ax: where to draw.
        information: (V,), nats, on the geometry's workspace; see `information_at`.
        extent: what to show; by default all that matters in these steps.
    """
    last = steps[-1]
    # limits first: labels on lines are placed within them
    left, right, bottom, top = interesting(steps, geometry) if extent is None else extent
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    ax.set_aspect("equal")
    draw_fields(information, geometry, ax)
    draw_observations(steps, ax)
    draw_particles(last, geometry, ax, _PARTICLES)
    if last.truth is not None:
        draw_truth(last, geometry, ax)
    draw_path(steps, geometry, ax)
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.locator_params(nbins=6)
    ax.set_title("first view" if last.control is None else f"action {last.step}" + ", contact" * touched(last))
    known = "" if last.nll is None else f"nll {last.nll:.1f}, "
    expected = round(last.expected_nll, 1) + 0.0  # no minus before 0
    ax.set_title(f"{known}expects {expected:.1f}", loc="right", fontsize=8, fontweight="normal")
    return ax


def information_at(steps: Sequence[StepRecord], step: int) -> Tensor | None:
    """The information field that the choice after a step rested on; None where nothing was chosen any more."""
    following = steps[step + 1].plan if step + 1 < len(steps) else None
    return None if following is None else following.fields.get("information")


def draw_fields(information: Tensor | None, geometry: SceneGeometry, ax: "Axes") -> "Axes":
    """Information as a heat map, reachability as lines."""
    shape, spacing = geometry.workspace.shape, geometry.workspace.spacing
    low, high = geometry.workspace.bounds[:, :2].tolist()
    if information is not None:
        # a planar lattice has one layer; of others the most that any height holds
        values = information.reshape(shape).amax(-1).float().numpy()
        half = 0.5 * spacing
        ax.imshow(
            values.T,
            origin="lower",
            extent=(low[0] - half, high[0] + half, low[1] - half, high[1] + half),
            cmap=style.information_map(),
            vmin=0.0,
            vmax=max(float(values.max()), 1e-9),
            interpolation="bilinear",
            zorder=0,
        )
    if geometry.reachability is not None:
        draw_reach(geometry.reachability.reshape(shape).amax(-1).float().numpy(), low, spacing, ax)
    return ax


def draw_reach(reach: np.ndarray, origin: Sequence[float], spacing: float, ax: "Axes") -> "Axes":
    """Lines of equal reachability (X, Y) within the axis's limits, each with its value."""
    axes = [origin[axis] + spacing * np.arange(reach.shape[axis]) for axis in (0, 1)]
    limits = (ax.get_xlim(), ax.get_ylim())
    x, y = ((low - spacing <= at) & (at <= high + spacing) for at, (low, high) in zip(axes, limits, strict=True))
    part = reach[np.ix_(x, y)]
    if min(part.shape) < 2 or not part.min() < REACH_LEVELS[-1] or not part.max() > REACH_LEVELS[0]:
        return ax
    lines = ax.contour(
        axes[0][x], axes[1][y], part.T, levels=REACH_LEVELS, colors=style.QUIET, linewidths=0.8, zorder=1
    )
    lines.set(linestyle=(0, (1, 1.6)))
    ax.plot([], [], color=style.QUIET, lw=0.8, ls=(0, (1, 1.6)), label="reachability r of the tool's place")
    (left, right), (bottom, top) = limits
    # words near the lower edge, out of the way of what happens, where none is cut off
    wanted, inset = bottom + 0.1 * (top - bottom), 0.03 * (right - left)
    found = [line for group in lines.allsegs for line in group if len(line)]
    places = [line[np.abs(line[:, 1] - wanted).argmin()] for line in found]
    places = [place for place in places if left + inset < place[0] < right - inset]
    ax.clabel(lines, fmt="r = %g", fontsize=7, colors=style.QUIET, inline_spacing=3, manual=places)
    return ax


def draw_observations(steps: Sequence[StepRecord], ax: "Axes") -> "Axes":
    """Surface points dark, free points faint; thinned to what a figure can show."""
    seen = memory(steps)
    for semantics, colour, size, alpha, order, label in (
        (Semantics.FREE, style.FREE, 1.2, 0.35, 0.5, "known to be free"),
        (Semantics.SURFACE, style.SURFACE, 4.0, 0.9, 4, "felt or seen"),
    ):
        every = seen.points[seen.of_class(semantics)][:, :2]
        xy = every[:: max(1, len(every) // _POINTS)].numpy()
        ax.scatter(
            xy[:, 0], xy[:, 1], s=size, color=colour, alpha=alpha, lw=0, zorder=order, rasterized=True, label=label
        )
    return ax


def draw_particles(step: StepRecord, geometry: SceneGeometry, ax: "Axes", count: int) -> "Axes":
    """Outlines of the heaviest particles, coloured by weight relative to the heaviest."""
    from matplotlib.collections import LineCollection

    belief = step.belief
    lines, weights = [], []
    relative = (belief.log_weights - belief.log_weights.max()).exp()
    poses = belief.world_T_object
    for index in heaviest(belief.log_weights, count).tolist():
        outline = object_outline(geometry, poses[index])
        lines += outline
        weights += [float(relative[index])] * len(outline)
    drawn = LineCollection(
        lines, cmap=style.likelihood_map(), norm=_unit(), linewidths=0.7, alpha=0.6, zorder=3, label="particles"
    )
    drawn.set_array(np.array(weights))
    ax.add_collection(drawn, autolim=False)
    return ax


def draw_truth(step: StepRecord, geometry: SceneGeometry, ax: "Axes") -> "Axes":
    """The true outline; black, dashed."""
    assert step.truth is not None
    for index, line in enumerate(object_outline(geometry, step.truth)):
        ax.plot(*line.T, color="white", lw=2.2, alpha=0.6, zorder=4.9)
        ax.plot(*line.T, color=style.TRUTH, lw=1.2, ls=(0, (4, 1.5)), zorder=5, label=None if index else "true outline")
    for line in object_section(geometry, step.truth):
        ax.plot(*line.T, color=style.TRUTH, lw=0.5, alpha=0.6, zorder=4.8)
    return ax


def draw_path(steps: Sequence[StepRecord], geometry: SceneGeometry, ax: "Axes") -> "Axes":
    """Draw the tool's path, its contacts and its present place."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Polygon

    poses = [step.reading.tool_pose for step in steps]
    path = torch.cat(poses)[:, :2, 3].numpy()
    contact = torch.cat([step.reading.in_contact for step in steps]).numpy()
    ends = np.array([pose[-1, :2, 3].numpy() for pose in poses])
    before = [line for pose in poses[:-1] for line in placed(geometry.tool, pose[-1])]
    ax.add_collection(LineCollection(before, colors=style.TOOL, linewidths=0.5, alpha=0.22, zorder=2), autolim=False)
    for line in placed(geometry.tool, poses[-1][-1]):
        ax.add_patch(Polygon(line, fc=style.TOOL, ec="none", alpha=0.18, zorder=6))
        ax.add_patch(Polygon(line, fc="none", ec=style.TOOL, lw=1.2, zorder=6, label="tool"))
    ax.plot(*path.T, color=style.PATH, lw=1.3, alpha=0.9, zorder=7, label="path of the tool", solid_joinstyle="round")
    ax.scatter(*ends.T, s=9, color="white", edgecolor=style.PATH, lw=0.9, zorder=7.5)
    if contact.any():
        ax.scatter(*path[contact].T, s=11, color=style.CONTACT, lw=0, zorder=8, label="in contact")
    return ax


def interesting(steps: Sequence[StepRecord], geometry: SceneGeometry, margin: float = 0.04) -> Extent:
    """The part of the scene that matters in all of these steps: the object, and the tool at their ends.

    An object that was taken away, more than a metre outside of the workspace, is left out.
    """
    lines = []
    low, high = (bound[:2] for bound in geometry.workspace.bounds.double())
    for step in steps:
        poses = step.belief.world_T_object[heaviest(step.belief.log_weights, 10)]
        for pose in (*poses, *(() if step.truth is None else (step.truth,))):
            middle = pose[:2, 3].to(low)
            if bool(((middle > low - _FAR_M) & (middle < high + _FAR_M)).all()):
                lines += object_outline(geometry, pose)
        lines += placed(geometry.tool, step.reading.tool_pose[-1])
    return bounding_box(lines, margin)


def legend_entries(ax: "Axes") -> tuple[list[object], list[str]]:
    """Handles and labels of what is drawn, each once, the particles as a dark line."""
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D

    shown: dict[str, object] = {}
    for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
        if isinstance(handle, LineCollection):
            handle = Line2D([], [], color=style.likelihood_map()(0.75), lw=1.2)
        elif label == "known to be free":
            handle = Line2D([], [], color=style.FREE, marker="o", ms=3.5, lw=0)
        elif label == "felt or seen":
            handle = Line2D([], [], color=style.SURFACE, marker="o", ms=3.5, lw=0)
        shown.setdefault(label, handle)
    return list(shown.values()), list(shown)


def _unit() -> object:
    from matplotlib.colors import Normalize

    return Normalize(0.0, 1.0)
