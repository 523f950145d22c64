"""What the commands of `rumi` do."""

import contextlib
import difflib
import gc
import os
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.belief.motion import Motion
from rumi.cli import DONE, INTERRUPTED, NOT_CONVERGED
from rumi.config import Settings, preset, setting_names, to_dict
from rumi.dynamics.family import PushChoice
from rumi.errors import UsageError
from rumi.explain import Decisions, explain
from rumi.logbook import LOG, LogRecorder
from rumi.progress import Progress, both, stages
from rumi.recording import RunRecorder, holds_run, load_run, prepare_folder, provenance, write_json
from rumi.records import RunResult
from rumi.sim.sensor_settings import SensorKind, degraded
from sdf import savings

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


@dataclass(frozen=True)
class PlotOptions:
    """Draw the figures of a run again, also of one that goes on or was interrupted.

    Attributes:
        run: folder of the run.
        steps: scenes to draw; by default the first view, the first contact, the middle and the end.
        out: folder of the figures; by default RUN/figures.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    steps: tuple[int, ...] | None = None
    out: Path | None = None


def tasks(arguments: Sequence[str]) -> int:
    """`rumi tasks`: the tasks by name."""
    from rumi import peg_command
    from rumi.sim.tasks import TASKS
    from rumi.touch import command as touch

    tyro.cli(_Nothing, prog="rumi tasks", args=arguments, description="List what there is to find.")
    listed = {name: spec.description for name, spec in TASKS.items()}
    listed |= {touch.NAME: touch.DESCRIPTION, peg_command.NAME: peg_command.DESCRIPTION}
    width = max(map(len, listed))
    for name, description in listed.items():
        sys.stdout.write(f"{name:<{width}}  {description}\n")
    return DONE


@dataclass(frozen=True)
class _Nothing:
    """No options."""


def run(arguments: Sequence[str]) -> int:
    """`rumi run`: one run, its folder and its figures."""
    from rumi import peg_command
    from rumi.touch import command as touch

    # tasks of their own, with settings of their own
    for name, own in ((touch.NAME, touch.run_touch), (peg_command.NAME, peg_command.peg)):
        at = arguments.index(name) if name in arguments else -1
        if at == 0 or (at > 0 and not arguments[at - 1].startswith("--")):  # not the value of a flag
            return own([*arguments[:at], *arguments[at + 1 :]], cache_dir=cache_folder())
    options = parse_run(arguments)
    settings = options.settings
    # what can be wrong is looked at before anything that takes time
    from rumi.sim.tasks import find_task

    spec = find_task(settings.task)
    steps = spec.steps if settings.steps is None else settings.steps
    if steps > spec.steps:
        raise UsageError(f"Expected steps to be at most the {spec.steps} of {spec.name}, got {steps}")
    device = settings.torch_device
    folder = default_folder(settings) if options.out is None else options.out
    prepare_folder(folder)
    asked = f"{settings.task} with {settings.method} ({settings.preset}), seed {settings.seed}, on {device}"
    _say(f"{asked}; writing to {folder}")
    from rumi.assemble import build, scene_sketch
    from rumi.loop import rummage
    from rumi.sim.objects import record

    if settings.object.mesh is not None:
        _say(f"reading {settings.object.mesh} (a minute or two at first; what was worked out is kept)")
    try:
        task, rummager = build(settings, cache_dir=cache_folder())
    except Exception:
        with contextlib.suppress(OSError):  # other files in it are the user's
            folder.rmdir()
        raise
    if settings.budget_s is not None:
        # to look through all that was loaded for garbage takes up to tenths of a second, in the midst of a plan
        gc.freeze()
    with (
        RunRecorder(folder, to_dict(settings)) as recorder,
        _log(options, folder, record(rummager.model)) as log,
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
    if options.figures and result.stopped_by != "interrupted":
        _say("drawing figures")
        _draw(folder, folder / "figures", None)
    sys.stdout.write(summary(result, folder, settings.task))
    if options.explain:
        sys.stdout.write(explain(account))
    return {"converged": DONE, "steps": NOT_CONVERGED, "interrupted": INTERRUPTED}[result.stopped_by]


def _log(
    options: RunOptions, folder: Path, about: dict[str, Any]
) -> contextlib.AbstractContextManager[LogRecorder | None]:
    """The log of a run, if one was asked for."""
    if not options.record:
        return contextlib.nullcontext()
    settings, texts = options.settings, {"object": about, "made_with": provenance()}
    return LogRecorder(folder / LOG, to_dict(settings), texts, dtype=settings.torch_dtype)


def replay(arguments: Sequence[str]) -> int:
    """`rumi replay`: a recorded log in the robot's place."""
    from rumi import replay_command

    return replay_command.replay(arguments, cache_dir=cache_folder())


def import_bag(arguments: Sequence[str]) -> int:
    """`rumi import`: a ROS 2 bag as a log."""
    from rumi import bag_command

    return bag_command.import_bag(arguments)


def check(arguments: Sequence[str]) -> int:
    """`rumi check`: a log's observations over the model."""
    from rumi import check_command

    return check_command.check(arguments, cache_dir=cache_folder())


def plot(arguments: Sequence[str]) -> int:
    """`rumi plot`: the figures of a run."""
    options = tyro.cli(PlotOptions, prog="rumi plot", args=arguments)
    for path in _draw(options.run, options.out or options.run / "figures", options.steps):
        sys.stdout.write(f"{path}\n")
    return DONE


def bench(arguments: Sequence[str]) -> int:
    """`rumi bench`: how long the work takes."""
    from rumi.bench import command

    return command.bench(arguments, cache_dir=cache_folder())


def mesh(arguments: Sequence[str]) -> int:
    """`rumi mesh`: what a mesh is like."""
    from rumi import mesh_command

    return mesh_command.mesh(arguments)


def localize(arguments: Sequence[str]) -> int:
    """`rumi localize`: where an object is, from touched points."""
    from rumi import localize_command

    return localize_command.localize(arguments)


def reproduce(arguments: Sequence[str]) -> int:
    """`rumi reproduce`: the paper's tables and figures."""
    from rumi.reproduce import command

    if any(argument.startswith("touch-") for argument in arguments):
        from rumi.reproduce import touch

        return touch.reproduce_touch(arguments, cache_dir=cache_folder())
    return command.reproduce(arguments, cache_dir=cache_folder())


def stress(arguments: Sequence[str]) -> int:
    """`rumi stress`: how far the arithmetic is off."""
    from rumi.stress import command

    return command.stress(arguments)


def parse_run(arguments: Sequence[str]) -> RunOptions:
    """Options of `rumi run`; the settings start from the preset that is asked for.

    Raises:
        UsageError: an unknown preset or setting; the message lists the valid ones.
        SystemExit: for all else that is wrong, after a message, and for help.
    """
    start = replace(preset(_asked_preset(arguments)), task="")
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
    folder, number = root / name, 1
    while holds_run(folder):
        number += 1
        folder = root / f"{name}-{number}"
    return folder


def cache_folder() -> Path:
    """Folder for what takes long to work out: $RUMI_CACHE, else the user's cache."""
    own = os.environ.get("RUMI_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rumi"


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


def _draw(folder: Path, out: Path, steps: Sequence[int] | None) -> list[Path]:
    from rumi.viz.figures import make_figures

    return make_figures(load_run(folder), out, steps)


def _say(text: str) -> None:
    sys.stderr.write(f"rumi: {text}\n")
    sys.stderr.flush()


def _asked_preset(arguments: Sequence[str]) -> str:
    for place, argument in enumerate(arguments):
        if argument.startswith("--preset="):
            return argument.removeprefix("--preset=")
        if argument == "--preset" and place + 1 < len(arguments):
            return arguments[place + 1]
    return "default"


def check_flags(arguments: Sequence[str], options: Sequence[str], on_off: Sequence[str]) -> None:
    """Refuse flags that are no setting, with those that are.

    Args:
        arguments: of the command line.
        options: of the command, beside the settings.
        on_off: those that take no value.
    """
    names = [name.replace("_", "-") for name in setting_names() if name != "task"] + [*options]
    switches = {f"{head}{dot}no-{tail}" for head, dot, tail in (name.rpartition(".") for name in [*names, *on_off])}
    known = {"help", *on_off, *names, *switches}
    for argument in arguments:
        name = argument[2:].split("=")[0].replace("_", "-")
        if not argument.startswith("--") or not name or name in known:
            continue
        close = difflib.get_close_matches(name, names, 3, 0.7)
        hint = f"; did you mean {' or '.join('--' + match for match in close)}?" if close else "."
        listed = textwrap.fill(" ".join(f"--{known}" for known in names), 110, break_on_hyphens=False)
        raise UsageError(f"There is no setting --{name}{hint} The settings are:\n{textwrap.indent(listed, '  ')}")
