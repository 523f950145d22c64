"""Viewer recordings: a run over its steps and seconds in space, beside its curves, for the viewer Rerun."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.planning.policy import Plan
from rumi.records import StepRecord
from rumi.runs.export import StepEstimate
from rumi.runs.files import whole_file
from rumi.runs.folder import Run
from rumi.runs.memory import memory
from rumi.runs.plain import plain
from rumi.runs.scene_geometry import SceneGeometry
from rumi.viz import style
from rumi.viz.outlines import heaviest, object_outline, placed
from sdf.extras import optional
from sensors.semantics import Semantics

_PARTICLES = 60  # that are drawn, the heaviest
_HEADING_M = 0.03
_POINTS = 5000  # of a class
_WORTH = 0.05  # of the most information, below which a place is not drawn
_CLASSES = {
    "surface": (Semantics.SURFACE, style.SURFACE, 0.002),
    "free": (Semantics.FREE, style.FREE, 0.0006),
    "occupied": (Semantics.OCCUPIED, style.INK, 0.002),
}
CURVES = {
    "nll": "nats",
    "entropy": "nats, of a normal belief over x, y and yaw",
    "right": "P(right), by the belief",
    "fault": "nats for a fault",
}
"""Curves by name, each in a plot of its own."""


class ViewerRecording:
    """A run in the viewer's terms, step by step: written to a file, or sent to a viewer while the run goes on.

    Args:
        stream: of Rerun, which says where it all goes.
        geometry: of the scene; None where the task tells none.
    """

    def __init__(self, stream: Any, geometry: SceneGeometry | None) -> None:  # noqa: ANN401  (Rerun's)
        self._rerun = optional("rerun", "The viewer")
        self._stream, self._geometry = stream, geometry
        self._records: list[StepRecord] = []
        stream.log("world", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def add(self, record: Any, found: StepEstimate | None) -> None:  # noqa: ANN401  (of the task's own kind)
        """Add a step: what was believed and sensed, and where the step before stood, the plan that led here.

        Args:
            record: of the step.
            found: its pose estimate; None where there is none.
        """
        if isinstance(record, StepRecord) and self._records:
            self._stream.set_time("action", sequence=self._records[-1].step)
            self._plan(record.plan)
        self._stream.set_time("action", sequence=record.step)
        if found is not None:
            self._belief(record, found)
        if isinstance(record, StepRecord):
            self._records.append(record)
            self._scene()

    def end(self) -> None:
        """Say that no plan follows, and hand over all that is under way."""
        if self._records:
            self._stream.set_time("action", sequence=self._records[-1].step)
            self._plan(None)
        self._stream.flush()
        self._stream.disconnect()

    def _belief(self, record: Any, found: StepEstimate) -> None:  # noqa: ANN401
        """Particles by weight, the best pose, and what the curves show of them."""
        rerun, stream = self._rerun, self._stream
        poses, log_weights = record.poses
        chosen = heaviest(log_weights, _PARTICLES)
        some, share = poses[chosen].double(), (log_weights[chosen] - log_weights.max()).exp().double()
        ahead = torch.stack((some[:, :3, 3], some[:, :3, 3] + _HEADING_M * some[:, :3, 0]), 1)
        colours = [(11, 65, 139, int(40 + 215 * weight)) for weight in share.tolist()]
        stream.log("world/particles", rerun.LineStrips3D(ahead.numpy(), colors=colours, radii=0.0012))
        best, floor = found.pose.world_T_object, 0.0
        stream.log("world/object", rerun.Transform3D(translation=best[:3, 3].numpy(), mat3x3=best[:3, :3].numpy()))
        if self._geometry is not None:
            points = self._geometry.surface_points.numpy()
            stream.log("world/object/surface", rerun.Points3D(points, colors=_rgb(style.NLL), radii=0.0014))
            lines = [line for pose in poses[chosen[:20]] for line in object_outline(self._geometry, pose)]
            stream.log("world/outlines", _lines(rerun, lines, floor, style.QUIET))
        plane = found.pose.covariance[[0, 1, 5]][:, [0, 1, 5]] + 1e-12 * torch.eye(3, dtype=torch.float64)
        nats = 0.5 * float(torch.logdet(2 * math.pi * math.e * plane))
        for name, value in {"entropy/belief": nats, "right/belief": found.pose.probability}.items():
            stream.log(f"curves/{name}", rerun.Scalars(value))

    def _scene(self) -> None:
        """What was sensed up to the last step, and where the tool went."""
        rerun, stream, records, record = self._rerun, self._stream, self._records, self._records[-1]
        seen = memory(records)
        for name, (kind, colour, radius) in _CLASSES.items():
            points = seen.points[seen.of_class(kind)]
            points = points[:: max(1, len(points) // _POINTS)]
            stream.log(f"world/points/{name}", rerun.Points3D(points.numpy(), colors=_rgb(colour), radii=radius))
        tool = record.reading.tool_pose
        path = torch.cat([one.reading.tool_pose[:, :3, 3] for one in records]).numpy()
        touched = torch.cat([one.reading.in_contact for one in records]).numpy()
        stream.log("world/tool/path", rerun.LineStrips3D([path], colors=_rgb(style.PATH), radii=0.0012))
        stream.log("world/contacts", rerun.Points3D(path[touched], colors=_rgb(style.CONTACT), radii=0.003))
        if self._geometry is not None:
            outline = placed(self._geometry.tool, tool[-1])
            stream.log("world/tool/outline", _lines(rerun, outline, float(tool[-1, 2, 3]), style.TOOL))
        known = {"nll/true": record.nll, "nll/expected": record.expected_nll, "fault/evidence": record.lost}
        for name, value in known.items():
            if value is not None and math.isfinite(value):
                stream.log(f"curves/{name}", rerun.Scalars(value))
        for remark in record.remarks:
            stream.log("remarks", rerun.TextLog(f"{remark.name}: {json.dumps(plain(remark))}", level="WARN"))

    def _plan(self, plan: Plan | None) -> None:
        """The plan that was followed from the last step on, the information that it went for, and its numbers."""
        if plan is None:
            self._stream.log("world/plan", self._rerun.Clear(recursive=True))
            self._stream.log("why", self._rerun.TextDocument("Nothing was planned any more."))
            return
        rerun, stream, tool = self._rerun, self._stream, self._records[-1].reading.tool_pose[-1]
        ahead = plan.path
        heights = ahead[:, 2:3] if ahead.shape[-1] == 4 else tool[2, 3].expand(len(ahead), 1)
        way = torch.cat((ahead[:, :2], heights), -1).float().numpy()
        stream.log("world/plan/path", rerun.LineStrips3D([way], colors=_rgb(style.EXPECTED), radii=0.002))
        if self._geometry is not None and "information" in plan.fields:
            information = _information(rerun, self._geometry, plan.fields["information"])
            stream.log("world/plan/information", information)
        told = [f"- {name}: {_rounded(value)}" for name, value in (plan.info | {"skipped": plan.skipped}).items()]
        stream.log("why", rerun.TextDocument("\n".join(["**The next action**", "", *told]), media_type="text/markdown"))


def write_recording(run: Run, estimates: Sequence[StepEstimate], path: Path) -> Path:
    """Write a run as a recording (.rrd), whole or not at all.

    Args:
        run: as `load_run` gives it.
        estimates: of its steps, as `estimates_of` gives them.
        path: of the recording.

    Raises:
        ModuleNotFoundError: rerun-sdk is not installed.
    """
    rerun = optional("rerun", "The viewer")
    stream = rerun.RecordingStream("rumi", recording_id=str(run.folder))
    with whole_file(path) as aside:
        stream.save(str(aside), default_blueprint=layout(run.geometry))
        known = {one.step: one for one in estimates}
        recording = ViewerRecording(stream, run.geometry)
        for record in run.steps:
            recording.add(record, known.get(record.step))
        recording.end()
    return path


def _information(rerun: Any, geometry: SceneGeometry, field: Float[Tensor, "V"]) -> Any:  # noqa: ANN401
    """The places of most information, the brighter the more."""
    values = field.float() / field.float().max().clamp_min(1e-12)
    kept = values > _WORTH
    colours = [(224, 130, 20, int(255 * value)) for value in values[kept].tolist()]
    return rerun.Points3D(geometry.workspace.points[kept].numpy(), colors=colours, radii=0.002)


def _lines(rerun: Any, lines: list[np.ndarray], z: float, colour: str) -> Any:  # noqa: ANN401
    """Lines (M, 2) at a height."""
    return rerun.LineStrips3D(
        [np.column_stack((line, np.full(len(line), z))) for line in lines], colors=_rgb(colour), radii=0.0012
    )


def layout(geometry: SceneGeometry | None, following: bool = False) -> Any:  # noqa: ANN401
    """The viewer's layout: space at the left, a plot for each curve and words at the right.

    Args:
        geometry: of the scene, at whose middle the view looks; None looks where the viewer likes.
        following: show the newest step, as of a run that goes on, in place of the first.
    """
    blueprint = optional("rerun.blueprint", "The viewer")
    plots = [blueprint.TimeSeriesView(origin=f"curves/{name}", name=f"{name}: {what}") for name, what in CURVES.items()]
    words = [blueprint.TextDocumentView(origin="why", name="why"), blueprint.TextLogView(origin="remarks")]
    eye = None
    if geometry is not None:
        places = geometry.workspace.points
        middle, size = places.mean(0), float((places.amax(0) - places.amin(0)).norm())
        place = middle + size * torch.tensor([-0.3, -0.4, 0.4])
        eye = blueprint.EyeControls3D(position=place.tolist(), look_target=middle.tolist(), eye_up=(0, 0, 1))
    space = blueprint.Spatial3DView(origin="world", name="scene", background=(255, 255, 255), eye_controls=eye)
    right = blueprint.Vertical(*plots, blueprint.Tabs(*words, active_tab=0), row_shares=[2] * len(plots) + [3])
    return blueprint.Blueprint(
        blueprint.Horizontal(space, right, column_shares=[3, 2]),
        blueprint.TimePanel(
            state="collapsed", timeline="action", fps=2.0, play_state="following" if following else "paused"
        ),
        collapse_panels=True,
    )


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _rounded(value: object) -> object:
    """A value with three digits of its numbers."""
    if isinstance(value, float):
        return f"{value:.3g}"
    return ", ".join(str(_rounded(one)) for one in value) if isinstance(value, list | tuple) else value
