"""Whole runs of the rummaging tasks by push model: how many end right, after how many actions, in what time.

python -m scripts.push_runs run --seeds 1000-1004                          # mugs and drills; again to go on
python -m scripts.push_runs run --models mujoco --tasks mug-0 --seeds 1000 --seconds 110
python -m scripts.push_runs show
"""

import statistics
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from rumi import loop
from rumi.agent import stop_reason
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import DegenerateBeliefError
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import rate, table
from scripts.reproduce.code import code_of

PART = "push-run"
TASKS = ("mug-0", "mug-1", "mug-2", "drill-0", "drill-1", "drill-2")
MODELS = ("displacement", "quasi-static", "displacement, few", "quasi-static, few", "mujoco")
"""Those with few samples plan as `mujoco` does."""
SAMPLES, HORIZON, KNOTS, ROLLOUTS = 20, 6, 4, 2


def settings_of(model: str, task: str, seed: int) -> Settings | None:
    """Settings of a run; None where the model cannot push what the task has."""
    name, _, few = model.partition(", ")
    own, spec = preset(task=task, seed=seed, **{"filter.motion": "measured"}), find_task(task)
    if name == "quasi-static" and spec.spatial:
        return None
    planner = replace(own.planner, push_model=name)
    if few or name == "mujoco":
        mppi = replace(planner.mppi, samples=SAMPLES, horizon=HORIZON, knots=KNOTS)
        planner = replace(planner, mppi=mppi, rollouts=ROLLOUTS)
    if name == "mujoco":
        planner = replace(planner, engine=replace(planner.engine, mass_kg=spec.physics.mass_kg))
    return replace(own, planner=planner)


def measure(model: str, task: str, seed: int) -> dict[str, Any]:
    """A run's end, and the processor's seconds of all but setting it up."""
    settings, spec = settings_of(model, task, seed), find_task(task)
    assert settings is not None
    parts = build(settings, cache_dir=cache_folder())
    begun, wall = time.process_time(), time.perf_counter()
    try:
        result = loop.run_to_end(parts.task, parts.agent, seed=settings.seed, steps=spec.steps)
    except DegenerateBeliefError:
        found: dict[str, Any] = {"right": False, "stopped_by": "degenerate"}
    else:
        names = ("right", "stopped_by", "steps", "position_error_mm", "rotation_error_deg")
        found = {name: getattr(result, name) for name in names}
    finally:
        parts.task.close()
    return found | {"cpu_s": time.process_time() - begun, "wall_s": time.perf_counter() - wall}


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """A table for each object, and one over the tasks and seeds that all its models have done."""
    runs = {(line["model"], line["task"], line["seed"]): line for line in lines}
    parts = []
    for kind in ("mug", "drill"):
        own = {key: line for key, line in runs.items() if key[1].startswith(kind)}
        models = [model for model in chosen.get("model", MODELS) if any(key[0] == model for key in own)]
        if not models:
            continue
        shared = set.intersection(*({key[1:] for key in own if key[0] == model} for model in models))
        rows = [_row(model, (line for key, line in own.items() if key[0] == model)) for model in models]
        alike = [_row(m, (line for key, line in own.items() if key[0] == m and key[1:] in shared)) for m in models]
        parts.append(f"{kind}s, all runs\n\n{table(_HEADS, rows)}")
        if shared and len(models) > 1:
            parts.append(f"{kind}s, the {len(shared)} runs that all have done\n\n{table(_HEADS, alike)}")
    return "\n".join(parts)


_HEADS = ("push model", "right", "actions, median", "stopped by itself: right", "processor s a run", "s an action")


def _row(model: str, found: Iterable[Line]) -> list[str]:
    lines = list(found)
    done = [line for line in lines if "steps" in line]
    sure = [line["right"] for line in lines if stop_reason(line["stopped_by"]) not in ("steps", "degenerate")]
    whole = sum(line["cpu_s"] for line in done)
    actions = f"{statistics.median(line['steps'] for line in done):g}" if done else "-"
    each = f"{whole / max(1, sum(line['steps'] for line in done)):.2f}"
    right = rate([line["right"] for line in lines])
    return [model, right, actions, f"{sum(sure)}/{len(sure)}", f"{whole / max(1, len(done)):.1f}", each]


EXPERIMENT = Experiment(
    __doc__,
    "push_runs.jsonl",
    {"task": TASKS, "model": MODELS},
    measure,
    show,
    seeds="1000-1004",
    identity=lambda variant: {"part": PART, "code": code_of(PART)},
    possible=lambda variant: settings_of(**variant) is not None,
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
