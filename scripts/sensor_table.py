"""Find the mugs through images of a camera, of soft bubbles, or both, with and without their noise; resumable.

    python scripts/sensor_table.py run --seeds 1000-1009 --seconds 120   # a line a run in scripts/results/sensors.jsonl
    python scripts/sensor_table.py why --seconds 120     # those that were not right, without parts of the degradation
    python scripts/sensor_table.py show                                  # Markdown

Tune on seeds of 1000 and more.
"""

import hashlib
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from rumi import loop
from rumi.agent import stop_reason
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import DegenerateBeliefError
from rumi.metrics.intervals import wilson
from rumi.runs.folder import provenance
from rumi.runs.jsonlines import append_line, read_lines
from rumi.sim.sensor_settings import SensorKind, SensorSettings, degraded
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import preset
from scripts.reproduce.seeds import seeds_of

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "scripts" / "results" / "sensors.jsonl"
TASKS = ("mug-0", "mug-1", "mug-2")
SENSORS: dict[str, SensorSettings] = {
    **{kind: SensorSettings(kind) for kind in ("points", "camera", "bubbles", "both")},
    **{f"{kind}, degraded": degraded(kind) for kind in ("camera", "bubbles", "both")},
    "camera, degraded, turned about itself": replace(degraded("camera"), turned_about="sensor"),
    "both, degraded, turned about itself": replace(degraded("both"), turned_about="sensor"),
}

KINDS: tuple[SensorKind, ...] = ("camera", "bubbles", "both")
PARTS: dict[str, dict[str, float]] = {
    "calibrated": {"calibration_m": 0.0, "calibration_rad": 0.0},
    "in time": {"late_s": 0.0, "lost": 0.0},
    "motion measured exactly": {"motion_noise_m": 0.0, "motion_noise_rad": 0.0},
}
"""Parts of the degradation that can be left out, by what is left out."""
SENSORS |= {
    f"{kind}, degraded, {part}": replace(degraded(kind), **changes)  # type: ignore[arg-type]
    for part, changes in PARTS.items()
    for kind in KINDS
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
class Why:
    """Repeat the degraded runs that were not right, each with one part of the degradation left out.

    Attributes:
        seconds: begin no run after so long.
        threads: of PyTorch and of the kernels.
        out: where the lines are, and go.
        cache: folder of the arm's reach; the user's by default.
    """

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


def why(options: Why) -> None:
    """Carry these out."""
    end = time.monotonic() + options.seconds
    for line in wrong_runs(options.out):
        for part in PARTS:
            left = max(0.0, end - time.monotonic())
            sensors, seeds = (f"{line['sensors']}, {part}",), str(line["seed"])
            run(Run(seeds, (line["task"],), sensors, left, options.threads, options.out, options.cache))


def wrong_runs(path: Path) -> list[dict[str, Any]]:
    """Degraded runs that were not right."""
    lines = [x for x, _ in read_lines(path)]
    names = [f"{kind}, degraded" for kind in KINDS]
    return [x for x in lines if x["sensors"] in names and x["settings"] == stamp(x["sensors"]) and not x["right"]]


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
        found = loop.run(world, rummager, seed=seed, steps=spec.steps).as_dict()
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
        if not own or any(name.endswith(part) for part in PARTS):
            continue
        right, stopped = sum(x["right"] for x in own), [x for x in own if stop_reason(x["stopped_by"]) == "sure"]
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
    show_parts(options.out, lines)


def show_parts(path: Path, lines: list[dict[str, Any]]) -> None:
    """The runs that were not right, and what became of them with a part of the degradation left out."""
    wrong = wrong_runs(path)
    if not wrong:
        return
    print("\n| not right | ended | off (mm, degrees) | " + " | ".join(PARTS) + " |")
    print("|---" * (3 + len(PARTS)) + "|")
    for line in wrong:
        cells = []
        for part in PARTS:
            name = f"{line['sensors']}, {part}"
            same = (name, stamp(name), line["task"], line["seed"])
            own = [x for x in lines if (x["sensors"], x["settings"], x["task"], x["seed"]) == same]
            cells.append(f"{'right' if own[0]['right'] else 'not right'}, {_off(own[0])}" if own else "-")
        ended = (
            "sure" if stop_reason(line["stopped_by"]) == "sure" else f"after {line.get('steps', 0)} actions, not sure"
        )
        head = f"{line['sensors']}, {line['task']}, seed {line['seed']}"
        print(f"| {head} | {ended} | {_off(line)} | " + " | ".join(cells) + " |")


def _off(line: dict[str, Any]) -> str:
    if line.get("position_error_mm") is None:
        return str(line.get("error", "-"))
    return f"{line['position_error_mm']:.1f}, {line['rotation_error_deg']:.1f}"


def stamp(name: str) -> str:
    """Of the sensors' settings."""
    return hashlib.sha256(repr(sorted(asdict(SENSORS[name]).items())).encode()).hexdigest()[:8]


def main() -> None:
    """Run, tell why, or show."""
    commands: dict[type, Callable[[Any], None]] = {Run: run, Why: why, Show: show}
    chosen = tyro.extras.subcommand_cli_from_dict({"run": Run, "why": Why, "show": Show}, description=__doc__)
    commands[type(chosen)](chosen)


if __name__ == "__main__":
    script(main)
