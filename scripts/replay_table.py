"""Record runs, replay their logs, and say whether the beliefs are the same and how long it takes.

    python scripts/replay_table.py run --tasks mug-0 shelf-mug shelf-box --seeds 1000
    python scripts/replay_table.py show

Each run adds one line to scripts/results/replays.jsonl; those that are there are not run again.
"""

import json
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from rumi import loop
from rumi.cli import script
from rumi.runs.folder import RunRecorder, provenance
from rumi.runs.jsonlines import append_line, read_lines
from rumi.runs.recorded import RunLog
from rumi.runs.replay import replay
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset, to_dict

RESULTS = Path(__file__).parent / "results" / "replays.jsonl"


@dataclass(frozen=True)
class Run:
    """Record and replay.

    Attributes:
        tasks: of the runs.
        seeds: of each task.
        steps: actions at most.
        threads: of torch and the compiled kernels.
        cache: folder for what takes long to work out.
    """

    tasks: tuple[str, ...] = ("mug-0", "shelf-mug", "shelf-box")
    seeds: tuple[int, ...] = (1000,)
    steps: int = 15
    threads: int = 1
    cache: Path = field(default_factory=lambda: Path.home() / ".cache" / "rumi")


@dataclass(frozen=True)
class Show:
    """Print the table."""


def record_and_replay(task_name: str, seed: int, options: Run) -> dict[str, object]:
    """One run, and its replay from the file alone."""
    settings = preset("default", task=task_name, seed=seed, steps=options.steps)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        task, rummager = build(settings, cache_dir=options.cache)
        start = time.perf_counter()
        with RunRecorder(path, to_dict(settings)) as log:
            live = loop.run(task, rummager, seed=seed, steps=options.steps, on_step=log)
            log.finish(live)
        live_s = time.perf_counter() - start
        task.close()
        entry, opened = TASKS[task_name], RunLog(path)
        taken, again = opened.taken(), entry.from_dict(opened.settings)
        done = replay(taken, entry.agent(again, cache_dir=options.cache), seed=again.seed)
        size = (path / "trace.npz").stat().st_size
    return {
        "task": task_name,
        "seed": seed,
        "steps": live.steps,
        "contacts": live.contacts,
        "readings": len(taken),
        "same": sum(same is True for same in done.same),
        "robot_s": done.robot_s,
        "live_s": live_s,
        "replay_s": done.wall_s,
        "log_mb": size / 1e6,
        "threads": options.threads,
        "made_with": provenance(),
    }


def table() -> str:
    """The results as text."""
    lines = [
        "task        seed  actions  contacts  same beliefs  robot s  live s  replay s  times as fast as robot  log MB"
    ]
    for one, _ in read_lines(RESULTS):
        same, faster = f"{one['same']} of {one['readings']}", one["robot_s"] / one["replay_s"]
        lines.append(
            f"{one['task']:<10} {one['seed']:>5} {one['steps']:>8} {one['contacts']:>9} {same:>13}"
            f" {one['robot_s']:>8.1f} {one['live_s']:>7.1f} {one['replay_s']:>9.2f} {faster:>23.1f}"
            f" {one['log_mb']:>7.1f}"
        )
    return "\n".join(lines)


def main(options: Run) -> None:
    """Carry out what is not there yet."""
    torch.set_num_threads(options.threads)
    there = {(one["task"], one["seed"], one["threads"]) for one, _ in read_lines(RESULTS)}
    for task in options.tasks:
        for seed in options.seeds:
            if (task, seed, options.threads) not in there:
                found = record_and_replay(task, seed, options)
                append_line(RESULTS, found)
                print(json.dumps(found))


def command() -> None:
    """Run or show."""
    asked = tyro.cli(Annotated[Run, tyro.conf.subcommand("run")] | Annotated[Show, tyro.conf.subcommand("show")])
    if isinstance(asked, Run):
        main(asked)
    print(table())


if __name__ == "__main__":
    script(command)
