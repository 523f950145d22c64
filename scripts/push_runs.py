"""Whole runs of the rummaging tasks by push model: how many end right, after how many actions, in what time.

python scripts/push_runs.py run --seeds 1000-1004                          # mugs and drills; again to go on
python scripts/push_runs.py run --models mujoco --tasks mug-0 --seeds 1000 --seconds 110
python scripts/push_runs.py show
"""

import statistics
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro

from rumi import loop
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import DegenerateBeliefError
from rumi.metrics.intervals import wilson
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import Settings, preset
from scripts.bench.ledger import Ledger
from scripts.reproduce.code import code_hash
from scripts.reproduce.seeds import seeds_of

RESULTS = Path(__file__).resolve().parent / "results" / "push_runs.jsonl"
PART = "push-run"
TASKS = ("mug-0", "mug-1", "mug-2", "drill-0", "drill-1", "drill-2")
MODELS = ("displacement", "quasi-static", "displacement, few", "quasi-static, few", "mujoco")
"""Those with few samples plan as `mujoco` does."""
SAMPLES, HORIZON, KNOTS, ROLLOUTS = 20, 6, 4, 2


@dataclass(frozen=True)
class Options:
    """What is done.

    Attributes:
        what: run what is missing, or show what there is.
        models: which.
        tasks: which.
        seeds: of the runs; tuning starts from 1000.
        seconds: end after this long; give the command again to go on.
        results: file of the results.
    """

    what: tyro.conf.Positional[Literal["run", "show"]]
    models: tuple[str, ...] = MODELS
    tasks: tuple[str, ...] = TASKS
    seeds: str = "1000-1004"
    seconds: float = float("inf")
    results: Path = RESULTS


def settings_of(model: str, task: str, seed: int) -> Settings | None:
    """Settings of a run; None where the model cannot push what the task has."""
    name, _, few = model.partition(", ")
    own, spec = preset(task=task, seed=seed), find_task(task)
    if name == "quasi-static" and spec.spatial:
        return None
    planner = replace(own.planner, push_model=name)
    if few or name == "mujoco":
        mppi = replace(planner.mppi, samples=SAMPLES, horizon=HORIZON, knots=KNOTS)
        planner = replace(planner, mppi=mppi, rollouts=ROLLOUTS)
    if name == "mujoco":
        planner = replace(planner, engine=replace(planner.engine, mass_kg=spec.physics.mass_kg))
    return replace(own, planner=planner)


def carry_out(settings: Settings) -> dict[str, Any]:
    """A run's end, and the processor's seconds of all but setting it up."""
    parts, spec = build(settings, cache_dir=cache_folder()), find_task(settings.task)
    begun, wall = time.process_time(), time.perf_counter()
    try:
        result = loop.run(parts.task, parts.agent, seed=settings.seed, steps=spec.steps)
    except DegenerateBeliefError:
        found: dict[str, Any] = {"right": False, "stopped_by": "degenerate"}
    else:
        found = {
            "right": result.right,
            "stopped_by": result.stopped_by,
            "steps": result.steps,
            "position_error_mm": result.position_error_mm,
            "rotation_error_deg": result.rotation_error_deg,
        }
    finally:
        parts.task.close()
    return found | {"cpu_s": time.process_time() - begun, "wall_s": time.perf_counter() - wall}


def run(options: Options) -> None:
    """All runs that the file does not hold."""
    begun, ledger = time.monotonic(), Ledger(options.results)
    code = code_hash(("rumi.tasks.rummage.build", "rumi.loop"))
    for seed in seeds_of(options.seeds):
        for task in options.tasks:
            for model in options.models:
                if time.monotonic() - begun > options.seconds:
                    return
                settings = settings_of(model, task, seed)
                if settings is None:
                    continue
                asked = {"part": PART, "model": model, "task": task, "seed": seed, "code": code}
                if ledger.measure(asked, partial(carry_out, settings)):
                    sys.stderr.write(f"seed {seed}, {task}, {model}\n")


def show(options: Options) -> str:
    """Markdown: a table for each object, and one over the tasks and seeds that all its models have done."""
    seeds = set(seeds_of(options.seeds))
    lines = {
        (line["model"], line["task"], line["seed"]): line
        for line in Ledger(options.results).of(PART)
        if line["seed"] in seeds and line["model"] in options.models and line["task"] in options.tasks
    }
    parts = []
    for kind in dict.fromkeys(task.partition("-")[0] for task in options.tasks):
        own = {key: line for key, line in lines.items() if key[1].startswith(kind)}
        models = [model for model in options.models if any(key[0] == model for key in own)]
        if not models:
            continue
        shared = set.intersection(*({key[1:] for key in own if key[0] == model} for model in models))
        rows = [_row(model, (line for key, line in own.items() if key[0] == model)) for model in models]
        alike = [_row(m, (line for key, line in own.items() if key[0] == m and key[1:] in shared)) for m in models]
        parts.append("\n".join([f"{kind}s, all runs", "", *_HEAD, *rows]))
        if shared and len(models) > 1:
            parts.append("\n".join([f"{kind}s, the {len(shared)} runs that all have done", "", *_HEAD, *alike]))
    return "\n\n".join(parts)


_HEAD = (
    "| push model | right | actions, median | stopped by itself: right | processor s a run | s an action |",
    "|---|---|---|---|---|---|",
)


def _row(model: str, found: Iterable[dict[str, Any]]) -> str:
    lines = list(found)
    right, done = sum(line["right"] for line in lines), [line for line in lines if "steps" in line]
    low, high = wilson(right, len(lines))
    sure = [line["right"] for line in lines if line["stopped_by"] not in ("steps", "degenerate")]
    whole = sum(line["cpu_s"] for line in done)
    actions = f"{statistics.median(line['steps'] for line in done):g}" if done else "-"
    each = f"{whole / max(1, sum(line['steps'] for line in done)):.2f}"
    return (
        f"| {model} | {right}/{len(lines)} [{low:.2f}, {high:.2f}] | {actions} | {sum(sure)}/{len(sure)} | "
        f"{whole / max(1, len(done)):.1f} | {each} |"
    )


def main() -> None:
    """Run or show."""
    options = tyro.cli(Options, description=__doc__)
    for asked, known in ((options.models, MODELS), (options.tasks, TASKS)):
        for name in asked:
            if name not in known:
                raise SystemExit(f"There is no {name!r}; there are {', '.join(known)}")
    if options.what == "run":
        run(options)
    sys.stdout.write(show(options) + "\n")


if __name__ == "__main__":
    script(main)
