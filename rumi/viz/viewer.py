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
from rumi.viz.reasons import reason_of
from rumi.viz.viewer_layout import layout
from sdf.extras import optional
from sensors.contact_reading import ContactReading
from sensors.reading import FORCE, Reading
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
_REACHED = 0.99  # of r(x), from which on a place counts as within reach
_FORCE_M = 0.01  # that an arrow is long for a newton
_NORMAL_M = 0.02  # the same of a normal


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
        if geometry is not None and geometry.reachability is not None:
            stream.log("world/out_of_reach", _out_of_reach(self._rerun, geometry), static=True)

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
        colours = _shades(style.NLL, 0.2 + 0.8 * share)
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
        self._forces(record.reading)
        known = {"nll/true": record.nll, "nll/expected": record.expected_nll, "fault/evidence": record.lost}
        for name, value in known.items():
            if value is not None and math.isfinite(value):
                stream.log(f"curves/{name}", rerun.Scalars(value))
        for name, share in record.explanations.items():
            stream.log(f"curves/faults/{name.replace(' ', '_')}", rerun.Scalars(share))
        for remark in record.remarks:
            stream.log("remarks", rerun.TextLog(f"{remark.name}: {json.dumps(plain(remark))}", level="WARN"))

    def _forces(self, reading: Reading) -> None:
        """Forces on the tool at each instant, and touches that a wrench told with the normals there."""
        rerun, stream = self._rerun, self._stream
        force = reading.measurements.get(FORCE)
        if force is not None:
            known = force.isfinite().all(-1)
            at, arrows = reading.tool_pose[known][:, :3, 3], _FORCE_M * force[known]
            stream.log(
                "world/wrench/force", rerun.Arrows3D(origins=at.numpy(), vectors=arrows.numpy(), colors=_rgb(style.INK))
            )
        if isinstance(reading, ContactReading):
            touch = reading.wrench
            arrows = rerun.Arrows3D(
                origins=touch.points.numpy(), vectors=_NORMAL_M * touch.normals.numpy(), colors=_rgb(style.CONTACT)
            )
            stream.log("world/wrench/touches", arrows)

    def _plan(self, plan: Plan | None) -> None:
        """The plan that was followed from the last step on, the information that it went for, and its numbers."""
        if plan is None:
            self._stream.log("world/plan", self._rerun.Clear(recursive=True))
            self._stream.log("why", self._rerun.TextDocument("Nothing was planned any more."))
            return
        rerun, stream, tool = self._rerun, self._stream, self._records[-1].reading.tool_pose[-1]
        heights = float(tool[2, 3])
        way = _in_space(plan.path, heights)
        stream.log("world/plan/path", rerun.LineStrips3D([way], colors=_rgb(style.EXPECTED), radii=0.002))
        if plan.samples is not None:
            ways = [_in_space(path, heights) for path in plan.samples.paths]
            samples = rerun.LineStrips3D(ways, colors=_by_cost(plan.samples.costs), radii=0.0006)
            stream.log("world/plan/samples", samples)
        else:
            stream.log("world/plan/samples", rerun.Clear(recursive=False))
        if self._geometry is not None and "information" in plan.fields:
            information = _information(rerun, self._geometry, plan.fields["information"])
            stream.log("world/plan/information", information)
        executed = sum(record.plan is plan for record in self._records)
        reasons = [f"- {line}" for line in reason_of(plan, executed, self._geometry).lines()]
        told = [f"- {name}: {_rounded(value)}" for name, value in (plan.info | {"skipped": plan.skipped}).items()]
        text = "\n".join(["**The next action**", "", *reasons, "", "**The plan's numbers**", "", *told])
        stream.log("why", rerun.TextDocument(text, media_type="text/markdown"))


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
    colours = _shades(style.EXPECTED, values[kept])
    return rerun.Points3D(geometry.workspace.points[kept].numpy(), colors=colours, radii=0.002)


def _out_of_reach(rerun: Any, geometry: SceneGeometry) -> Any:  # noqa: ANN401
    """The places that the robot does not reach, or only in part."""
    reach = geometry.reachability
    assert reach is not None
    beyond = reach < _REACHED
    colours = _shades(style.CONTACT, 0.35 * (1 - reach[beyond].clamp(0, 1)))
    return rerun.Points3D(geometry.workspace.points[beyond].numpy(), colors=colours, radii=0.0015)


def _in_space(path: Float[Tensor, "T Q"], z: float) -> np.ndarray:
    """Places (T, 3) of a path: of a tool that moves in the plane at a height."""
    heights = path[:, 2:3] if path.shape[-1] == 4 else path.new_full((len(path), 1), z)
    return torch.cat((path[:, :2], heights), -1).float().numpy()


def _by_cost(costs: Float[Tensor, "K"]) -> list[tuple[int, ...]]:
    """Colours of rejected samples, the fainter the more they cost."""
    beyond = (costs - costs.min()) / (costs.max() - costs.min()).clamp_min(1e-12)
    return _shades(style.INK, 0.6 - 0.45 * beyond)


def _shades(colour: str, strength: Float[Tensor, "N"]) -> list[tuple[int, ...]]:
    """Colours from white (0) to the colour itself (1): the viewer does not blend what is see-through."""
    full = torch.tensor(_rgb(colour), dtype=torch.float64)
    mixed = 255 + strength.double()[:, None] * (full - 255)
    return [tuple(int(part) for part in one) for one in mixed.round().tolist()]


def _lines(rerun: Any, lines: list[np.ndarray], z: float, colour: str) -> Any:  # noqa: ANN401
    """Lines (M, 2) at a height."""
    return rerun.LineStrips3D(
        [np.column_stack((line, np.full(len(line), z))) for line in lines], colors=_rgb(colour), radii=0.0012
    )


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _rounded(value: object) -> object:
    """A value with three digits of its numbers."""
    if isinstance(value, float):
        return f"{value:.3g}"
    return ", ".join(str(_rounded(one)) for one in value) if isinstance(value, list | tuple) else value
