"""Layout of a viewer recording: space at the left, curves and words at the right."""

from typing import Any

import torch

from rumi.runs.scene_geometry import SceneGeometry
from sdf.extras import optional

CURVES = {
    "nll": "nats",
    "entropy": "nats, of a normal belief over x, y and yaw",
    "right": "P(right), by the belief",
    "faults": "probability of each fault",
    "fault": "nats for a fault",
}
"""Curves by name, each in a plot of its own."""

_TOGETHER = ("faults", "fault")  # in tabs of one place


def layout(geometry: SceneGeometry | None, following: bool = False) -> Any:  # noqa: ANN401  (Rerun's)
    """The viewer's layout.

    Args:
        geometry: of the scene, at whose middle the view looks; None looks where the viewer likes.
        following: show the newest step, as of a run that goes on, in place of the first.
    """
    blueprint = optional("rerun.blueprint", "The viewer")
    plots = {
        name: blueprint.TimeSeriesView(origin=f"curves/{name}", name=f"{name}: {what}") for name, what in CURVES.items()
    }
    alone = [plot for name, plot in plots.items() if name not in _TOGETHER]
    faults = blueprint.Tabs(*(plots[name] for name in _TOGETHER), active_tab=0)
    words = [blueprint.TextDocumentView(origin="why", name="why"), blueprint.TextLogView(origin="remarks")]
    eye = None
    if geometry is not None:
        places = geometry.workspace.points
        middle, size = places.mean(0), float((places.amax(0) - places.amin(0)).norm())
        place = middle + size * torch.tensor([-0.3, -0.4, 0.4])
        eye = blueprint.EyeControls3D(position=place.tolist(), look_target=middle.tolist(), eye_up=(0, 0, 1))
    space = blueprint.Spatial3DView(origin="world", name="scene", background=(255, 255, 255), eye_controls=eye)
    shares = [2] * (len(alone) + 1) + [4]
    right = blueprint.Vertical(*alone, faults, blueprint.Tabs(*words, active_tab=0), row_shares=shares)
    return blueprint.Blueprint(
        blueprint.Horizontal(space, right, column_shares=[3, 2]),
        blueprint.TimePanel(
            state="collapsed", timeline="action", fps=2.0, play_state="following" if following else "paused"
        ),
        collapse_panels=True,
    )
