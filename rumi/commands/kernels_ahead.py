"""Kernels ahead: another process compiles what a first plan needs while this one takes the first view in."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import torch

from rumi.belief.particles import PoseBelief
from rumi.cache import cache_folder
from rumi.clock import Clock
from rumi.planning.policy import PlanRequest, Scene
from rumi.runs.folder import json_text
from rumi.runs.progress import say
from rumi.seeding import split
from rumi.task import StepResult
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.evaluation import evaluate_step
from sdf import compiled, se3, threads
from sensors.observation import Observation

_MODULE = "rumi.commands.kernels_ahead"


@contextmanager
def kernels_ahead(agent: object, settings: dict[str, Any]) -> Iterator[Callable[[Any], None]]:
    """Within the block a process compiles, if need be; gives an `on_step` that waits for it, after the first view.

    Where that process fails nothing is lost: each kernel is compiled at its first use then.

    Args:
        agent: whose first plan it is.
        settings: of the run, as its folder keeps them.
    """
    helper = None
    if isinstance(agent, Rummager) and threads.cores() > 1 and not _kept(agent):
        say("compiling for this processor, in two processes (once)")
        helper = subprocess.Popen(
            [sys.executable, "-m", _MODULE], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        assert helper.stdin is not None
        with suppress(BrokenPipeError), helper.stdin:  # it may have ended already
            helper.stdin.write(json_text(settings).encode())

    def wait(_: object) -> None:
        if helper is not None:
            helper.wait()

    try:
        yield wait
    finally:
        if helper is not None and helper.poll() is None:
            helper.terminate()
            helper.wait()


def _kept(agent: Rummager) -> bool:
    """Whether the rollouts of the scene's push model are compiled already, or never will be."""
    if not compiled.available() or agent.model.surface_points.device.type != "cpu":
        return True
    if agent.tool.spatial:
        from rumi.dynamics.displacement_numba import push_rollouts
    else:
        from rumi.dynamics.quasi_static_numba import push_rollouts
    return push_rollouts.kept


def compile_for(settings: dict[str, Any]) -> None:
    """Judge and plan from a belief of a few poses, which compiles what a run of these settings needs for it."""
    entry = TASKS[settings["task"]]
    made = entry.from_dict(settings)
    parts = entry.build(made, cache_dir=cache_folder())
    try:
        rummager, result = parts.agent, StepResult.of(parts.task.reset(made.seed))
    finally:
        parts.task.close()
    middle = rummager.workspace.points.mean(0)
    poses = se3.from_planar(torch.cat((middle[:2], middle.new_zeros(1)))[None].repeat(4, 1), rummager.height_m)
    belief = PoseBelief.uniform(poses)
    evaluate_step(rummager, Clock(), (), result, belief, Observation.empty(dtype=middle.dtype, device=middle.device))
    scene = Scene(rummager.model, rummager.workspace, rummager.tool, result.reading.configuration)
    rummager.policy.act(PlanRequest(belief, scene, generator=split(0, "ahead")))


if __name__ == "__main__":
    compile_for(json.load(sys.stdin))
