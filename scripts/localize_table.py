"""Localise the recorded touches of RUMI_DATA from many seeds and print the table; seeds that are done are kept.

    python -m scripts.localize_table run --seeds 0-99 --threads 1    # one line a seed in scripts/results/localize.jsonl
    python -m scripts.localize_table show                            # Markdown

Reached is what is within 0.3 mm of the least mean distance known. Tune on seeds of 1000 and more.
"""

import os
import statistics
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from torch import Tensor

from rumi.cli import script
from rumi.commands.contact_files import read_contacts
from rumi.registration.from_contacts import localize
from rumi.registration.touch_surface import TouchSurface
from rumi.seeding import generator
from scripts.experiment import Experiment, Line, newest
from scripts.reproduce.cells import rate, table
from scripts.reproduce.code import code_of

SETS = {
    "Cylinder_exp": ("cylinder.off", 5.44),
    "Lego_exp": ("legoBox.off", 6.73),
    "Box100_sim": ("box.off", 0.0001),
    "Tetra30_sim": ("tetrahedron.off", 0.002),
    "Cleaner_sim": ("cleaner.off", 0.88),
}
"""Mesh, and the least mean distance in millimetres that the data's README knows."""

NEAR_MM = 0.3


def data() -> Path:
    """The folder of the recorded touches."""
    root = os.environ.get("RUMI_DATA")
    if not root or not (Path(root) / "icub_touch").is_dir():
        raise SystemExit("Expected RUMI_DATA to name the folder of recorded data, with icub_touch in it")
    return Path(root) / "icub_touch"


@cache
def touches(name: str) -> tuple[TouchSurface, Tensor, float]:
    """Surface and points of a set, and the seconds that loading the surface took."""
    began = time.perf_counter()
    surface = TouchSurface.of(data() / SETS[name][0])
    loading = time.perf_counter() - began
    points = read_contacts(data() / f"meas{name}.off").points
    localize(surface, points, generator=generator(1))  # compiles
    return surface, points, loading


def measure(set: str, threads: int, seed: int) -> dict[str, Any]:
    """Localise once."""
    surface, points, loading = touches(set)
    began, worked = time.perf_counter(), time.process_time()
    found = localize(surface, points, generator=generator(seed))
    seconds, cpu = time.perf_counter() - began, time.process_time() - worked
    return {
        "best_mm": 1e3 * float(found.distance_m[found.best]),
        "modes_mm": [round(1e3 * float(x), 3) for x in found.distance_m],
        "weights": [round(float(x), 6) for x in found.weights],
        "spread_mm": round(1e3 * float(found.spread_m[found.best]), 3),
        "family": found.family,
        "alike": len(found.symmetries),
        "seconds": round(seconds, 4),
        "cpu": round(cpu, 4),
        "loading": round(loading, 2),
    }


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """The sets, by the newest code."""
    lines = newest(lines)
    heads = ("set", "floor", "least, median and largest (mm)", "within 0.3 mm", "modes", "seconds, median and worst")
    rows = []
    for name, (_, floor) in SETS.items():
        for threads in sorted({x["threads"] for x in lines}):
            own = [x for x in lines if x["set"] == name and x["threads"] == threads]
            if own:
                best, seconds = [x["best_mm"] for x in own], [x["seconds"] for x in own]
                cells = [
                    f"{min(best):.4g}, {statistics.median(best):.4g}, {max(best):.4g}",
                    rate([x <= floor + NEAR_MM for x in best]),
                    f"{statistics.median(len(x['modes_mm']) for x in own):g}",
                    f"{statistics.median(seconds):.2f}, {max(seconds):.2f}",
                    f"{statistics.median(x['cpu'] for x in own):.2f}",
                ]
                rows.append([name, f"{floor:g}", *cells, str(threads)])
    return table((*heads, "CPU seconds", "threads"), rows)


EXPERIMENT = Experiment(
    __doc__,
    "localize.jsonl",
    {"set": tuple(SETS)},
    measure,
    show,
    seeds="0-99",
    parameters={"threads": 1},
    identity=lambda variant: {"code": code_of("localize")},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
