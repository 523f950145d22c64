"""Runs by what the planner's pushes are drawn from: how many end right, after how many actions, in what time.

python -m scripts.push_parameters run --seeds 1000-1002     # again to go on
python -m scripts.push_parameters show

Tasks are the mugs, drills and boxes (which the displacement model pushes, so that nothing may change), and some of the
first-day objects, whose motion is measured or not ("no sensor").
"""

import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rumi import loop
from rumi.agent import stop_reason
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import DegenerateBeliefError
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import Experiment, Line
from scripts.first_day import outcome
from scripts.first_day import settings_of as first_day_settings
from scripts.reproduce.cells import rate, table
from scripts.reproduce.intervals import bootstrap_mean

CHOICES: dict[str, tuple[float, float] | float] = {
    "lever 1.5 friction 0.5": (0.5, 1.5),
    "lever 1.0 friction 0.2": (0.2, 1.0),
    "prior of pads, learnt in the run": 0.5,
    "prior of a steel tip, learnt in the run": 0.22,
}
"""By what a table calls them: friction and lever ratio, or the median friction of a prior."""

OBJECTS = (
    "L-bracket in mm",
    "bottle with handle",
    "spray bottle",
    "hammer, lying",
    "can",
    "ball",
    "thin post",
    "drill",
)
"""Of a first day: those that runs are not refused of, each kind once."""

MUGS, SPATIAL = ("mug-0", "mug-1", "mug-2"), ("drill-0", "drill-1", "box-0", "box-1")
NO_SENSOR = ", no sensor"
GROUPS = {
    "mugs": MUGS,
    "drills and boxes, a tool in space": SPATIAL,
    "first-day objects, motion measured": OBJECTS,
    "first-day objects, no sensor": tuple(name + NO_SENSOR for name in OBJECTS),
}
TASKS = tuple(task for tasks in GROUPS.values() for task in tasks)


def settings_of(choice: str, task: str, seed: int, folder: Path) -> Settings:
    """Settings of a run; the mesh of a first-day object is written into a folder."""
    if task in (*MUGS, *SPATIAL):
        own = preset(task=task, seed=seed, conditions="ideal", **{"filter.motion": "measured"})
    else:
        motion = "trajectory" if task.endswith(NO_SENSOR) else "measured"
        own = first_day_settings(task.removesuffix(NO_SENSOR), motion, seed, folder)
    numbers = CHOICES[choice]
    if isinstance(numbers, float):
        pushes = replace(own.planner.quasi_static, friction=numbers)
        return replace(own, planner=replace(own.planner, push_parameters="prior", quasi_static=pushes))
    pushes = replace(own.planner.quasi_static, friction=numbers[0], lever_ratio=numbers[1])
    return replace(own, planner=replace(own.planner, push_parameters="fixed", quasi_static=pushes))


def measure(choice: str, task: str, seed: int) -> dict[str, Any]:
    """A run's end, and the processor's seconds of all but setting it up."""
    with tempfile.TemporaryDirectory() as folder:
        settings = settings_of(choice, task, seed, Path(folder))
        parts = build(settings, cache_dir=cache_folder())
    begun = time.process_time()
    try:
        result = loop.run_to_end(parts.task, parts.agent, seed=settings.seed, steps=parts.agent.steps)
    except DegenerateBeliefError:
        found: dict[str, Any] = {"right": False, "stopped_by": "degenerate", "steps": 0, "outcome": "unsure"}
    else:
        names = ("right", "stopped_by", "steps", "position_error_mm", "rotation_error_deg")
        found = {name: getattr(result, name) for name in names} | {"outcome": outcome(parts.agent, result)}
    finally:
        parts.task.close()
    return found | {"cpu_s": time.process_time() - begun}


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """By kind of task, a row for each choice but the first, beside the first over the runs that both have done."""
    first, *others = chosen.get("choice", tuple(CHOICES))
    rows = []
    for group, tasks in GROUPS.items():
        runs = {(line["choice"], line["task"], line["seed"]): line for line in lines if line["task"] in tasks}
        for other in others:
            shared = [key[1:] for key in runs if key[0] == first and (other, *key[1:]) in runs]
            pair = [[runs[choice, *key] for key in shared] for choice in (first, other)]
            if shared:
                rows += [
                    [group, choice, *_cells(own), more]
                    for choice, own, more in zip((first, other), pair, ("-", _more(*pair)), strict=True)
                ]
    heads = (
        "tasks",
        "pushes",
        "sure and right",
        "sure and wrong",
        "actions, mean",
        "processor s an action",
        "more actions",
    )
    return table(heads, rows)


def _cells(own: list[Line]) -> list[str]:
    sure = [line for line in own if stop_reason(line["stopped_by"]) == "sure"]
    found = sum(_found(line) for line in sure)
    steps = sum(line["steps"] for line in own)
    seconds = sum(line["cpu_s"] for line in own) / max(1, steps)
    share = rate([_found(line) and line in sure for line in own])
    return [share, str(len(sure) - found), f"{steps / len(own):.1f}", f"{seconds:.2f}"]


def _found(line: Line) -> bool:
    """By the pose, modulo the object's symmetries; of the mugs' earlier lines by what the run says."""
    return bool(line["outcome"] == "found" if "outcome" in line else line["right"])


def _more(first: list[Line], other: list[Line]) -> str:
    """Actions that the second took beyond the first, paired, with a 95 % interval (bootstrap over runs)."""
    off = [float(b["steps"] - a["steps"]) for a, b in zip(first, other, strict=True)]
    return "{:+.1f} [{:+.1f}, {:+.1f}]".format(*bootstrap_mean(off))


EXPERIMENT = Experiment(
    __doc__,
    "push_parameters.jsonl",
    {"task": TASKS, "choice": tuple(CHOICES)},
    measure,
    show,
    seeds="1000-1002",
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
