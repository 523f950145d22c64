"""The functions of `import rumi` that take a whole run in hand: make its parts, carry it out, draw it, replay it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from rumi import loop
from rumi.agent import Agent, Parts
from rumi.errors import UsageError
from rumi.runs.folder import RunRecorder, load_run, make_folder
from rumi.runs.progress import announce, both
from rumi.runs.recorded import RunLog
from rumi.runs.replay import Replayed
from rumi.runs.replay import replay as take_in
from rumi.seeding import check_seed, check_steps
from rumi.task import Task, TaskOnDevice
from rumi.tasks.registry import TASKS, entry_of, entry_of_record
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.geometry import geometry_of
from rumi.tasks.rummage.settings import Settings
from rumi.tasks.touch_box.agent import Toucher


def build(settings: Any, *, cache_dir: Path | None = None) -> Parts[Any, Any]:  # noqa: ANN401  (of any task)
    """Task and agent of a run; a context manager that closes the task.

    Args:
        settings: of a run of any task, such as `preset` gives.
        cache_dir: folder that keeps what takes seconds to work out; None keeps nothing.

    Raises:
        UsageError: these are no settings, there is no such task, or a setting does not suit it.
    """
    if isinstance(settings, Settings):
        entry = TASKS[settings.task]
    else:
        fits = (TASKS[name] for name in TASKS if isinstance(settings, TASKS[name].settings))
        found = next(fits, None)
        if found is None:
            raise UsageError(f"Expected settings, as rumi.preset(task='mug-0') gives, got {settings!r}")
        entry = found
    entry.check(settings)
    parts = entry.build(settings, cache_dir=cache_dir)
    about, agent = entry.as_dict(settings), parts.agent
    if isinstance(agent, Toucher):
        agent.about = about
        return parts
    return Parts(parts.task, replace(agent, about=about))


def run(
    task: Task,
    agent: Agent[Any],
    *,
    seed: int,
    steps: int | None = None,
    folder: Path | str | None = None,
    on_step: Callable[[Any], None] = lambda record: None,
) -> Any:  # noqa: ANN401  (the agent's own result)
    """Let an agent do a task (`rumi.loop.run`), and keep the run in a folder where one is named.

    Says on stderr what the run relies on, and what is not measured and may make its belief sure and wrong.

    Args:
        task: a simulator, hardware or a log.
        agent: what it believes and does.
        seed: of all randomness.
        steps: actions at most; None for as many as the agent allows itself.
        folder: of the run, for `load_run`, `plot` and `replay`; it must hold no run.
        on_step: called with the record of every step, the first reading's included.

    Returns:
        the agent's `result`; of one that finds a pose, `pose` and `belief` hold it, `why_not` says why it is not sure.

    Raises:
        UsageError: the seed or the number of steps cannot be, or the folder cannot be written or holds a run.
    """
    check_seed(seed)
    check_steps(steps)
    announce(agent)
    task = _beside(task, agent)
    if folder is None:
        return loop.run(task, agent, seed=seed, steps=steps, on_step=on_step)
    asked = {**getattr(agent, "about", {}), "seed": seed}
    with RunRecorder(folder, asked, geometry_of(agent)) as recorder:
        result = loop.run(task, agent, seed=seed, steps=steps, on_step=both(recorder, on_step))
        recorder.finish(result)
    return result


def replay(folder: Path | str, agent: Agent[Any] | None = None, *, cache_dir: Path | None = None) -> Replayed:
    """Take in a run's readings again: with the same settings on the same machine the same beliefs, bit for bit.

    Args:
        folder: of the run.
        agent: whose belief follows the readings; by default the run's own.
        cache_dir: folder that keeps what takes seconds to work out; None keeps nothing.

    Raises:
        UsageError: it is no run's folder, or of an agent that no task here has.
    """
    recorded = RunLog(folder)
    if agent is None:
        entry = entry_of_record(recorded.settings["task"])
        agent = entry.agent(entry.from_dict(recorded.settings), cache_dir=cache_dir)
    whose = agent
    return take_in(recorded.taken(), agent, seed=int(recorded.settings["seed"]), wrap=lambda task: _beside(task, whose))


def _beside(task: Task, agent: Agent[Any]) -> Task:
    """A robot's task, with its readings on the device and in the dtype of what the agent believes."""
    if not isinstance(agent, Rummager) or isinstance(task, TaskOnDevice):
        return task
    where = agent.model.surface_points
    same = where.device.type == "cpu" and where.dtype == torch.float32
    return task if same else TaskOnDevice(task, where.device, where.dtype)


def plot(folder: Path | str, out: Path | str | None = None, steps: Sequence[int] | None = None) -> list[Path]:
    """Draw the figures of a run; their files.

    Args:
        folder: of the run, also of one that goes on or was interrupted.
        out: folder of the figures; by default `figures` in the run's.
        steps: scenes to draw; by default the telling ones.

    Raises:
        UsageError: it is no run's folder, the figures' folder cannot be written, or matplotlib is missing.
    """
    read = load_run(folder)
    drawn = Path(out) if out is not None else read.folder / "figures"
    make_folder(drawn)
    return list(entry_of(read).draw(read, drawn, steps))
