"""The rummaging scenes as members of the tasks' table."""

import contextlib
import gc
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rumi.agent import Parts
from rumi.errors import UsageError
from rumi.records import RunResult, StepRecord
from rumi.runs.folder import RunRecorder, load_run, provenance, write_json
from rumi.runs.logbook import LOG, LogRecorder
from rumi.runs.progress import stages
from rumi.sim.sensor_settings import SensorSettings
from rumi.task import Task
from rumi.tasks.registry import check_seed
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.objects import record
from rumi.tasks.rummage.scenes import SCENES, TaskSpec
from rumi.tasks.rummage.settings import PRESETS, Settings, preset, to_dict


class RummageTask:
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
        """Task, object, method, preset and seed."""
        own = "" if settings.object.mesh is None else f"-{Path(settings.object.mesh).stem}"
        return f"{settings.task}{own}-{settings.method}-{settings.preset}-s{settings.seed}"

    def check(self, settings: Settings) -> Sequence[str]:
        """Refuse more actions than the scene allows, and a device that is not there."""
        check_seed(settings.seed)
        if settings.steps is not None and settings.steps > self.spec.steps:
            raise UsageError(
                f"Expected steps to be at most the {self.spec.steps} of {self.spec.name}, got {settings.steps}"
            )
        if settings.simulator.sensors.kind == "points" and settings.simulator.sensors != SensorSettings():
            raise UsageError(
                "Expected --simulator.sensors.kind camera, bubbles or both with other settings of the sensors, "
                "got points"
            )
        _ = settings.torch_device
        if settings.object.mesh is None:
            return ()
        return (f"reading {settings.object.mesh} (a minute or two at first; what was worked out is kept)",)

    def steps(self, settings: Settings) -> int:
        """Actions at most."""
        return self.spec.steps if settings.steps is None else settings.steps

    def build(self, settings: Settings, *, cache_dir: Path | None = None) -> Parts[Task, Rummager]:
        """The simulated robot and what finds the object."""
        from rumi.tasks.rummage.build import build

        parts = build(settings, cache_dir=cache_dir)
        if settings.budget_s is not None:
            # to look through all that was loaded for garbage takes up to tenths of a second, in the midst of a plan
            gc.freeze()
        return parts

    def recorder(self, folder: Path, settings: Settings, parts: Parts[Any, Rummager], *, log: bool) -> "_Recorder":
        """Writes the run's folder."""
        return _Recorder(folder, settings, parts, log=log)

    def describe(self, step: StepRecord) -> str:
        """The numbers of a step that tell how it goes."""
        return describe(step)

    def success(self, result: RunResult) -> bool:
        """Whether the belief became sure."""
        return result.stopped_by == "sure"

    def summary(self, settings: Settings, result: RunResult) -> Sequence[str]:
        """A few lines on how a run ended."""
        return [*ending(result), f"seconds  {sum(result.timings_s.values()):.1f}: {stages(result.timings_s)}"]

    def draw(self, folder: Path, settings: Settings, result: RunResult) -> Sequence[Path]:
        """Overview, scenes and animation."""
        from rumi.viz.figures import make_figures

        return make_figures(load_run(folder), folder / "figures", None)


ENTRIES = {name: RummageTask(spec) for name, spec in SCENES.items()}
"""The scenes by name."""


class _Recorder(contextlib.ExitStack):
    """Writes folder and log of a run."""

    def __init__(self, folder: Path, settings: Settings, parts: Parts[Any, Rummager], *, log: bool) -> None:
        from rumi.tasks.rummage.build import scene_sketch

        super().__init__()
        about = record(parts.agent.model)
        self._settings, self._folder = settings, folder
        self._run = self.enter_context(RunRecorder(folder, to_dict(settings)))
        self._log: LogRecorder | None = None
        # what the sensors give, before it is read
        self._raw = getattr(parts.task, "raw", None)
        if log:
            texts = {"object": about, "made_with": provenance()}
            kinds = None if self._raw is None else self._raw.kinds()
            made = LogRecorder(folder / LOG, to_dict(settings), texts, dtype=settings.torch_dtype, raw=kinds)
            self._log = self.enter_context(made)
            if self._raw is not None:
                self._raw.sink = self._log.raw
        write_json(folder / "object.json", about)
        self._run.scene(scene_sketch(parts.agent))

    def __call__(self, step: StepRecord) -> None:
        self._run(step)
        if self._log is not None:
            self._log(step)

    def finish(self, result: RunResult) -> None:
        self._run.finish(result)
        if self._log is not None:
            self._log.finish(result)
            if self._raw is not None:
                text = self._raw.mapping(self._settings.object)
                (self._folder / "map.toml").write_text(text, encoding="utf-8")


def describe(step: StepRecord) -> str:
    """The numbers of a step that tell how it goes."""
    known = "" if step.nll is None else f"nll {step.nll:.1f}  "
    apc = "-" if math.isnan(step.apc) else f"{1e3 * step.apc:.1f} mm"
    marks = {
        "contact": step.control is not None and bool(step.reading.in_contact.any()),
        "resampled": step.resampled,
        "sure": step.converged,
    }
    said = ", ".join(word for word, holds in marks.items() if holds)
    numbers = f"{known}expects {step.expected_nll:.1f}  apc {apc}  ess {step.ess:.0f}"
    return f"{numbers}  [{said}]" if said else numbers


def ending(result: RunResult) -> list[str]:
    """The lines on what a run came to know."""
    ended = {"steps": "not sure", "budget": "out of time"}.get(result.stopped_by, result.stopped_by)
    judged = {True: ", and right", False: ", and wrong", None: ""}[result.right]
    lines = [f"{ended} after {result.steps} actions, {result.contacts} of them in contact{judged}"]
    if result.position_error_mm is not None and result.rotation_error_deg is not None:
        lines.append(f"pose     off by {result.position_error_mm:.1f} mm and {result.rotation_error_deg:.1f} degrees")
    known = "" if result.final_nll is None else f"{result.final_nll:.1f} at the end, {result.min_nll:.1f} at best; "
    return [*lines, f"nll      {known}the belief expects {result.expected_nll:.1f}"]
