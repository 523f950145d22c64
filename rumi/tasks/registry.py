"""The tasks by name, and what a task has to bring so that `rumi run` can carry it out."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol, Self, TypeVar, runtime_checkable

from rumi.agent import Agent, Parts
from rumi.errors import UsageError
from rumi.registration.pose_summary import PoseSummary
from rumi.registry import Table
from rumi.runs.folder import Run
from rumi.viz.task_view import TaskView

S = TypeVar("S")
Role = Literal["counted", "idle", "sensed"]
"""Of a setting to a replay: it changes the belief; it changes nothing, since what was done is recorded; or it decided
what was sensed, which no replay can change."""


@runtime_checkable
class Recorder(Protocol):
    """Writes a run's folder while the run goes on; a context manager that closes its files."""

    def __call__(self, record: Any) -> None:  # noqa: ANN401  (of the task's own kind)
        """Write a step."""
        ...

    def finish(self, result: Any) -> None:  # noqa: ANN401
        """Write how the run ended."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...


@runtime_checkable
class TaskEntry(Protocol[S]):
    """A task: a member of `TASKS`.

    Attributes:
        description: what there is to do, in a line.
        settings: dataclass of all that decides a run, the `seed` among it; each field is a flag of `rumi run`, nested
            ones with dots.
        presets: names that `preset` takes, first the one that counts where none is asked for.
        records: classes that the records of its steps are made of, for traces; none where they are `StepRecord`s.
    """

    description: str
    settings: type[S]
    presets: Sequence[str]
    records: Sequence[type]

    def preset(self, name: str) -> S:
        """The settings of a preset.

        Raises:
            UsageError: there is none of that name.
        """
        ...

    def label(self, settings: S) -> str:
        """Settings in few words, fit for a folder's name."""
        ...

    def check(self, settings: S) -> Sequence[str]:
        """Refuse settings that cannot be, before anything takes time; what a person should know before the run.

        Raises:
            UsageError: what was expected, and what came.
        """
        ...

    def steps(self, settings: S) -> int | None:
        """Actions at most; None where the agent alone decides."""
        ...

    def build(self, settings: S, *, cache_dir: Path | None = None) -> Parts[Any, Any]:
        """The task and its agent, for `rumi.loop.run`.

        Args:
            settings: of the run.
            cache_dir: folder that keeps what takes long to work out; None keeps nothing.
        """
        ...

    def recorder(self, folder: Path, settings: S, parts: Parts[Any, Any], *, log: bool) -> Recorder:
        """What writes the run's folder; with `log` also log.h5, for `rumi replay`."""
        ...

    def describe(self, record: Any) -> str:  # noqa: ANN401
        """A step in few words and numbers."""
        ...

    def success(self, result: Any) -> bool:  # noqa: ANN401
        """Whether the belief became sure and the last action, where the task has one, succeeded."""
        ...

    def summary(self, settings: S, result: Any) -> Sequence[str]:  # noqa: ANN401
        """Lines on how a run ended, for people; the first one goes behind the task's name."""
        ...

    def pose(self, run: Run) -> PoseSummary | None:
        """What the last belief of a recorded run knows of the object's pose, also of one that was cut short."""
        ...

    def as_dict(self, settings: S) -> dict[str, Any]:
        """Settings as settings.json has them: plain values or dataclasses, `task` and `seed` among them."""
        ...

    def from_dict(self, values: Mapping[str, Any]) -> S:
        """The settings of a settings.json.

        Raises:
            UsageError: they are none of this task.
        """
        ...

    def agent(self, settings: S, *, cache_dir: Path | None = None) -> Agent[Any]:
        """The agent alone, for replays: nothing of it simulates or plans where that can be helped."""
        ...

    def role(self, name: str) -> Role:
        """What a setting, named as its flag but with underscores, is to a replay."""
        ...

    def draw(self, run: Run, out: Path, steps: Sequence[int] | None = None) -> Sequence[Path]:
        """Draw the figures of a recorded run; their files.

        Args:
            run: as `rumi.runs.folder.load_run` gives it.
            out: folder of the figures; made if need be.
            steps: that have a figure of their own, where the task draws such; by default the telling ones.
        """
        ...

    def view(self, run: Run) -> TaskView:
        """What a viewer shows of a run's steps, by its settings and geometry; the run may have no step yet."""
        ...


TASKS: Table[TaskEntry[Any]] = Table("task", "rumi.tasks")
"""All tasks by name."""

TASKS.include("rumi.tasks.rummage.entry:ENTRIES")
TASKS.add("touch-box", "rumi.tasks.touch_box.entry:TOUCH_BOX")
TASKS.add("peg", "rumi.tasks.peg.entry:PEG")
TASKS.add("handle", "rumi.tasks.handle.entry:HANDLE")

FORMER_NAMES = {"fused": "handle"}
"""Names that tasks had before."""


OWN = "own"
"""What a run of a robot of one's own gives as its task."""

IMPORTED = "recording"
"""Task of a run that a log's replay wrote."""


def entry_of(run: Run) -> TaskEntry[Any]:
    """The task that a run is of; a recording that was imported is drawn as the first rummaging scene is."""
    return TASKS[run.task] if run.task in TASKS else next(TASKS[name] for name in TASKS)


def entry_of_record(name: str) -> TaskEntry[Any]:
    """The task that a recording names, also by a name that it had before.

    Raises:
        UsageError: there is no such task, or it was a robot of one's own, of which a folder holds no model, or a log.
    """
    if name == IMPORTED:
        raise UsageError("The run was made from a log, which no task here is: replay it by `rumi replay FOLDER`")
    if name == OWN:
        raise UsageError(
            "The run is of a robot of its own, whose model and tool no folder holds: replay it in Python by "
            "rumi.replay(folder, agent), with the agent of rumi.rummager(...)"
        )
    return TASKS[FORMER_NAMES.get(name, name)]


def check_preset(name: str, presets: Sequence[str]) -> None:
    """Refuse a preset that there is not.

    Raises:
        UsageError: with those that there are.
    """
    if name not in presets:
        raise UsageError(f"There is no preset {name!r}; the presets are {', '.join(presets)}")
