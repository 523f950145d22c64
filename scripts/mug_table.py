"""Run the mug tasks with every method and print the table; runs that are done are kept and not run again.

    python scripts/mug_table.py run --jobs 2        # resumes; one line a run in scripts/results/mugs.jsonl
    python scripts/mug_table.py show                # Markdown, with 95 % intervals
    python scripts/mug_table.py run --seeds 1000-1002 --out tuning.jsonl --set planner.rollouts=3

A run counts as done when its file holds a line of the same code, settings and seed. Tune on seeds of 1000 and more;
seeds 0-9 are for the record.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
import tyro
from tqdm import tqdm

from rumi.assemble import build
from rumi.config import Settings, from_dict, preset, to_dict
from rumi.loop import rummage
from rumi.metrics.intervals import bootstrap_median, mcnemar, wilson
from rumi.plain import plain
from rumi.sim.tasks import find_task

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "scripts" / "results" / "mugs.jsonl"
TASKS = ("mug-0", "mug-1", "mug-2")
COLUMNS = ("rumi/default", "rumi/fast", "rumi/paper", "info-only/default", "reach-only/default")


@dataclass(frozen=True)
class Run:
    """Do the runs that are missing.

    Attributes:
        columns: method/preset.
        tasks: which tasks.
        seeds: "0-9", or "3,5".
        jobs: processes at once, each with one thread.
        out: file of results, one JSON line a run.
        set: settings on top of the preset, such as planner.rollouts=3 (for tuning).
        label: written into the lines.
    """

    columns: tuple[str, ...] = COLUMNS
    tasks: tuple[str, ...] = TASKS
    seeds: str = "0-9"
    jobs: int = 2
    out: Path = RESULTS
    set: tuple[str, ...] = ()
    label: str = ""


@dataclass(frozen=True)
class Show:
    """Print the table of the newest code in a file of results, of all labels or of one."""

    results: Path = RESULTS
    label: str | None = None


_APART = ("cli", "commands", "explain", "progress", "recording", "trace", "packing", "sketch")
"""What shows and keeps a run, and does not change it."""


def code_hash() -> str:
    """Of all code that a run's figures depend on."""
    digest = hashlib.sha256()
    for package in ("sdf", "sensors", "kmppi", "rumi"):
        for path in sorted((ROOT / package).rglob("*.py")):
            if not {"viz", "bench"} & set(path.parts) and path.stem not in _APART:
                digest.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def commit() -> str:
    """The checkout's commit, with a + where files differ from it."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run(
        [*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    dirty = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=False).stdout.strip()
    return head + ("+" if dirty else "")


def settings_of(column: str, task: str, seed: int, changes: tuple[str, ...]) -> Settings:
    """The settings of one run."""
    method, name = column.split("/")
    values = to_dict(replace(preset(name), task=task, method=method, seed=seed))
    for change in changes:
        path, _, text = change.partition("=")
        *parents, last = path.split(".")
        inner = values
        for parent in parents:
            inner = inner[parent]
        if last not in inner:
            raise SystemExit(f"There is no setting {path}")
        try:
            inner[last] = json.loads(text)
        except json.JSONDecodeError:
            inner[last] = text
    return from_dict(values)


def settings_hash(settings: Settings) -> str:
    """Of all settings but the seed and the task; of a mesh by what is in it, not by where it lies."""
    values = {k: v for k, v in to_dict(settings).items() if k not in ("seed", "task")}
    if settings.object.mesh is not None:
        values["object"]["mesh"] = hashlib.sha256(Path(settings.object.mesh).read_bytes()).hexdigest()
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def one_run(settings: Settings) -> dict[str, Any]:
    """Carry out one run in a process of its own."""
    torch.set_num_threads(1)
    cache = Path(os.environ.get("RUMI_CACHE", Path.home() / ".cache" / "rumi"))
    parts = build(settings, cache_dir=cache)
    apc: list[float] = []
    nll: list[float | None] = []
    start = time.perf_counter()
    try:
        result = rummage(
            parts.task,
            parts.rummager,
            seed=settings.seed,
            steps=find_task(settings.task).steps if settings.steps is None else settings.steps,
            on_step=lambda record: (apc.append(record.apc), nll.append(record.nll)),  # type: ignore[func-returns-value]
        )
    finally:
        parts.task.close()
    figures = dict(plain(result.as_dict()))
    ratio = apc[0] / parts.rummager.model.diagonal
    return figures | {"apc_ratio_at_start": ratio, "nll": nll, "wall_s": time.perf_counter() - start}


def lines(path: Path) -> Iterator[dict[str, Any]]:
    """The runs of a file; a last line that was cut off by a kill is left out."""
    if not path.exists():
        return
    for text in path.read_text().splitlines():
        try:
            yield json.loads(text)
        except json.JSONDecodeError:
            continue


def seeds_of(text: str) -> list[int]:
    """Seeds of "0-9" or "3,5,8-9"."""
    seeds: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        seeds += range(int(first), int(last or first) + 1)
    return seeds


def run(options: Run) -> None:
    """Do what is missing, and append each run as it ends."""
    about = {"experiment": "mugs", "label": options.label, "changes": list(options.set)}
    wanted = [
        (column, settings_of(column, task, seed, options.set), about)
        for seed in seeds_of(options.seeds)
        for task in options.tasks
        for column in options.columns
    ]
    carry_out(wanted, options.out, options.jobs)


def carry_out(wanted: list[tuple[str, Settings, dict[str, Any]]], out: Path, jobs: int, most: int | None = None) -> int:
    """Do those of some runs that a file of results does not hold, and append each as it ends.

    Args:
        wanted: method/preset, settings, and what else the lines say.
        out: file of results, one JSON line a run.
        jobs: processes at once.
        most: runs at most; None for all.

    Returns:
        how many are still missing.
    """
    code, here = code_hash(), commit()
    done = {(r["task"], r["column"], r["seed"], r["settings"], r["code"]) for r in lines(out)}
    missing = [w for w in wanted if (w[1].task, w[0], w[1].seed, settings_hash(w[1]), code) not in done]
    out.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        running = {
            pool.submit(one_run, settings): (column, settings, about) for column, settings, about in missing[:most]
        }
        for future in tqdm(as_completed(running), total=len(running), file=sys.stderr):
            column, settings, about = running[future]
            line = about | {
                "column": column,
                "task": settings.task,
                "seed": settings.seed,
                "settings": settings_hash(settings),
                "code": code,
                "commit": here,
                "machine": f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}, 1 thread a run",
            }
            with out.open("a") as file:
                file.write(json.dumps(line | future.result()) + "\n")
    return len(missing[most:]) if most is not None else 0


def rate(flags: list[bool]) -> str:
    """Successes with their Wilson interval."""
    low, high = wilson(sum(flags), len(flags))
    return f"{sum(flags)}/{len(flags)} [{low:.2f}, {high:.2f}]"


def median(values: list[float], digits: int = 1) -> str:
    """Median with its bootstrap interval."""
    if not values:
        return "-"
    middle, low, high = bootstrap_median(values)
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def show(options: Show) -> None:
    """Print one row a column of results, and each method paired with rumi by task and seed."""
    runs = [r for r in lines(options.results) if options.label is None or r["label"] == options.label]
    if not runs:
        raise SystemExit(f"There are no runs in {options.results}: do some with `run` first")
    newest = {}
    for r in runs:
        if r["code"] != runs[-1]["code"]:
            continue
        newest[(r["column"] + (f" {' '.join(r['changes'])}" if r["changes"] else ""), r["task"], r["seed"])] = r
    columns = list(dict.fromkeys(key[0] for key in newest))
    heads = ("method/preset", "right", "nll <= 20 at any step", "of these at step 0", "stopped: right", "steps")
    heads += ("cumulative nll", "position error, mm", "rotation error, deg", "s a step")
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for column in columns:
        rows = [r for key, r in newest.items() if key[0] == column]
        stopped = [r for r in rows if r["stopped_by"] == "converged"]
        cells = [
            column,
            rate([r["right"] for r in rows]),
            rate([r["paper_success"] for r in rows]),
            str(sum(r["paper_success_at_start"] for r in rows)),
            f"{len(stopped)}: {sum(r['right'] for r in stopped)}",
            median([r["steps"] for r in rows], 0),
            median([r["cumulative_nll"] for r in rows], 0),
            median([r["position_error_mm"] for r in rows]),
            median([r["rotation_error_deg"] for r in rows]),
            f"{sum(r['wall_s'] for r in rows) / max(1, sum(r['steps'] for r in rows)):.2f}",
        ]
        print("| " + " | ".join(cells) + " |")
    print()
    for column in columns:
        by_task = {task: [r["right"] for key, r in newest.items() if key[:2] == (column, task)] for task in TASKS}
        print(f"{column}, right by task: " + ", ".join(f"{task} {sum(f)}/{len(f)}" for task, f in by_task.items()))
    first = columns[0]
    for column in columns[1:]:
        own = {key[1:]: r["right"] for key, r in newest.items() if key[0] == column}
        base = {key[1:]: r["right"] for key, r in newest.items() if key[0] == first}
        pairs = [(base[run], own[run]) for run in own if run in base]
        if pairs:
            a, b = zip(*pairs, strict=True)
            verdict = f"{sum(b)} against {sum(a)} of {len(pairs)}, McNemar p = {mcnemar(a, b):.3g}"
            print(f"Paired with {first}: {column} right {verdict}")
    low_apc = sum(r["apc_ratio_at_start"] < 0.03 for r in newest.values())
    print(f"APC below 0.03 of the diagonal at the first view: {low_apc} of {len(newest)} runs")


if __name__ == "__main__":
    options = tyro.extras.subcommand_cli_from_dict({"run": Run, "show": Show}, description=__doc__)
    run(options) if isinstance(options, Run) else show(options)
