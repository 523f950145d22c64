"""`rumi run`: one run of a task, its folder and its figures."""

import contextlib
import gc
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.belief.motion import Motion
from rumi.commands.explain import Decisions, explain
from rumi.commands.flags import asked_preset, check_flags
from rumi.commands.progress import Progress, both, say, stages
from rumi.dynamics.registry import PushChoice
from rumi.errors import UsageError
from rumi.exit_codes import DONE, INTERRUPTED, NOT_CONVERGED
from rumi.records import RunResult
from rumi.runs.folder import RunRecorder, free_folder, left_if_begun, load_run, prepare_folder, provenance, write_json
from rumi.runs.logbook import LOG, LogRecorder
from rumi.sim.sensor_settings import SensorKind, degraded
from rumi.task import Task
from rumi.tasks.rummage.settings import Settings, preset, to_dict
from sdf import skipped_work as savings

_RUN_HELP = """Find an object by touch, in simulation; `rumi tasks` lists what there is.

    rumi run mug-0
    rumi run mug-1 --method info-only --seed 3
    rumi run mug-0 --preset paper --steps 10 --out my-run
    rumi run mug-0 --planner.mppi.samples 100 --stop.rule never
    rumi run mug-0 --mesh drill.obj --scale 0.001 --mass 0.9
    rumi run mug-0 --sensor both --degraded

Every setting below is a flag; --preset sets where the others start from."""


@dataclass(frozen=True)
class RunOptions:
    """Options of `rumi run`.

    Attributes:
        settings: of the run.
        motion: how the object's motion is known: measured by a slip sensor, sticking to the tool, pushed as a
            quasi-static model has it, estimated from what was sensed (Alg 5), or corrected, pushed and then estimated;
            short for --filter.motion.
        push_model: how the planner expects the object to move; short for --planner.push-model.
        sensor: through what the simulator reports: points at the pads, a camera's images, soft bubbles', or both; short
            for --simulator.sensors.kind.
        degraded: give those images noise, lose a tenth, and let them be late and off in calibration.
        out: folder of the run; by default runs/TASK-METHOD-PRESET-sSEED, with a number where that is taken.
        figures: draw figures at the end.
        explain: say at the end what was skipped, since the scene did not need it, and what that saved.
        record: write a log too, log.h5 in the run's folder, for `rumi replay`.
    """

    settings: Annotated[Settings, tyro.conf.arg(name="")]
    motion: Motion | None = None
    push_model: PushChoice | None = None
    sensor: SensorKind | None = None
    degraded: bool = False
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    figures: bool = True
    explain: bool = False
    record: bool = False


def run(arguments: Sequence[str], *, cache_dir: Path) -> int:
    """Carry out `rumi run`: one run, its folder and its figures."""
    options = parse_run(arguments)
    settings = options.settings
    # what can be wrong is looked at before anything that takes time
    from rumi.tasks.rummage.scenes import find_task

    spec = find_task(settings.task)
    steps = spec.steps if settings.steps is None else settings.steps
    if steps > spec.steps:
        raise UsageError(f"Expected steps to be at most the {spec.steps} of {spec.name}, got {steps}")
    device = settings.torch_device
    from rumi.loop import rummage
    from rumi.tasks.rummage.build import build, scene_sketch
    from rumi.tasks.rummage.objects import record

    folder = default_folder(settings) if options.out is None else options.out
    prepare_folder(folder)
    asked = f"{settings.task} with {settings.method} ({settings.preset}), seed {settings.seed}, on {device}"
    say(f"{asked}; writing to {folder}")
    if settings.object.mesh is not None:
        say(f"reading {settings.object.mesh} (a minute or two at first; what was worked out is kept)")
    with left_if_begun(folder):
        task, rummager = build(settings, cache_dir=cache_dir)
    if settings.budget_s is not None:
        # to look through all that was loaded for garbage takes up to tenths of a second, in the midst of a plan
        gc.freeze()
    with (
        RunRecorder(folder, to_dict(settings)) as recorder,
        _log(options, folder, record(rummager.model), task) as log,
        savings.account() as account,
    ):
        write_json(folder / "object.json", record(rummager.model))
        recorder.scene(scene_sketch(rummager))
        try:
            with Progress(settings.task, steps) as progress:
                on_step = both(recorder, *([] if log is None else [log]), progress, Decisions(account))
                result = rummage(task, rummager, seed=settings.seed, steps=steps, on_step=on_step)
        finally:
            task.close()
        recorder.finish(result)
        if log is not None:
            log.finish(result)
            if (raw := getattr(task, "raw", None)) is not None:
                (folder / "map.toml").write_text(raw.mapping(settings.object), encoding="utf-8")
    if options.figures and result.stopped_by != "interrupted":
        say("drawing figures")
        draw_figures(folder, folder / "figures", None)
    sys.stdout.write(summary(result, folder, settings.task))
    if options.explain:
        sys.stdout.write(explain(account))
    return {"converged": DONE, "steps": NOT_CONVERGED, "interrupted": INTERRUPTED}[result.stopped_by]


def _log(
    options: RunOptions, folder: Path, about: dict[str, Any], task: Task
) -> contextlib.AbstractContextManager[LogRecorder | None]:
    """The log of a run, if one was asked for; what its sensors give unread goes there too."""
    if not options.record:
        return contextlib.nullcontext()
    settings, texts = options.settings, {"object": about, "made_with": provenance()}
    raw = getattr(task, "raw", None)
    kinds = None if raw is None else raw.kinds()
    log = LogRecorder(folder / LOG, to_dict(settings), texts, dtype=settings.torch_dtype, raw=kinds)
    if raw is not None:
        raw.sink = log.raw
    return log


def parse_run(arguments: Sequence[str]) -> RunOptions:
    """Options of `rumi run`; the settings start from the preset that is asked for.

    Raises:
        UsageError: an unknown preset or setting; the message lists the valid ones.
        SystemExit: for all else that is wrong, after a message, and for help.
    """
    start = replace(preset(asked_preset(arguments)), task="")
    check_flags(arguments, ("motion", "push-model", "sensor", "out"), ("figures", "explain", "degraded", "record"))
    options = tyro.cli(
        RunOptions,
        prog="rumi run",
        description=_RUN_HELP,
        args=arguments,
        default=RunOptions(start),
    )
    if not options.settings.task:
        raise UsageError("Which task? Give its name, as in `rumi run mug-0`; `rumi tasks` lists them")
    settings = options.settings
    if options.motion is not None:
        settings = replace(settings, filter=replace(settings.filter, motion=options.motion))
    if options.push_model is not None:
        settings = replace(settings, planner=replace(settings.planner, push_model=options.push_model))
    if options.sensor is not None or options.degraded:
        own = settings.simulator.sensors
        kind = own.kind if options.sensor is None else options.sensor
        if options.degraded and kind == "points":
            raise UsageError("--degraded is of images: give --sensor camera, bubbles or both with it")
        own = degraded(kind) if options.degraded else replace(own, kind=kind)
        settings = replace(settings, simulator=replace(settings.simulator, sensors=own))
    return replace(options, settings=settings)


def default_folder(settings: Settings, root: Path = Path("runs")) -> Path:
    """A folder of `root` that holds no run yet, named after the settings."""
    own = "" if settings.object.mesh is None else f"-{Path(settings.object.mesh).stem}"
    name = f"{settings.task}{own}-{settings.method}-{settings.preset}-s{settings.seed}"
    return free_folder(root / name)


def summary(result: RunResult, folder: Path, name: str) -> str:
    """A few lines on how a run ended."""
    lines = [*ending(result, name)]
    lines.append(f"seconds  {sum(result.timings_s.values()):.1f}: {stages(result.timings_s)}")
    lines.append(f"folder   {folder}")
    return "\n  ".join(lines) + "\n"


def ending(result: RunResult, name: str) -> list[str]:
    """The lines on what a run came to know."""
    ended = {"converged": "sure", "steps": "not sure", "interrupted": "interrupted"}[result.stopped_by]
    judged = {True: ", and right", False: ", and wrong", None: ""}[result.right]
    lines = [f"{name}: {ended} after {result.steps} actions, {result.contacts} of them in contact{judged}"]
    if result.position_error_mm is not None and result.rotation_error_deg is not None:
        lines.append(f"pose     off by {result.position_error_mm:.1f} mm and {result.rotation_error_deg:.1f} degrees")
    known = "" if result.final_nll is None else f"{result.final_nll:.1f} at the end, {result.min_nll:.1f} at best; "
    return [*lines, f"nll      {known}the belief expects {result.expected_nll:.1f}"]


def draw_figures(folder: Path, out: Path, steps: Sequence[int] | None) -> list[Path]:
    """Draw the figures of a recorded run; the paths of the files."""
    from rumi.viz.figures import make_figures

    return make_figures(load_run(folder), out, steps)
