"""Viewer recordings: a run over its steps and seconds in space, beside its curves, for the viewer Rerun."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from rumi.runs.export import StepEstimate
from rumi.runs.files import whole_file
from rumi.runs.folder import Run
from rumi.viz import style
from rumi.viz.outlines import heaviest
from rumi.viz.primitives import Lines, Points, Shape, rgb, shades
from rumi.viz.task_view import DecisionView, TaskView, planar_entropy
from rumi.viz.viewer_layout import layout
from sdf.extras import optional

_PARTICLES = 60  # that are drawn, the heaviest
_OUTLINES = 20  # of them whose outlines are drawn too
_HEADING_M = 0.03


class ViewerRecording:
    """A run in the viewer's terms, step by step: written to a file, or sent to a viewer while the run goes on.

    Args:
        stream: of Rerun, which says where it all goes.
        view: of the run's task.
    """

    def __init__(self, stream: Any, view: TaskView) -> None:  # noqa: ANN401  (Rerun's)
        self._rerun = optional("rerun", "The viewer")
        self._stream, self._view = stream, view
        self._records: list[Any] = []
        self._planned: set[str] = set()
        stream.log("world", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, shape in view.fixed().items():
            stream.log(f"world/{name}", self._shape(shape), static=True)

    def add(self, record: Any, found: StepEstimate | None) -> None:  # noqa: ANN401  (of the task's own kind)
        """Add a step: what was believed and sensed, and where the step before stood, the decision that led here.

        Args:
            record: of the step.
            found: its pose estimate; None where there is none.
        """
        self._records.append(record)
        if len(self._records) > 1:
            self._stream.set_time("action", sequence=self._records[-2].step)
            self._decision(self._view.decision(self._records))
        self._stream.set_time("action", sequence=record.step)
        if found is not None:
            self._belief(record, found)
        shown = self._view.step(self._records, None if found is None else found.pose)
        self._log("world", shown.scene)
        self._curves(shown.curves)
        for line in shown.remarks:
            self._stream.log("remarks", self._rerun.TextLog(line, level="WARN"))

    def end(self) -> None:
        """Say that no decision follows, and hand over all that is under way."""
        if self._records:
            self._stream.set_time("action", sequence=self._records[-1].step)
            self._decision(None, "Nothing was planned any more.")
        self._stream.flush()
        self._stream.disconnect()

    def _belief(self, record: Any, found: StepEstimate) -> None:  # noqa: ANN401
        """Particles by weight, the best pose, and what the curves show of them."""
        stream, best = self._stream, found.pose.world_T_object
        poses, log_weights = record.poses
        chosen = heaviest(log_weights, _PARTICLES)
        some, share = poses[chosen].double(), (log_weights[chosen] - log_weights.max()).exp().double()
        ahead = torch.stack((some[:, :3, 3], some[:, :3, 3] + _HEADING_M * some[:, :3, 0]), 1)
        particles = Lines(list(ahead.numpy()), shades(style.NLL, 0.2 + 0.8 * share), 0.0012)
        outlines = [line for pose in poses[chosen[-_OUTLINES:]] for line in self._view.outline(pose)]
        self._log("world", {"particles": particles, "outlines": Lines(outlines, rgb(style.QUIET), 0.0012)})
        place = self._rerun.Transform3D(translation=best[:3, 3].numpy(), mat3x3=best[:3, :3].numpy())
        stream.log("world/object", place)
        self._log("world/object", self._view.body())
        self._curves({"entropy/belief": planar_entropy(found.pose), "right/belief": found.pose.probability})

    def _decision(self, decision: DecisionView | None, otherwise: str = "No decision is recorded here.") -> None:
        """The action that was decided on and the rejected ones, and why; or what to say where there is none."""
        if decision is None:
            self._planned = set()
            self._stream.log("world/plan", self._rerun.Clear(recursive=True))
            self._stream.log("why", self._rerun.TextDocument(otherwise))
            return
        for name in self._planned - set(decision.scene):
            self._stream.log(f"world/plan/{name}", self._rerun.Clear(recursive=False))
        self._planned = set(decision.scene)
        self._log("world/plan", decision.scene)
        self._curves(decision.curves)
        self._stream.log("why", self._rerun.TextDocument(decision.words, media_type="text/markdown"))

    def _log(self, at: str, scene: Mapping[str, Shape]) -> None:
        for name, shape in scene.items():
            self._stream.log(f"{at}/{name}", self._shape(shape))

    def _curves(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._stream.log(f"curves/{name}", self._rerun.Scalars(value))

    def _shape(self, shape: Shape) -> Any:  # noqa: ANN401  (Rerun's)
        """A primitive in the viewer's terms."""
        if isinstance(shape, Lines):
            return self._rerun.LineStrips3D(shape.lines, colors=shape.colours, radii=shape.radius_m)
        if isinstance(shape, Points):
            return self._rerun.Points3D(shape.points.numpy(), colors=shape.colours, radii=shape.radius_m)
        return self._rerun.Arrows3D(origins=shape.origins.numpy(), vectors=shape.vectors.numpy(), colors=shape.colour)


def write_recording(run: Run, estimates: Sequence[StepEstimate], view: TaskView, path: Path) -> Path:
    """Write a run as a recording (.rrd), whole or not at all.

    Args:
        run: as `load_run` gives it.
        estimates: of its steps, as `estimates_of` gives them.
        view: of its task.
        path: of the recording.

    Raises:
        ModuleNotFoundError: rerun-sdk is not installed.
    """
    rerun = optional("rerun", "The viewer")
    stream = rerun.RecordingStream("rumi", recording_id=str(run.folder))
    with whole_file(path) as aside:
        stream.save(str(aside), default_blueprint=layout(view))
        known = {one.step: one for one in estimates}
        recording = ViewerRecording(stream, view)
        for record in run.steps:
            recording.add(record, known.get(record.step))
        recording.end()
    return path
