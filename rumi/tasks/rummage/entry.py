"""The rummaging scenes as members of the tasks' table."""

import contextlib
import gc
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rumi.agent import Parts
from rumi.columns import folded
from rumi.errors import UsageError
from rumi.records import RunResult, StepRecord
from rumi.registration.pose_summary import PoseSummary, answer_lines
from rumi.runs.folder import Run, RunRecorder, write_json
from rumi.runs.logbook import LOG, LogRecorder
from rumi.runs.progress import say, stages
from rumi.runs.provenance import provenance
from rumi.seeding import check_seed
from rumi.task import Task
from rumi.tasks.registry import Role
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.idle_errors import check_errors
from rumi.tasks.rummage.objects import record
from rumi.tasks.rummage.raw_streams import RawStreams
from rumi.tasks.rummage.scene_spec import TaskSpec
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import PRESETS, Settings, from_dict, preset, to_dict
from rumi.viz.rummaging_view import RummagingView

ON_A_GPU = (
    "plans are made on the GPU, the belief is followed on the CPU; a planning pass took 12 to 16 ms on an NVIDIA H200, "
    "40 to 115 ms on one core beside it"
)
"""What holds of `--device cuda` where plans are made by rollouts."""

ON_THE_CPU = "the next touch is chosen and the belief followed on the CPU, so that a GPU has nothing to do"
"""What holds of it where the next touch is chosen."""

_SUSPICIOUS = 2.0  # nats of evidence of a fault from which on the progress line has them


class Rummaging:
    """What tasks share whose steps are `StepRecord`s: words, the pose, figures and the view."""

    records = ()

    def describe(self, step: StepRecord) -> str:
        """The numbers of a step that tell how it goes."""
        known = "" if step.nll is None else f"nll {step.nll:.1f}  "
        apc = "-" if math.isnan(step.apc) else f"{1e3 * step.apc:.1f} mm"
        marks = {
            "contact": step.control is not None and bool(step.reading.in_contact.any()),
            "sure": step.converged,
        }
        if step.lost > _SUSPICIOUS:
            marks[f"lost {step.lost:.1f}"] = True
        marks |= {f"{remark.name}!": True for remark in step.remarks}
        said = "".join(f"  {word}" for word, holds in marks.items() if holds)
        return f"{known}expects {step.expected_nll:.1f}  apc {apc}  ess {step.ess:.0f}{said}"

    def pose(self, run: Run) -> PoseSummary | None:
        """What a run's last belief knows of the object's pose; None of a run without a whole step."""
        if run.result is not None and run.result.pose is not None:
            return run.result.pose
        if not run.steps:
            return None
        tolerance = {} if run.geometry is None else run.geometry.tolerance
        return run.steps[-1].belief.summary(None if run.geometry is None else run.geometry.symmetries, **tolerance)

    def draw(self, run: Run, out: Path, steps: Sequence[int] | None = None) -> Sequence[Path]:
        """Overview, scenes and animation."""
        from rumi.viz.figures import make_figures

        return make_figures(run, out, steps)

    def view(self, run: Run) -> RummagingView:
        """Points, tool, contacts and the plan with the information that it went for."""
        return RummagingView(run.geometry)


class RummageTask(Rummaging):
    """A scene of the rummaging task: an object to be found, where it stands, and the robot about it.

    Args:
        spec: of the scene.
    """

    settings = Settings
    presets = tuple(PRESETS)

    def __init__(self, spec: TaskSpec) -> None:
        self.spec, self.description = spec, spec.description

    def preset(self, name: str) -> Settings:
        """The settings of a preset."""
        return preset(name, task=self.spec.name)

    def label(self, settings: Settings) -> str:
        """Task, object, method, preset, conditions other than ideal, and seed."""
        own = "" if settings.object.mesh is None else f"-{Path(settings.object.mesh).stem}"
        under = "" if settings.conditions == "ideal" else f"-{settings.conditions}"
        return f"{settings.task}{own}-{settings.method}-{settings.preset}{under}-s{settings.seed}"

    def check(self, settings: Settings) -> Sequence[str]:
        """Refuse more actions than the scene allows, and a device that is not there."""
        check_seed(settings.seed)
        if settings.steps is not None and settings.steps > self.spec.steps:
            raise UsageError(
                f"Expected steps to be at most the {self.spec.steps} of {self.spec.name}, got {settings.steps}"
            )
        check_errors(self.spec, settings)
        _ = settings.torch_device
        if settings.fault:
            from rumi.tasks.rummage.build import faults_of

            faults_of(self.spec, settings)
        notes = []
        if settings.device == "cuda":
            from rumi.tasks.rummage.motions import planned

            touches = settings.method == "rumi" and planned(self.spec, settings).next_touch
            notes.append(ON_THE_CPU if touches else ON_A_GPU)
        if settings.object.mesh is None:
            return notes
        notes += [f"reading {settings.object.mesh} (a minute or two at first; what was worked out is kept)"]
        if settings.simulator.build.scale or settings.simulator.build.worn_m:
            notes.append("a mesh is simulated as it is given: neither its scale nor wear is drawn")
        return notes

    def steps(self, settings: Settings) -> int:
        """Actions at most."""
        return self.spec.steps if settings.steps is None else settings.steps

    def build(self, settings: Settings, *, cache_dir: Path | None = None) -> Parts[Task, Rummager]:
        """The simulated robot and what finds the object."""
        from rumi.tasks.rummage.build import build

        parts = build(settings, cache_dir=cache_dir)
        if settings.plan_budget_s is not None:
            # to look through all that was loaded for garbage takes up to tenths of a second, in the midst of a plan
            gc.freeze()
        return parts

    def recorder(self, folder: Path, settings: Settings, parts: Parts[Any, Rummager], *, log: bool) -> "_Recorder":
        """Writes the run's folder."""
        return _Recorder(folder, settings, parts, log=log)

    def success(self, result: RunResult) -> bool:
        """Whether the belief became sure, and the run was not lost."""
        return result.stopped_by == "sure" and not result.lost

    def summary(self, settings: Settings, result: RunResult) -> Sequence[str]:
        """A few lines on how a run ended."""
        return [*ending(result), f"seconds  {sum(result.timings_s.values()):.1f}: {stages(result.timings_s)}"]

    def role(self, name: str) -> Role:
        """What a setting is to a replay."""
        first = name.partition(".")[0]
        if first in ("task", "conditions", "simulator", "tool_height_m", "fault"):
            return "sensed"
        idle = (
            "method",
            "preset",
            "replan_every",
            "approach_m",
            "retreats",
            "plan_budget_s",
            "planner",
            "slide",
            "gpvr",
        )
        return "idle" if first in idle else "counted"

    def as_dict(self, settings: Settings) -> dict[str, Any]:
        """Settings as settings.json has them."""
        return to_dict(settings)

    def from_dict(self, values: Mapping[str, Any]) -> Settings:
        """The settings of a settings.json."""
        return from_dict(values)

    def agent(self, settings: Settings, *, cache_dir: Path | None = None) -> Rummager:
        """What finds the object; it plans by the simplest means, and believes as the run did."""
        from rumi.tasks.rummage.build import build_rummager
        from rumi.tasks.rummage.motions import followed, predicts_motion, with_eye
        from rumi.tasks.rummage.objects import with_object
        from rumi.tasks.rummage.scenes import make_tool
        from rumi.tasks.rummage.tool_height import at_tool_height

        spec, model = with_object(self.spec, settings.object, cache_dir=cache_dir)
        spec = at_tool_height(spec, model.sdf, model.exact, settings.tool_height_m)
        tool = make_tool(spec, settings.simulator, cache_dir=cache_dir)
        # what plans is not used, and may need packages that are not there; but a motion may be the push model's
        if not predicts_motion(followed(spec, settings)):
            settings = replace(settings, planner=replace(settings.planner, push_model="displacement"))
        settings = replace(settings, method="rumi", filter=with_eye(spec, settings.filter))
        return build_rummager(spec, settings, model, tool)


ENTRIES = {name: RummageTask(spec) for name, spec in (SCENES | DRAWN).items()}
"""The scenes by name."""


class _Recorder(contextlib.ExitStack):
    """Writes the folder of a run; with a log also what its sensors gave, before it was read."""

    def __init__(self, folder: Path, settings: Settings, parts: Parts[Any, Rummager], *, log: bool) -> None:
        from rumi.tasks.rummage.geometry import scene_geometry

        super().__init__()
        about = record(parts.agent.model)
        self._run = self.enter_context(RunRecorder(folder, to_dict(settings), scene_geometry(parts.agent)))
        write_json(folder / "object.json", about)
        self._map, self._object = folder / "map.toml", settings.object
        self._raw: RawStreams | None = getattr(parts.task, "raw", None)
        self._log: LogRecorder | None = None
        if log and self._raw is not None:
            texts = {"object": about, "made_with": provenance()}
            self._log = self.enter_context(LogRecorder(folder / LOG, texts, self._raw.kinds()))
            self._raw.sink = self._log.raw
        elif log:
            say("no camera, no bubbles: there are no raw streams to record; trace.npz holds the readings")

    def __call__(self, step: StepRecord) -> None:
        self._run(step)

    def finish(self, result: RunResult) -> None:
        self._run.finish(result)
        if self._log is not None and self._raw is not None:
            self._log.finish(result)
            self._map.write_text(self._raw.mapping(self._object), encoding="utf-8")


def ending(result: RunResult) -> list[str]:
    """The lines on what a run came to know."""
    ended = {"steps": "not sure", "budget": "out of time"}.get(result.stopped_by, result.stopped_by)
    judged = {True: ", and right", False: f", and wrong ({result.wrong_by})", None: ""}[result.right]
    if result.lost:
        ended = f"lost; {ended}"
    lines = [f"{ended} after {result.steps} actions, {result.contacts} of them in contact{judged}"]
    lines += answer_lines(result.pose, result.why_not, result.warnings)
    for remark in result.remarks:
        lines += folded(f"odd      {remark.name} at action {remark.step}: {remark.sentence}")
    if result.position_error_mm is not None and result.rotation_error_deg is not None:
        lines.append(f"truth    {result.position_error_mm:.1f} mm and {result.rotation_error_deg:.1f} degrees away")
    known = "" if result.final_nll is None else f"{result.final_nll:.1f} at the end, {result.min_nll:.1f} at best; "
    return [*lines, f"nll      {known}the belief expects {result.expected_nll:.1f}"]
