"""Mug runs by what the planner's pushes are drawn from: how many end right, after how many actions, in what time.

python -m scripts.push_parameters run --seeds 1000-1002     # again to go on
python -m scripts.push_parameters show
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rumi import loop
from rumi.agent import stop_reason
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import DegenerateBeliefError
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import rate, table

CHOICES: dict[str, tuple[float, float] | float] = {
    "lever 1.5 friction 0.5": (0.5, 1.5),
    "lever 1.0 friction 0.2": (0.2, 1.0),
    "prior of pads, learnt in the run": 0.5,
    "prior of a steel tip, learnt in the run": 0.22,
}
"""By what a table calls them: friction and lever ratio, or the median friction of a prior."""

TASKS = ("mug-0", "mug-1", "mug-2")


def settings_of(choice: str, task: str, seed: int) -> Settings:
    """Settings of a run."""
    own, numbers = preset(task=task, seed=seed), CHOICES[choice]
    if isinstance(numbers, float):
        pushes = replace(own.planner.quasi_static, friction=numbers)
        return replace(own, planner=replace(own.planner, push_parameters="prior", quasi_static=pushes))
    pushes = replace(own.planner.quasi_static, friction=numbers[0], lever_ratio=numbers[1])
    return replace(own, planner=replace(own.planner, quasi_static=pushes))


def measure(choice: str, task: str, seed: int) -> dict[str, Any]:
    """A run's end, and the processor's seconds of all but setting it up."""
    settings = settings_of(choice, task, seed)
    parts = build(settings, cache_dir=cache_folder())
    begun = time.process_time()
    try:
        result = loop.run(parts.task, parts.agent, seed=settings.seed)
    except DegenerateBeliefError:
        found: dict[str, Any] = {"right": False, "stopped_by": "degenerate", "steps": 0}
    else:
        names = ("right", "stopped_by", "steps", "position_error_mm", "rotation_error_deg")
        found = {name: getattr(result, name) for name in names}
    finally:
        parts.task.close()
    return found | {"cpu_s": time.process_time() - begun}


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each choice but the first, beside the first over the runs that both have done."""
    first, *others = chosen.get("choice", tuple(CHOICES))
    runs = {(line["choice"], line["task"], line["seed"]): line for line in lines}
    rows = []
    for other in others or [first]:
        shared = [key[1:] for key in runs if key[0] == first and (other, *key[1:]) in runs]
        for choice in (first, other) if others else (first,):
            own = [runs[choice, *key] for key in shared]
            if not own:
                continue
            sure = [line["right"] for line in own if stop_reason(line["stopped_by"]) not in ("steps", "degenerate")]
            steps = sum(line["steps"] for line in own)
            cells = [f"{steps / len(own):.1f}", f"{sum(sure)}/{len(sure)}"]
            seconds = f"{sum(line['cpu_s'] for line in own) / max(1, steps):.2f}"
            rows.append([choice, rate([line["right"] for line in own]), *cells, seconds])
    return table(("pushes", "right", "actions, mean", "stopped by itself: right", "processor s an action"), rows)


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
