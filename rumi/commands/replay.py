"""The command `rumi replay`: a recorded run or log in the robot's place."""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar, cast

import torch
import tyro

from rumi.cache import cache_folder
from rumi.commands.flags import FLAGS
from rumi.commands.recordings import keep
from rumi.commands.replay_summary import differing, machines, recorded_mesh, summary
from rumi.errors import UsageError
from rumi.exit_codes import DONE, INTERRUPTED, NOT_CONVERGED
from rumi.runs.logbook import LOG
from rumi.runs.progress import Progress, announce, both, say
from rumi.tasks.registry import FORMER_NAMES, IMPORTED, TASKS, TaskEntry, entry_of_record

if TYPE_CHECKING:
    from rumi.agent import Agent
    from rumi.rosbag.mapping import BagMap
    from rumi.runs.recorded import RunLog
    from rumi.tasks.rummage.agent import Rummager
    from rumi.tasks.rummage.settings import Settings
    from sensors.log.reader import Log, Taken

S = TypeVar("S")

MAP = "map.toml"
"""Name of the mapping in the folder of a log's replay."""

_HELP = """Take in a recorded run or log as if its robot were there: the belief that the live run had, or, with other
settings, the one that it would have had on the same readings.

    rumi replay runs/mug-0-rumi-default-s0
    rumi replay runs/mug-0-rumi-default-s0 --filter.peakiness 1 --out what-if
    rumi replay runs/handle-all-s0 --wrist.outlier 0.3
    rumi replay pushes.h5 --map other.toml

All settings of `rumi run` are flags; the recording's own are where they start from. What was done is recorded, so that
those of what is chosen change nothing; those of what was sensed are refused. Nothing is grasped or inserted."""

_HELP_FLAGS = {"--help", "-h"}


@dataclass(frozen=True)
class ReplayOptions(Generic[S]):
    """Options of `rumi replay`.

    Attributes:
        log: the run's folder, or a log.
        settings: of the replay.
        map: mapping file of an imported recording, in place of the one that it was imported with.
        out: folder for the replayed run, for `rumi plot`; none is written without.
        figures: draw its figures, and write the viewer's recording where rerun-sdk is installed.
    """

    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    settings: Annotated[S, tyro.conf.arg(name="")]
    map: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    figures: bool = False


def replay(arguments: Sequence[str]) -> int:
    """`rumi replay`: 0 if the belief became sure, 1 if not or if it is not the recorded one, 2 for bad input.

    Ctrl-C ends it with 130 and what it has.
    """
    if not arguments or arguments[0].startswith("-"):
        if _HELP_FLAGS & set(arguments):
            _parsed(arguments, Path("RUN"), entry_of_imported(), entry_of_imported().preset("default"))
        raise UsageError("Expected the run first, its folder or a log, as in `rumi replay runs/mug-0-rumi-default-s0`")
    asked, _ = tyro.cli(_Map, args=arguments, default=_Map(), add_help=False, return_unknown_args=True)
    with opened(Path(arguments[0]), asked.map) as log:
        mapping = mapping_of_log(log, asked.map)
        entry, recorded = recorded_settings(log, mapping)
        options = _parsed(arguments, log.path, entry, recorded)
        return _replay(log, options, entry, recorded, mapping, mapping or mapping_of_replay(log), cache_folder())


@dataclass(frozen=True)
class _Map:
    """The option that decides what the settings start from."""

    map: Path | None = None


@contextlib.contextmanager
def opened(path: Path, asked: Path | None) -> "Iterator[Log | RunLog]":
    """The recording that is meant: a run's folder, or a log; of a folder with a mapping the raw streams in it.

    Args:
        path: of it.
        asked: file of a mapping in place of the recording's own.

    Raises:
        UsageError: there is none, or it is damaged.
    """
    from rumi.runs.recorded import RunLog

    logged = (path / LOG).is_file()
    if path.is_dir() and asked is not None and not logged:
        raise UsageError(f"{path} has no {LOG}, which --map needs: its raw streams were not recorded; `--record` does")
    if path.is_dir() and asked is None and not (logged and _is_all_there_is(path)):
        yield RunLog(path)
        return
    from sensors.log.errors import LogError

    try:
        from sensors.log.reader import Log

        with Log(path / LOG if path.is_dir() else path) as log:
            yield log
    except LogError as error:
        raise UsageError(str(error)) from error


def _is_all_there_is(folder: Path) -> bool:
    """Whether a folder's log has more than its trace: of a robot that left none, or of before, with the readings."""
    if not (folder / "trace.npz").is_file():
        return True
    from sensors.log.errors import LogError
    from sensors.log.reader import Log

    try:
        with Log(folder / LOG) as log:
            return log.settings is not None
    except LogError:
        return False


def mapping_of_log(log: "Log | RunLog", asked: Path | None) -> "BagMap | None":
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
    from rumi.rosbag.mapping_file import mapping_of, read_mapping

    if asked is not None:
        return read_mapping(asked)
    if "map" in log.texts:
        return mapping_of(log.texts["map"], f"the mapping in {log.path}")
    raise UsageError(f"{log.path} holds raw streams and no mapping: give one with --map FILE")


def mapping_of_replay(log: "Log | RunLog") -> "BagMap | None":
    """The mapping of the log whose replay wrote a folder; None of any other recording.

    Raises:
        UsageError: the folder has lost it, or it is wrong.
    """
    if not _is_of_log(log):
        return None
    from rumi.rosbag.mapping_file import read_mapping

    if not (log.path / MAP).is_file():
        raise UsageError(f"{log.path} was written by a log's replay and has no {MAP} any more: replay the log again")
    return read_mapping(log.path / MAP)


def _is_of_log(log: "Log | RunLog") -> bool:
    """Whether readings were made by a mapping from a log's streams, by the replay that wrote them."""
    return log.settings is not None and log.settings.get("task") == IMPORTED


def recorded_settings(log: "Log | RunLog", mapping: "BagMap | None") -> tuple[TaskEntry[Any], Any]:
    """Task and settings of the run that was recorded; of an imported recording those of rummaging, by its mapping.

    Raises:
        UsageError: they are none of this rumi.
    """
    if mapping is not None:
        from rumi.rosbag.scene import settings_of

        return entry_of_imported(), settings_of(mapping)
    values = log.settings or {}
    entry = entry_of_imported() if _is_of_log(log) else entry_of_record(values.get("task", ""))
    return entry, entry.from_dict(values)


def entry_of_imported() -> TaskEntry[Any]:
    """The task that an imported recording is taken for: any of the rummaging scenes."""
    return TASKS["mug-0"]


def _parsed(arguments: Sequence[str], path: Path, entry: TaskEntry[S], start: S) -> ReplayOptions[S]:
    options: ReplayOptions[S] = tyro.cli(
        ReplayOptions[entry.settings],  # type: ignore[name-defined]
        prog="rumi replay",
        description=_HELP,
        args=arguments,
        default=ReplayOptions(path, start),
        registry=FLAGS,
    )
    for name in differing(start, options.settings):
        if entry.role(name) == "sensed":
            raise UsageError(f"Expected {name} as it was recorded, got another: a replay cannot change what was sensed")
    return options


def _replay(
    log: "Log | RunLog",
    options: ReplayOptions[Any],
    entry: TaskEntry[Any],
    recorded: Any,  # noqa: ANN401  (settings of any task)
    mapping: "BagMap | None",
    scene: "BagMap | None",
    cache_dir: Path,
) -> int:
    """Replay readings, made by `mapping` from raw streams where it is given; `scene` is of those that were so made."""
    from rumi.runs.files import whole_file
    from rumi.runs.folder import RunRecorder, load_run, prepare_folder, write_json
    from rumi.runs.replay import replay as take_in
    from rumi.tasks.rummage.geometry import geometry_of
    from rumi.tasks.rummage.objects import record

    settings = options.settings
    if options.out is not None:
        prepare_folder(options.out)
    elif options.figures:
        raise UsageError("Expected --out DIR with --figures, got none: figures need a folder")
    changed = differing(recorded, settings)
    if idle := [name for name in changed if entry.role(name) == "idle"]:
        say(f"{', '.join(idle)}: no effect, since what was done is recorded")
    taken = log.taken() if mapping is None else made_readings(log, mapping, settings)
    for problem in log.problems:
        say(problem)
    if scene is not None:
        agent = agent_of_imported(scene, settings, taken, cache_dir)
        if mapping is not None:
            from rumi.rosbag.in_plane import in_plane

            taken = in_plane(taken, cast("Rummager", agent))
    else:
        agent = entry.agent(settings, cache_dir=cache_dir)
    _check_object(log, agent)
    announce(agent)
    label = getattr(settings, "task", entry.label(settings)) if scene is not None else _name(log)
    steps = entry.steps(settings) if scene is None else settings.steps
    taken = taken if steps is None else taken[: steps + 1]
    with contextlib.ExitStack() as stack:
        on_step = stack.enter_context(Progress(label, len(taken) - 1, entry.describe))
        recorder = None
        if options.out is not None:
            recorder = stack.enter_context(RunRecorder(options.out, entry.as_dict(settings), geometry_of(agent)))
            if scene is not None:  # before the steps: without it nobody could read those that a kill leaves
                with whole_file(options.out / MAP) as aside:
                    aside.write_text(scene.text, encoding="utf-8")
            if (model := getattr(agent, "model", None)) is not None:
                write_json(options.out / "object.json", record(model))
        seen = on_step if recorder is None else both(recorder, on_step)
        done = take_in(taken, agent, seed=settings.seed, on_step=seen, wrap=_in_dtype(settings, taken))
        if recorder is not None:
            recorder.finish(done.result)
    interrupted = done.result.stopped_by == "interrupted"
    if options.figures and options.out is not None and not interrupted:
        entry.draw(load_run(options.out), options.out / "figures")
        keep(options.out)
    asked = [name for name in changed if name not in idle]
    lines = [line for line in entry.summary(settings, done.result) if line.split(" ", 1)[0] not in _OF_LIVE]
    sys.stdout.write(summary(done, label, lines, len(taken), asked, options.out))
    differs = not asked and False in done.same
    if differs:
        for line in machines(log):
            say(line)
    if interrupted:
        return INTERRUPTED
    if differs:
        return NOT_CONVERGED
    return DONE if done.result.stopped_by == "sure" else NOT_CONVERGED


_OF_LIVE = ("seconds", "clock", "grasp")
"""Lines of a summary that are of a live run alone, by their first word."""


def made_readings(log: "Log | RunLog", mapping: "BagMap", settings: "Settings") -> "list[Taken]":
    """The readings of an imported recording; says what could not be used."""
    from rumi.rosbag.readings import make_readings

    made = make_readings(cast("Log", log), mapping, seed=settings.seed)
    if made.wrenches:
        say("wrenches: " + ", ".join(f"{count} {name}" for name, count in made.wrenches.items() if count))
    for line in (*made.notes, *made.problems[:10]):
        say(line)
    if len(made.problems) > 10:
        say(f"and {len(made.problems) - 10} more like these")
    return made.taken


def agent_of_imported(
    mapping: "BagMap", settings: "Settings", taken: "Sequence[Taken]", cache_dir: Path | None
) -> "Agent[Any]":
    """What follows an imported recording.

    Raises:
        UsageError: there is no such device, or the object cannot be used.
    """
    from rumi.rosbag.scene import rummager_of_map, touching_height

    readings = [one.reading for one in taken]
    places = torch.cat([one.tool_pose[:, :3, 3] for one in readings])
    return rummager_of_map(mapping, settings, places, cache_dir, touching_m=touching_height(readings))


def _name(log: "Log | RunLog") -> str:
    """The task's name as it is today."""
    name = str((log.settings or {}).get("task"))
    return FORMER_NAMES.get(name, name)


def _in_dtype(settings: Any, taken: "Sequence[Taken]") -> Any:  # noqa: ANN401  (what `replay` takes)
    """What brings readings to the settings' dtype."""
    from rumi.task import TaskOnDevice

    if not hasattr(settings, "torch_dtype") or not taken or taken[0].reading.tool_pose.dtype == settings.torch_dtype:
        return lambda task: task
    return lambda task: TaskOnDevice(task, torch.device("cpu"), settings.torch_dtype)


def _check_object(log: Any, agent: Any) -> None:  # noqa: ANN401
    """Say so where the mesh is not the one that was recorded with."""
    mesh = recorded_mesh(log)
    source = getattr(getattr(agent, "model", None), "source", None)
    if mesh is not None and source is not None and mesh.get("sha256") != source.sha256:
        say(f"{source.file} is not the mesh of the recorded run ({mesh.get('file')}): other beliefs will come of it")
