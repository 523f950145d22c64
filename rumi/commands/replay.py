"""The command `rumi replay`: a recorded log in the robot's place."""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
import tyro

from rumi.cache import cache_folder
from rumi.errors import UsageError
from rumi.exit_codes import DONE, NOT_CONVERGED
from rumi.runs.logbook import LOG
from rumi.runs.progress import Progress, both, say
from rumi.tasks.rummage.entry import describe, ending
from rumi.tasks.rummage.settings import Settings, from_dict, to_dict

if TYPE_CHECKING:
    from rumi.rosbag.mapping import BagMap
    from rumi.runs.replay import Replayed
    from rumi.tasks.rummage.agent import Rummager
    from sensors.log.reader import Log, Taken

_HELP = """Take in a recorded log as if its robot were there: the belief that the live run had, or, with other settings,
the one that it would have had on the same readings.

    rumi replay runs/mug-0-rumi-default-s0
    rumi replay runs/mug-0-rumi-default-s0/log.h5 --filter.peakiness 1 --out what-if
    rumi replay pushes.h5 --map other.toml

All settings of `rumi run` are flags; the log's own are where they start from. What was done is recorded, so that those
of the planner change nothing, and those of the task and the simulator are refused. The log of a run of
the handle task has settings of its own: rumi replay LOG --help."""

_HELP_FLAGS = {"--help", "-h"}
_RECORDED = ("task", "simulator")
_NO_EFFECT = ("method", "preset", "replan_every", "planner", "slide", "gpvr")


@dataclass(frozen=True)
class ReplayOptions:
    """Options of `rumi replay`.

    Attributes:
        log: the log, or the run's folder that it lies in.
        settings: of the replay.
        map: mapping file of an imported recording, in place of the one that it was imported with.
        out: folder for the replayed run, for `rumi plot`; none is written without.
        figures: draw its figures.
    """

    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    settings: Annotated[Settings, tyro.conf.arg(name="")]
    map: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    figures: bool = False


def replay(arguments: Sequence[str]) -> int:
    """`rumi replay`: 0 if the belief became sure, 1 if not or if it is not the recorded one, 2 for bad input."""
    from rumi.commands.replay_handle import replay_handle
    from rumi.tasks.handle.log import is_of_handle

    if not arguments or arguments[0].startswith("-"):
        if _HELP_FLAGS & set(arguments):
            _parsed(arguments, Path("LOG"), Settings())
        raise UsageError(
            "Expected the log first, its file or its run's folder, as in `rumi replay runs/mug-0-rumi-default-s0`"
        )
    asked, _ = tyro.cli(_Map, args=arguments, default=_Map(), add_help=False, return_unknown_args=True)
    from sensors.log.errors import LogError

    path = log_path(Path(arguments[0]))
    try:
        from sensors.log.reader import Log

        with Log(path) as log:
            if is_of_handle(log):
                return replay_handle(log, arguments, cache_folder())
            mapping = mapping_of_log(log, asked.map)
            recorded = recorded_settings(log, mapping)
            options = _parsed(arguments, path, recorded)
            return _replay(log, options, recorded, mapping, cache_folder())
    except LogError as error:
        raise UsageError(str(error)) from error


@dataclass(frozen=True)
class _Map:
    """The option that decides what the settings start from."""

    map: Path | None = None


def log_path(path: Path) -> Path:
    """The log that is meant by a file or a run's folder.

    Raises:
        UsageError: the folder has none.
    """
    if not path.is_dir():
        return path
    if not (path / LOG).is_file():
        raise UsageError(f"{path} has no {LOG}: it was not recorded; `rumi run --record` does")
    return path / LOG


def mapping_of_log(log: "Log", asked: Path | None) -> "BagMap | None":
    """The mapping by which a log's raw streams are read; None where it holds a run's readings.

    Args:
        log: with raw streams, readings or both.
        asked: file of a mapping in place of the log's own.

    Raises:
        UsageError: the log holds neither, or the mapping is wrong.
    """
    if log.settings is not None:
        if asked is None:
            return None
        if not log.streams:
            raise UsageError(f"{log.path} holds the readings of a run and no raw streams, which need no --map")
    from rumi.rosbag.mapping import mapping_of, read_mapping

    if asked is not None:
        return read_mapping(asked)
    if "map" in log.texts:
        return mapping_of(log.texts["map"], f"the mapping in {log.path}")
    raise UsageError(f"{log.path} holds raw streams and no mapping: give one with --map FILE")


def recorded_settings(log: "Log", mapping: "BagMap | None") -> Settings:
    """The settings of the run that made a log, or of the mapping of one that none made.

    Raises:
        UsageError: it is of the handle task, which has others.
    """
    if mapping is None:
        from rumi.tasks.handle.log import is_of_handle

        if is_of_handle(log):
            raise UsageError(f"{log.path} is of the handle task, whose settings are others: `rumi replay` reads it")
        return from_dict(log.settings or {})
    from rumi.rosbag.scene import settings_of

    return settings_of(mapping)


def _parsed(arguments: Sequence[str], path: Path, start: Settings) -> ReplayOptions:
    default = ReplayOptions(path, start)
    options = tyro.cli(ReplayOptions, prog="rumi replay", description=_HELP, args=arguments, default=default)
    for name in _RECORDED:
        if getattr(options.settings, name) != getattr(start, name):
            raise UsageError(f"Expected {name} as it was recorded, got another: a replay cannot change what was sensed")
    return options


def _replay(log: "Log", options: ReplayOptions, recorded: Settings, mapping: "BagMap | None", cache_dir: Path) -> int:
    from rumi.runs.folder import RunRecorder, load_run, prepare_folder, write_json
    from rumi.runs.replay import replay as take_in

    settings = options.settings
    if options.out is not None:
        prepare_folder(options.out)
    elif options.figures:
        raise UsageError("Expected --out DIR with --figures, got none: figures need a folder")
    changed = changes(to_dict(recorded), to_dict(settings))
    if idle := [name for name in changed if name.split(".")[0] in _NO_EFFECT]:
        say(f"{', '.join(idle)}: no effect, since what was done is recorded")
    taken = log.taken() if mapping is None else made_readings(log, mapping, settings)
    for problem in log.problems:
        say(problem)
    if settings.steps is not None:
        taken = taken[: settings.steps + 1]
    rummager = rummager_of(settings, mapping, taken, cache_dir)
    _check_object(log, rummager)
    elsewhere = _elsewhere(settings, taken)
    with Progress(settings.task, len(taken) - 1, describe) as progress:
        if options.out is None:
            done = take_in(taken, rummager, seed=settings.seed, on_step=progress, wrap=elsewhere)
        else:
            from rumi.tasks.rummage.build import scene_sketch
            from rumi.tasks.rummage.objects import record

            with RunRecorder(options.out, to_dict(settings)) as recorder:
                write_json(options.out / "object.json", record(rummager.model))
                recorder.scene(scene_sketch(rummager))
                on_step = both(recorder, progress)
                done = take_in(taken, rummager, seed=settings.seed, on_step=on_step, wrap=elsewhere)
                recorder.finish(done.result)
    if options.figures and options.out is not None:
        from rumi.viz.figures import make_figures

        make_figures(load_run(options.out), options.out / "figures", None)
    asked = [name for name in changed if name not in idle]
    sys.stdout.write(summary(done, len(taken), asked, options.out, settings.task))
    if not asked and False in done.same:
        for line in machines(log):
            say(line)
        return NOT_CONVERGED
    return DONE if done.result.stopped_by == "sure" else NOT_CONVERGED


def summary(
    done: "Replayed",
    readings: int,
    changed: Sequence[str],
    out: Path | None,
    name: str,
    go_on: str = " (--stop.rule never goes on)",
) -> str:
    """A few lines on a replay.

    Args:
        done: what came of it.
        readings: that there were.
        changed: settings that are not the recorded ones and that matter.
        out: the folder that was written.
        name: of the task.
        go_on: how to take in readings after the belief is sure.
    """
    result = done.result
    used = len(done.same)
    head, *rest = ending(result)
    lines = [f"{name}: {head}", *rest]
    if used < readings:
        lines.append(f"readings {used} of {readings}: sure before the log's end{go_on}")
    x, y, z = done.last.belief.mode()[:3, 3].tolist()
    yaw = math.degrees(float(torch.atan2(*done.last.belief.mode()[[1, 0], [0, 0]])))
    lines.append(f"likeliest at ({x:.4f}, {y:.4f}, {z:.4f}) m, x axis {yaw:.1f} degrees from the world's")
    known = [same for same in done.same if same is not None]
    if not known:
        lines.append("belief   no live run's to compare with")
    elif all(known):
        lines.append(f"belief   the recorded one, bit for bit, after each of {len(known)} readings")
    else:
        first = done.same.index(False)
        at = "the first view" if first == 0 else f"action {first}"
        why = f" ({', '.join(changed)} changed)" if changed else ", though the settings are the same"
        lines.append(f"belief   differs from the recorded one from {at} on{why}")
    faster = done.robot_s / max(done.wall_s, 1e-9)
    lines.append(f"seconds  {done.wall_s:.1f} for {done.robot_s:.1f} of the robot: {faster:.1f} times as fast")
    if out is not None:
        lines.append(f"folder   {out}")
    return "\n  ".join(lines) + "\n"


def changes(before: Mapping[str, Any], after: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Names of the settings that differ, nested ones with dots."""
    found: list[str] = []
    for name in before.keys() | after.keys():
        a, b = before.get(name), after.get(name)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            found += changes(a, b, f"{prefix}{name}.")
        elif a != b:
            found.append(prefix + name)
    return sorted(found)


def made_readings(log: "Log", mapping: "BagMap", settings: Settings) -> "list[Taken]":
    """The readings of an imported recording; says what could not be used."""
    from rumi.rosbag.readings import make_readings

    made = make_readings(log, mapping, seed=settings.seed)
    if made.wrenches:
        say("wrenches: " + ", ".join(f"{count} {name}" for name, count in made.wrenches.items() if count))
    for line in (*made.notes, *made.problems[:10]):
        say(line)
    if len(made.problems) > 10:
        say(f"and {len(made.problems) - 10} more like these")
    return made.taken


def rummager_of(
    settings: Settings, mapping: "BagMap | None", taken: "Sequence[Taken]", cache_dir: Path | None
) -> "Rummager":
    """All that a replay needs beside the log; nothing of it simulates or plans.

    Raises:
        UsageError: there is no such task or device, or the object cannot be used.
    """
    if mapping is not None:
        from rumi.rosbag.scene import rummager_of_map

        places = torch.cat([one.reading.tool_pose[:, :3, 3] for one in taken])
        return rummager_of_map(mapping, settings, places, cache_dir)
    from rumi.tasks.rummage.build import build_rummager
    from rumi.tasks.rummage.objects import with_object
    from rumi.tasks.rummage.scenes import find_task, make_tool

    spec, model = with_object(find_task(settings.task), settings.object, cache_dir=cache_dir)
    tool = make_tool(spec, settings.simulator, cache_dir=cache_dir)
    # what plans is not used, and may need packages that are not there
    planner = replace(settings.planner, push_model="displacement")
    return build_rummager(spec, replace(settings, method="rumi", planner=planner), model, tool)


def _elsewhere(settings: Settings, taken: "Sequence[Taken]") -> Any:  # noqa: ANN401  (what `replay` takes)
    """What brings readings to the settings' device and dtype."""
    from rumi.task import TaskOnDevice

    device, dtype = settings.torch_device, settings.torch_dtype
    if not taken or (device.type == "cpu" and taken[0].reading.tool_pose.dtype == dtype):
        return lambda task: task
    return lambda task: TaskOnDevice(task, device, dtype)


def _check_object(log: "Log", rummager: "Rummager") -> None:
    """Say so where the mesh is not the one that was recorded with."""
    mesh = json.loads(log.texts.get("object", "{}")).get("mesh")
    source = rummager.model.source
    if mesh is not None and source is not None and mesh.get("sha256") != source.sha256:
        say(f"{source.file} is not the mesh of the recorded run ({mesh.get('file')}): other beliefs will come of it")


def machines(log: "Log") -> list[str]:
    """What this machine has other than the one that recorded a log, which may be why beliefs differ."""
    from rumi.runs.folder import provenance

    now, then = provenance(), json.loads(log.texts.get("made_with", "{}"))
    then.setdefault("processor", now["processor"])  # logs of before do not tell
    return [f"recorded with {name} {_at(then, name)}, replayed with {_at(now, name)}" for name in changes(then, now)]


def _at(values: Mapping[str, Any], name: str) -> Any:  # noqa: ANN401  (a plain value)
    for part in name.split("."):
        values = values.get(part, {}) if isinstance(values, Mapping) else {}
    return values if values != {} else None
