"""Whole runs of the mug tasks by preset: what the settings come to in the end."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from rumi import loop
from rumi.cache import cache_folder
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import PRESETS, preset
from scripts.store import Figures, Store

TASKS = ("mug-0", "mug-1", "mug-2")


@dataclass(frozen=True)
class RunSettings:
    """One run.

    Attributes:
        task: its name.
        preset: of the settings.
        seed: of all randomness.
        steps: actions at most; None for the task's.
    """

    task: str
    preset: str
    seed: int
    steps: int | None = None


def run_settings(quick: bool) -> list[RunSettings]:
    """The runs that are compared."""
    if quick:
        return [RunSettings("mug-0", name, 1000, steps=2) for name in PRESETS]
    # what `paper` does on these tasks `rumi reproduce table5` says
    names = [name for name in PRESETS if name != "paper"]
    return [RunSettings(task, name, seed) for seed in range(1000, 1030) for task in TASKS for name in names]


def run_figures(run: RunSettings) -> Figures:
    """How a run ended and what it took."""
    settings = preset(run.preset, task=run.task, seed=run.seed, steps=run.steps)
    parts = build(settings, cache_dir=cache_folder())
    begun, busy = time.perf_counter(), time.process_time()
    try:
        steps = find_task(run.task).steps if run.steps is None else run.steps
        result = loop.run_to_end(parts.task, parts.agent, seed=run.seed, steps=steps)
    finally:
        parts.task.close()
    names = ("right", "actions", "stopped_by", "final_nll", "position_error_mm", "rotation_error_deg", "timings_s")
    figures = dict(result.as_dict())
    figures["actions"] = figures["steps"]
    took = {"seconds": time.perf_counter() - begun, "processor_s": time.process_time() - busy}
    return {name: figures[name] for name in names} | took


def measure_runs(store: Store, *, quick: bool) -> Iterator[bool]:
    """Do the runs that are missing."""
    for run in run_settings(quick):
        yield store.measure({"part": "run", **vars(run)}, partial(run_figures, run))
