"""Layout of a viewer recording: space at the left, curves and words at the right."""

from typing import Any

import torch

from rumi.viz.task_view import TaskView
from sdf.extras import optional

_TOGETHER = ("faults", "fault")  # in tabs of one place


def layout(view: TaskView, following: bool = False) -> Any:  # noqa: ANN401  (Rerun's)
    """The viewer's layout.

    Args:
        view: of the run's task, whose plots it has, and at whose middle it looks.
        following: show the newest step, as of a run that goes on, in place of the first.
    """
    blueprint = optional("rerun.blueprint", "The viewer")
    plots = {
        name: blueprint.TimeSeriesView(origin=f"curves/{name}", name=f"{name}: {what}")
        for name, what in view.plots.items()
    }
    curves = [plot for name, plot in plots.items() if name not in _TOGETHER]
    if tabs := [plots[name] for name in _TOGETHER if name in plots]:
        curves.append(blueprint.Tabs(*tabs, active_tab=0))
    words = [blueprint.TextDocumentView(origin="why", name="why"), blueprint.TextLogView(origin="remarks")]
    eye = None
    if view.bounds is not None:
        middle, size = view.bounds.mean(0), float((view.bounds[1] - view.bounds[0]).norm())
        place = middle + size * torch.tensor([-0.3, -0.4, 0.4])
        eye = blueprint.EyeControls3D(position=place.tolist(), look_target=middle.tolist(), eye_up=(0, 0, 1))
    space = blueprint.Spatial3DView(origin="world", name="scene", background=(255, 255, 255), eye_controls=eye)
    right = blueprint.Vertical(*curves, blueprint.Tabs(*words, active_tab=0), row_shares=[2] * len(curves) + [4])
    return blueprint.Blueprint(
        blueprint.Horizontal(space, right, column_shares=[3, 2]),
        blueprint.TimePanel(
            state="collapsed", timeline="action", fps=2.0, play_state="following" if following else "paused"
        ),
        collapse_panels=True,
    )
