"""The command `rumi run`: a run of a task, its folder and its figures."""

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar

import tyro

from rumi import loop
from rumi.cache import cache_folder
from rumi.commands.explain import Decisions, explain
from rumi.commands.flags import FLAGS
from rumi.commands.kernels_ahead import kernels_ahead
from rumi.commands.pushes import learnt, level_rummager
from rumi.commands.recordings import keep
from rumi.commands.tasks import listing
from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, DONE, INTERRUPTED, NOT_CONVERGED
from rumi.garbage import give_back
from rumi.runs.files import whole_file
from rumi.runs.folder import free_folder, load_run, prepare_folder, remove_if_empty_on_error
from rumi.runs.jsonlines import check_writable
from rumi.runs.progress import Progress, announce, both, say
from rumi.tasks.registry import FORMER_NAMES, TASKS, TaskEntry
from rumi.tasks.rummage.settings import Settings, under_conditions
from sdf import skipped_work
from sdf.extras import optional

if TYPE_CHECKING:
    from rumi.viz.live import LiveView

S = TypeVar("S")

_HELP = """\
usage: rumi run TASK [options]

Carry out a task in simulation. `rumi run TASK --help` lists all its settings with their defaults. The tasks:

"""

# what the words and numbers of a rummaging run mean, for those who see them first
_GLOSSARY = """\
nll      how badly the belief explains where the object truly is; 0 is perfect, needs the truth
expects  the nll that the belief expects of itself, without the truth: small where its poses agree
apc      mean distance between the object's surfaces at the poses still believed
ess      how many of the poses still count (effective sample size)
agree    seconds to compare the belief with itself, for expects and apc; score: with the truth
r        in figures: how well the arm reaches there, 1 fully; dotted lines are where r is so much
"""

_FIGURE = """\
look at  {folder}/overview.png: outlines are poses still believed, from the first view to the end;
         orange is where a touch would tell most; at the end the outlines should be one
"""


@dataclass(frozen=True)
class RunOptions(Generic[S]):
    """Options of `rumi run`.

    Attributes:
        settings: of the run.
        preset: where the settings start from.
        out: folder of the run; by default one in runs/, named after the settings, with a number where that is taken.
        figures: draw figures at the end, and write the viewer's recording where rerun-sdk is installed.
        explain: say at the end what was skipped, since the scene did not need it, and what that saved.
        glossary: say at the end what the numbers mean, as on a terminal.
        pushes: file of how the object slides: planned with if it is there, and at the end written anew with what this
            run's pushes told, so that the next run with the object starts where this one ended.
        view: show the run in the viewer Rerun while it goes on (extra `view`); without a display, in a browser.
        record: write what cameras and bubbles gave too, as raw streams: log.h5 in the run's folder.
    """

    settings: Annotated[S, tyro.conf.arg(name="")]
    preset: str = "default"
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    figures: bool = True
    explain: bool = False
    glossary: bool = False
    pushes: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    view: bool = False
    record: bool = False


def run(arguments: Sequence[str]) -> int:
    """`rumi run`: 0 if the run succeeded by its own rule, 1 if not, 2 for bad input, 130 after Ctrl-C."""
    if not arguments or arguments[0] in ("-h", "--help"):
        (sys.stdout if arguments else sys.stderr).write(_HELP + listing())
        return DONE if arguments else BAD_INPUT
    name, entry, options = parse(arguments)
    settings = options.settings if options.pushes is None else planned_with(options.settings, options.pushes, name)
    notes = entry.check(settings)
    if options.figures:
        optional("matplotlib", "A figure (--no-figures draws none)")
    if options.view:
        optional("rerun", "--view")
    if options.pushes is not None:
        check_writable(options.pushes)
    label = entry.label(settings)
    folder = options.out or free_folder(Path("runs") / label)
    prepare_folder(folder)
    for line in (f"{label}; writing to {folder}", *notes):
        say(line)
    result, account = _carried_out(name, entry, options, settings, folder)
    interrupted = result.stopped_by == "interrupted"
    if options.pushes is not None:
        keep_learnt(folder, options.pushes, settings.seed)
    if options.figures and not interrupted:
        say("drawing figures")
        give_back()  # what the run is done with makes room
        entry.draw(load_run(folder), folder / "figures")
        keep(folder)
    first, *lines = entry.summary(settings, result)
    sys.stdout.write("\n  ".join([f"{name}: {first}", *lines, f"folder   {folder}"]) + "\n")
    if (options.glossary or sys.stdout.isatty()) and not entry.records:  # of those that rummage
        drawn = _FIGURE.format(folder=folder / "figures") if options.figures and not interrupted else ""
        sys.stdout.write("".join(f"  {line}\n" for line in (drawn + _GLOSSARY).splitlines()))
    if options.explain:
        sys.stdout.write(explain(account))
    if interrupted:
        return INTERRUPTED
    return DONE if entry.success(result) else NOT_CONVERGED


def _carried_out(
    name: str,
    entry: TaskEntry[Any],
    options: "RunOptions[Any]",
    settings: Any,  # noqa: ANN401  (the task's)
    folder: Path,
) -> tuple[Any, skipped_work.Account]:
    """Result of a run, and the account of skipped work; all else that it was made of is let go of."""
    with (
        remove_if_empty_on_error(folder),
        entry.build(settings, cache_dir=cache_folder()) as parts,
        entry.recorder(folder, settings, parts, log=options.record) as recorder,
        skipped_work.account() as account,
    ):
        if options.pushes is not None:
            level_rummager(parts.agent, name)
        announce(parts.agent)
        steps = entry.steps(settings)
        about = entry.as_dict(settings)
        with (
            Progress(name, steps, entry.describe) as progress,
            kernels_ahead(parts.task, parts.agent, about) as compiled,
            live_view(folder, entry, parts.agent, about) if options.view else nullcontext() as view,
        ):
            on_step = both(recorder, progress, Decisions(account), compiled, *([view] if view else []))
            result = loop.run(*parts, seed=settings.seed, steps=steps, on_step=on_step)
        recorder.finish(result)
    return result, account


def live_view(folder: Path, entry: TaskEntry[Any], agent: Any, about: dict[str, Any]) -> "LiveView":  # noqa: ANN401
    """The viewer of a run that goes on."""
    from rumi.runs.folder import Run
    from rumi.tasks.rummage.geometry import geometry_of
    from rumi.viz.live import LiveView

    begun = Run(folder, about, geometry_of(agent), [], result=None, ended=None)
    return LiveView(str(folder), entry.view(begun), lambda steps: entry.pose(replace(begun, steps=steps)))


def parse(
    arguments: Sequence[str],
    command: str = "run",
    kind: Any = RunOptions,  # noqa: ANN401  (a generic dataclass)
) -> tuple[str, TaskEntry[Any], Any]:
    """The task of a command line, by its name, and the options; the settings start from the preset asked for.

    Args:
        arguments: of the command, the task's name first.
        command: its name.
        kind: of the options, of which the first two are `settings` and `preset`.

    Raises:
        UsageError: there is no such task or preset, or a setting that cannot be.
        SystemExit: for all else that is wrong, after a message, and for help.
    """
    name = arguments[0]
    if name.startswith("-"):
        raise UsageError(f"Expected the task first, as in `rumi {command} mug-0 {' '.join(arguments[:2])}`, got {name}")
    if name in FORMER_NAMES:
        say(f"the task {name} is now {FORMER_NAMES[name]}")
        name = FORMER_NAMES[name]
    entry = TASKS[name]
    # the settings start from a preset and conditions, which have to be known before their flags are read
    asked, _ = tyro.cli(
        _Start, args=arguments[1:], default=_Start(entry.presets[0]), add_help=False, return_unknown_args=True
    )
    start = entry.preset(asked.preset)
    if asked.conditions is not None and isinstance(start, Settings):
        start = under_conditions(start, asked.conditions)
    options = tyro.cli(
        kind[entry.settings],
        prog=f"rumi {command} {name}",
        description=f"{entry.description}. The presets are {', '.join(entry.presets)}.",
        args=arguments[1:],
        default=kind(start, asked.preset),
        registry=FLAGS,
    )
    return name, entry, options


def planned_with(settings: S, file: Path, task: str) -> S:
    """Settings whose planner draws push parameters of a file, if it is there."""
    planner = getattr(settings, "planner", None)
    if planner is None or not hasattr(planner, "push_parameters"):
        raise UsageError(f"Expected a task that rummages with --pushes, got {task}")
    if not file.exists():
        return settings
    return replace(settings, planner=replace(planner, push_parameters=str(file)))  # type: ignore[type-var]


def keep_learnt(folder: Path, file: Path, seed: int) -> None:
    """Write what a run's pushes told of the object, or say why they told nothing."""
    from rumi.dynamics.push_posterior import PushPosterior

    before = PushPosterior.load(file) if file.exists() else PushPosterior.prior()
    try:
        found, _, after = learnt(load_run(folder), before, seed=seed)
    except UsageError as error:
        say(f"no push parameters were learnt: {error}")
        return
    with whole_file(file) as aside:
        after.save(aside)
    say(f"{len(found)} pushes learnt from; {file}")


@dataclass(frozen=True)
class _Start:
    """The options that decide what the others start from."""

    preset: str
    conditions: str | None = None
