"""Kernels ahead: copies of the process compile what a first action needs, while the first view is taken in and then."""

import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch

from rumi.belief.particles import PoseBelief
from rumi.cache import cache_folder
from rumi.clock import Clock
from rumi.planning.on_device import PolicyOnDevice
from rumi.planning.policy import PlanRequest, Scene
from rumi.records import StepRecord
from rumi.runs.progress import say
from rumi.seeding import split
from rumi.task import StepResult, Task
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.evaluation import evaluate_step
from sdf import compiled, se3, threads
from sensors.observation import Observation

COPIES = sys.platform == "linux"
"""Whether a process can be copied as it is, by a fork; on macOS its libraries do not bear that."""

_LONGEST_S = 120.0


@contextmanager
def kernels_ahead(task: Task, agent: object, settings: dict[str, Any]) -> Iterator[Callable[[Any], None]]:
    """Within the block others compile, if need be; gives an `on_step` that waits for them, after the first view.

    A copy judges a belief and plans, meanwhile; another takes a reading in while this process waits. Where there are no
    copies a new process does the former. Where one fails nothing is lost: each kernel is compiled at its first use.

    Args:
        task: the run's, in simulation.
        agent: whose first plan it is.
        settings: of the run, as its folder keeps them.
    """
    helpers = list[BaseProcess]()
    if isinstance(agent, Rummager) and threads.cores() > 1 and not _kept(agent):
        say("compiling for this processor, in two processes (once)")
        helpers.append(_started(judge_and_plan, task, agent) if COPIES else _started(build_and_plan, settings))

    def wait(record: Any) -> None:  # noqa: ANN401  (of any agent's step)
        if not helpers or record.step > 0:
            return
        if COPIES and isinstance(agent, Rummager):
            helpers.append(_started(take_in, task, agent, record))
        for helper in helpers:
            helper.join(_LONGEST_S)

    try:
        yield wait
    finally:
        for helper in helpers:
            helper.terminate()
            helper.join()


def _kept(agent: Rummager) -> bool:
    """Whether the rollouts of the scene's push model are compiled already, or never will be."""
    if not compiled.available() or isinstance(agent.policy, PolicyOnDevice):  # of which no copy of a process may know
        return True
    if agent.tool.spatial:
        from rumi.dynamics.displacement_numba import push_rollouts
    else:
        from rumi.dynamics.quasi_static_numba import push_rollouts
    return push_rollouts.kept


def _started(work: Callable[..., None], *arguments: Any) -> BaseProcess:  # noqa: ANN401  (of the work)
    """A process that does some work and says nothing."""
    context: Any = multiprocessing.get_context("fork" if COPIES else "spawn")
    process: BaseProcess = context.Process(target=_alone, args=(work, *arguments), daemon=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads that a copy lacks, of which it asks nothing
        process.start()
    return process


def _alone(work: Callable[..., None], *arguments: Any) -> None:  # noqa: ANN401
    """Do some work in one thread and silence; a copy of a process has none of its other threads."""
    with Path(os.devnull).open("w") as silence, threads.using(1):
        sys.stdout = sys.stderr = silence
        for stream in (1, 2):  # which libraries write to
            os.dup2(silence.fileno(), stream)
        work(*arguments)


def judge_and_plan(task: Task, rummager: Rummager, seed: int = 0) -> None:
    """Judge and plan from a belief of a few poses, which compiles what a run needs for it.

    Args:
        task: begun anew.
        rummager: who judges and plans.
        seed: of the task.
    """
    result = StepResult.of(task.reset(seed))
    middle = rummager.workspace.points.mean(0)
    poses = se3.from_planar(torch.cat((middle[:2], middle.new_zeros(1)))[None].repeat(4, 1), rummager.height_m)
    belief = PoseBelief.uniform(poses)
    evaluate_step(rummager, Clock(), (), result, belief, Observation.empty(dtype=middle.dtype, device=middle.device))
    scene = Scene(rummager.model, rummager.workspace, rummager.tool, result.reading.configuration)
    rummager.policy.act(PlanRequest(belief, scene, generator=split(0, "ahead")))


def build_and_plan(settings: dict[str, Any]) -> None:
    """The same for a run of these settings, which is built for it."""
    entry = TASKS[settings["task"]]
    made = entry.from_dict(settings)
    with entry.build(made, cache_dir=cache_folder()) as parts:
        judge_and_plan(parts.task, parts.agent, made.seed)


def take_in(task: Task, rummager: Rummager, record: StepRecord) -> None:
    """Stand still for an action and take the reading in.

    Args:
        task: after the first view.
        rummager: who takes it in.
        record: of the first view.
    """
    result = StepResult.of(task.step(torch.zeros_like(record.reading.configuration)))
    rummager.filter(record.belief, record.added, result.reading, generator=split(0, "ahead"))
