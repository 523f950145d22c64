"""Record runs, replay their logs, and say whether the beliefs are the same and how long it takes.

    python -m scripts.replay_table run --tasks mug-0 shelf-mug shelf-box --seeds 1000
    python -m scripts.replay_table show

Each run adds one line to scripts/results/replays.jsonl; those that are there are not run again.
"""

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rumi import loop
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.runs.folder import RunRecorder
from rumi.runs.recorded import RunLog
from rumi.runs.replay import replay
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset, to_dict
from scripts.experiment import Experiment, Line

STEPS = 15
"""Actions of a run at most."""


def measure(task: str, seed: int, threads: int) -> dict[str, Any]:
    """One run, and its replay from the file alone."""
    settings = preset("default", task=task, seed=seed, steps=STEPS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        world, rummager = build(settings, cache_dir=cache_folder())
        start = time.perf_counter()
        with RunRecorder(path, to_dict(settings)) as log:
            live = loop.run_to_end(world, rummager, seed=seed, steps=STEPS, on_step=log)
            log.finish(live)
        live_s = time.perf_counter() - start
        world.close()
        entry, opened = TASKS[task], RunLog(path)
        taken, again = opened.taken(), entry.from_dict(opened.settings)
        done = replay(taken, entry.agent(again, cache_dir=cache_folder()), seed=again.seed)
        size = (path / "trace.npz").stat().st_size
    return {
        "steps": live.steps,
        "contacts": live.contacts,
        "readings": len(taken),
        "same": sum(same is True for same in done.same),
        "robot_s": done.robot_s,
        "live_s": live_s,
        "replay_s": done.wall_s,
        "log_mb": size / 1e6,
    }


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """The results as text."""
    text = [
        "task        seed  actions  contacts  same beliefs  robot s  live s  replay s  times as fast as robot  log MB"
    ]
    for one in lines:
        same, faster = f"{one['same']} of {one['readings']}", one["robot_s"] / one["replay_s"]
        text.append(
            f"{one['task']:<10} {one['seed']:>5} {one['steps']:>8} {one['contacts']:>9} {same:>13}"
            f" {one['robot_s']:>8.1f} {one['live_s']:>7.1f} {one['replay_s']:>9.2f} {faster:>23.1f}"
            f" {one['log_mb']:>7.1f}"
        )
    return "\n".join(text)


EXPERIMENT = Experiment(
    __doc__,
    "replays.jsonl",
    {"task": ("mug-0", "shelf-mug", "shelf-box")},
    measure,
    show,
    seeds="1000",
    parameters={"threads": 1},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
