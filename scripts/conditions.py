"""Drawn scenes under ideal, lab and harsh conditions, and under lab with each of its errors put back to ideal.

python -m scripts.conditions run --seeds 1000-1009 --tasks mug --conditions ideal lab harsh    # tuning
python -m scripts.conditions run                                     # the record: seeds 0-19; the same command goes on
python -m scripts.conditions show

All runs of a seed have the same scene. Under `lab` and `harsh` nothing measures the object's motion; `lab without X` is
`lab` with the group X of `rumi.sim.conditions.MEMBERS` as under `ideal`, which tells what X costs; in `lab, arm` an arm
carries the gripper, which flies in all others.
"""

import hashlib
import statistics
import time
from dataclasses import replace
from operator import itemgetter
from typing import Any

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.sim.conditions import GROUPS, MEMBERS, put_back
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import Experiment, Line
from scripts.outcomes import ended, sure, won_lost, wrong
from scripts.reproduce.cells import NOTHING, middle, rate, table

WITHOUT = {f"lab without {group}": group for group in GROUPS if group not in ("bubbles", "images")}
ARM = "lab, arm"
CONDITIONS = ("ideal", "lab", "harsh", ARM, *WITHOUT)


def settings_of(task: str, conditions: str, seed: int) -> Settings:
    """Settings of a run."""
    own = preset(task=task, seed=seed, conditions=conditions.partition(" ")[0].rstrip(","))
    if conditions == ARM:
        own = replace(own, simulator=replace(own.simulator, robot="arm"))
    if conditions in WITHOUT:
        own = replace(own, simulator=put_back(own.simulator, WITHOUT[conditions]))
    return own


def measure(task: str, conditions: str, seed: int) -> dict[str, Any]:
    """How a run ended."""
    begun = time.process_time()
    with build(settings_of(task, conditions, seed), cache_dir=cache_folder()) as parts:
        found = ended(parts, seed, more=("steps", "contacts"))
    return found | {"cpu_s": round(time.process_time() - begun, 2)}


def show(lines: list[Line], chosen: object) -> str:
    """A row for each task and condition, paired by seed with lab."""
    rows = []
    for task in DRAWN:
        by = {
            name: {x["seed"]: x for x in lines if x["task"] == task and x["conditions"] == name and _current(x)}
            for name in CONDITIONS
        }
        rows += [[task, name, *_row(by[name], by["lab"])] for name in CONDITIONS if by[name]]
    heads = ("task", "conditions", "right", "sure and wrong", "not sure", "actions", "off, median; 90 % (mm, degrees)")
    return table((*heads, "won; lost against lab (p)"), rows)


def _row(runs: dict[int, Line], lab: dict[int, Line]) -> list[str]:
    found = list(runs.values())
    mm, deg = (sorted(x[key] for x in found if x[key] is not None) for key in ("mm", "deg"))
    return [
        rate([bool(x["right"]) for x in found]),
        rate([wrong(x) for x in found]),
        str(sum(not sure(x) for x in found)),
        middle([float(x["steps"]) for x in found if x["steps"] is not None]),
        "; ".join(f"{at(mm):.1f}, {at(deg):.1f}" for at in (statistics.median, _most)) if mm else NOTHING,
        "" if runs is lab else won_lost(runs, lab, itemgetter("right")),
    ]


def _most(values: list[float]) -> float:
    """The 90th of 100."""
    return values[min(len(values) - 1, int(0.9 * len(values)))]


def numbers() -> str:
    """Stamp of the conditions' numbers: runs of others do not count."""
    return hashlib.sha256(repr(MEMBERS).encode()).hexdigest()[:8]


def _current(line: Line) -> bool:
    return bool(line["numbers"] == numbers())


EXPERIMENT = Experiment(
    __doc__,
    "conditions.jsonl",
    {"task": tuple(DRAWN), "conditions": CONDITIONS},
    measure,
    show,
    seeds="0-19",
    identity=lambda variant: {"numbers": numbers()},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
