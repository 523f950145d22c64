"""Find the mugs through images of a camera, of soft bubbles, or both, with and without their noise; resumable.

    python -m scripts.sensor_table run --seeds 1000-1009 --seconds 120   # a line a run in scripts/results/sensors.jsonl
    python -m scripts.sensor_table why --seconds 120     # those that were not right, without parts of the degradation
    python -m scripts.sensor_table show                                  # Markdown

Tune on seeds of 1000 and more.
"""

import hashlib
import statistics
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rumi import loop
from rumi.agent import stop_reason
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.errors import DegenerateBeliefError
from rumi.sim.conditions import image_errors
from rumi.sim.sensor_settings import SensorKind, SensorSettings
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import preset
from scripts.experiment import RESULTS, Experiment, Line
from scripts.reproduce.cells import rate, table
from scripts.store import Store

TASKS = ("mug-0", "mug-1", "mug-2")
SENSORS: dict[str, SensorSettings] = {
    **{kind: SensorSettings(kind) for kind in ("points", "camera", "bubbles", "both")},
    **{f"{kind}, degraded": image_errors(kind) for kind in ("camera", "bubbles", "both")},
    "camera, degraded, turned about itself": replace(image_errors("camera"), turned_about="sensor"),
    "both, degraded, turned about itself": replace(image_errors("both"), turned_about="sensor"),
}

KINDS: tuple[SensorKind, ...] = ("camera", "bubbles", "both")
PARTS: dict[str, dict[str, float]] = {
    "calibrated": {"calibration_m": 0.0, "calibration_rad": 0.0},
    "in time": {"late_s": 0.0, "lost": 0.0},
    "motion measured exactly": {"motion_noise_m": 0.0, "motion_noise_rad": 0.0},
}
"""Parts of the degradation that can be left out, by what is left out."""
SENSORS |= {
    f"{kind}, degraded, {part}": replace(image_errors(kind), **changes)  # type: ignore[arg-type]
    for part, changes in PARTS.items()
    for kind in KINDS
}


@dataclass(frozen=True)
class Why:
    """Repeat the degraded runs that were not right, each with one part of the degradation left out.

    Attributes:
        seconds: begin no run after so long.
        threads: of PyTorch and of the kernels.
        jobs: processes at once.
        results: where the lines are, and go.
    """

    seconds: float = float("inf")
    threads: int = 1
    jobs: int = 1
    results: Path = RESULTS / "sensors.jsonl"


def why(options: Why) -> None:
    """Carry these out."""
    end = time.monotonic() + options.seconds
    for line in wrong_runs(Store(options.results).flat()):
        chosen = {"sensors": tuple(f"{line['sensors']}, {part}" for part in PARTS), "task": (line["task"],)}
        EXPERIMENT.run(replace(options, seconds=end - time.monotonic()), (line["seed"],), chosen)


def wrong_runs(lines: list[Line]) -> list[Line]:
    """Degraded runs that were not right."""
    names = [f"{kind}, degraded" for kind in KINDS]
    return [x for x in lines if x["sensors"] in names and x["settings"] == stamp(x["sensors"]) and not x["right"]]


def measure(sensors: str, task: str, seed: int) -> dict[str, Any]:
    """One run."""
    spec, settings = find_task(task), preset(task=task, seed=seed)
    settings = replace(settings, simulator=replace(settings.simulator, sensors=SENSORS[sensors]))
    world, rummager = build(settings, cache_dir=cache_folder())
    began = time.perf_counter()
    try:
        found = loop.run_to_end(world, rummager, seed=seed, steps=spec.steps).as_dict()
    except (DegenerateBeliefError, ValueError) as error:
        found = {"right": False, "stopped_by": "error", "error": str(error)[:200]}
    finally:
        world.close()
    found.pop("timings_s", None)
    kept = {key: round(value, 4) if isinstance(value, float) else value for key, value in found.items()}
    return {"seconds": round(time.perf_counter() - began, 2)} | kept


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """Each kind of sensors, and what became of runs that were not right with a part of the degradation left out."""
    heads = (
        "sensors", "right", "stopped, and right", "stopped on a wrong pose", "never sure", "actions, median",
        "off, median (mm, degrees)", "wrong stops: off (mm, degrees)",
    )  # fmt: skip
    rows = []
    for name in SENSORS:
        own = [x for x in lines if x["sensors"] == name and x["settings"] == stamp(name)]
        if not own or any(name.endswith(part) for part in PARTS):
            continue
        stopped = [x for x in own if stop_reason(x["stopped_by"]) == "sure"]
        wrong = [x for x in stopped if not x["right"]]
        known = [x for x in own if x.get("position_error_mm") is not None]
        off = [statistics.median(x[key] for x in known) for key in ("position_error_mm", "rotation_error_deg")]
        rows.append(
            [
                name,
                rate([x["right"] for x in own]),
                str(len(stopped) - len(wrong)),
                str(len(wrong)),
                str(len(own) - len(stopped)),
                f"{statistics.median(x['steps'] for x in known):g}",
                f"{off[0]:.1f}, {off[1]:.1f}",
                "; ".join(f"{x['position_error_mm']:.1f}, {x['rotation_error_deg']:.0f}" for x in wrong) or "-",
            ]
        )
    return f"{table(heads, rows)}\n{parts(lines)}"


def parts(lines: list[Line]) -> str:
    """The runs that were not right, and what became of them with a part of the degradation left out."""
    rows = []
    for line in wrong_runs(lines):
        cells = []
        for part in PARTS:
            name = f"{line['sensors']}, {part}"
            same = (name, stamp(name), line["task"], line["seed"])
            own = [x for x in lines if (x["sensors"], x["settings"], x["task"], x["seed"]) == same]
            cells.append(f"{'right' if own[0]['right'] else 'not right'}, {_off(own[0])}" if own else "-")
        sure = stop_reason(line["stopped_by"]) == "sure"
        ended = "sure" if sure else f"after {line.get('steps', 0)} actions, not sure"
        rows.append([f"{line['sensors']}, {line['task']}, seed {line['seed']}", ended, _off(line), *cells])
    return table(("not right", "ended", "off (mm, degrees)", *PARTS), rows)


def _off(line: Line) -> str:
    if line.get("position_error_mm") is None:
        return str(line.get("error", "-"))
    return f"{line['position_error_mm']:.1f}, {line['rotation_error_deg']:.1f}"


_LATER = ("further", "wrist_force", "wrist_noise_n")


def stamp(name: str) -> str:
    """Of the sensors' settings."""
    values, usual = asdict(SENSORS[name]), asdict(SensorSettings())
    # results on record are kept without the settings that came later
    values = {key: value for key, value in values.items() if key not in _LATER or value != usual[key]}
    return hashlib.sha256(repr(sorted(values.items())).encode()).hexdigest()[:8]


EXPERIMENT = Experiment(
    __doc__,
    "sensors.jsonl",
    {"task": TASKS, "sensors": tuple(SENSORS)},
    measure,
    show,
    seeds="1000-1009",
    usual={"sensors": tuple(SENSORS)[:7]},
    identity=lambda variant: {"settings": stamp(variant["sensors"])},
    commands={"why": (Why, why)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
