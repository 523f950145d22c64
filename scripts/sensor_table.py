"""Find the mugs through images of a camera, of soft bubbles, or both, with and without their noise; resumable.

    python scripts/sensor_table.py run --seeds 1000-1009 --seconds 120   # a line a run in scripts/results/sensors.jsonl
    python scripts/sensor_table.py show                                  # Markdown

Tune on seeds of 1000 and more.
"""

import hashlib
import statistics
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from rumi.assemble import build
from rumi.commands import cache_folder
from rumi.config import preset
from rumi.errors import DegenerateBeliefError
from rumi.jsonlines import append_line, read_lines
from rumi.loop import rummage
from rumi.metrics.intervals import wilson
from rumi.recording import provenance
from rumi.sim.sensor_settings import SensorSettings, degraded
from rumi.sim.tasks import find_task

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "scripts" / "results" / "sensors.jsonl"
TASKS = ("mug-0", "mug-1", "mug-2")
SENSORS: dict[str, SensorSettings] = {
    **{kind: SensorSettings(kind) for kind in ("points", "camera", "bubbles", "both")},
    **{f"{kind}, degraded": degraded(kind) for kind in ("camera", "bubbles", "both")},
    "camera, degraded, turned about itself": replace(degraded("camera"), turned_about="sensor"),
    "both, degraded, turned about itself": replace(degraded("both"), turned_about="sensor"),
}


@dataclass(frozen=True)
class Run:
    """Do the runs that are missing, the seeds one after the other.

    Attributes:
        seeds: "1000-1009", or "1000,1005".
        tasks: which.
        sensors: which.
        seconds: begin no run after so long.
        threads: of PyTorch and of the kernels.
        out: where the lines go.
        cache: folder of the arm's reach; the user's by default.
    """

    seeds: str = "1000-1009"
    tasks: tuple[str, ...] = TASKS
    sensors: tuple[str, ...] = tuple(SENSORS)[:7]
    seconds: float = float("inf")
    threads: int = 1
    out: Path = RESULTS
    cache: Path | None = None


@dataclass(frozen=True)
class Show:
    """Print the table.

    Attributes:
        out: where the lines are.
        seeds: only these.
    """

    out: Path = RESULTS
    seeds: str | None = None


def run(options: Run) -> None:
    """Carry them out, and keep a line a run."""
    torch.set_num_threads(options.threads)
    end = time.monotonic() + options.seconds
    done = {(x["sensors"], x["settings"], x["task"], x["seed"]) for x, _ in read_lines(options.out)}
    for seed in seeds_of(options.seeds):
        for task in options.tasks:
            for name in options.sensors:
                if (name, stamp(name), task, seed) in done:
                    continue
                if time.monotonic() > end:
                    return
                line = carry_out(name, task, seed, options.cache or cache_folder())
                append_line(options.out, line)


def carry_out(name: str, task: str, seed: int, cache: Path) -> dict[str, Any]:
    """One run, ready for JSON."""
    spec, settings = find_task(task), preset(task=task, seed=seed)
    settings = replace(settings, simulator=replace(settings.simulator, sensors=SENSORS[name]))
    world, rummager = build(settings, cache_dir=cache)
    began = time.perf_counter()
    head = {
        "sensors": name,
        "settings": stamp(name),
        "task": task,
        "seed": seed,
        "commit": provenance()["commit"],
        "seconds": 0.0,
    }
    try:
        found = rummage(world, rummager, seed=seed, steps=spec.steps).as_dict()
    except (DegenerateBeliefError, ValueError) as error:
        found = {"right": False, "stopped_by": "error", "error": str(error)[:200]}
    finally:
        world.close()
    found.pop("timings_s", None)
    kept = {key: round(value, 4) if isinstance(value, float) else value for key, value in found.items()}
    return head | {"seconds": round(time.perf_counter() - began, 2)} | kept


def show(options: Show) -> None:
    """Markdown."""
    wanted = None if options.seeds is None else set(seeds_of(options.seeds))
    heads = (
        "sensors", "right", "stopped, and right", "stopped on a wrong pose", "never sure", "actions, median",
        "off, median (mm, degrees)", "wrong stops: off (mm, degrees)",
    )  # fmt: skip
    print("| " + " | ".join(heads) + " |")
    print("|---" * len(heads) + "|")
    lines = [x for x, _ in read_lines(options.out) if wanted is None or x["seed"] in wanted]
    for name in SENSORS:
        own = [x for x in lines if x["sensors"] == name and x["settings"] == stamp(name)]
        if not own:
            continue
        right, stopped = sum(x["right"] for x in own), [x for x in own if x["stopped_by"] == "converged"]
        low, high = wilson(right, len(own))
        wrong = [x for x in stopped if not x["right"]]
        known = [x for x in own if x.get("position_error_mm") is not None]
        off = [statistics.median(x[key] for x in known) for key in ("position_error_mm", "rotation_error_deg")]
        away = "; ".join(f"{x['position_error_mm']:.1f}, {x['rotation_error_deg']:.0f}" for x in wrong) or "-"
        steps = statistics.median(x["steps"] for x in known)
        print(
            f"| {name} | {right}/{len(own)} [{low:.2f}, {high:.2f}] | {len(stopped) - len(wrong)} | {len(wrong)} | "
            f"{len(own) - len(stopped)} | {steps:g} | {off[0]:.1f}, {off[1]:.1f} | {away} |"
        )


def stamp(name: str) -> str:
    """Of the sensors' settings."""
    return hashlib.sha256(repr(sorted(asdict(SENSORS[name]).items())).encode()).hexdigest()[:8]


def seeds_of(text: str) -> list[int]:
    """The seeds that "1000-1009" or "1000,1005" names."""
    found = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return found


if __name__ == "__main__":
    chosen = tyro.extras.subcommand_cli_from_dict({"run": Run, "show": Show}, description=__doc__)
    run(chosen) if isinstance(chosen, Run) else show(chosen)
    sys.exit(0)
