"""Drawn mugs that are knocked, or gone, or not: whether the run notices, after how many actions, and how it ends.

python -m scripts.fault_runs run --seeds 1000-1019     # tuning; again to go on
python -m scripts.fault_runs show

A knock is of 20 to 40 mm, by the seed; faults come before the third action..
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.records import StepRecord
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import Experiment, Line
from scripts.outcomes import by_chance, ended, right, wrong
from scripts.reproduce.cells import middle, rate, table

FAULTS = {"none": None, "knock": "knock:{size}@3", "absent": "absent@3", "dead": "dead@3"}
MOTIONS = ("measured", "trajectory")
STEPS, FROM = 25, 3


def settings_of(fault: str, motion: str, seed: int) -> Settings:
    """Settings of a run."""
    own = preset(task="mug", seed=seed, steps=STEPS, conditions="ideal", **{"filter.motion": motion})
    if (text := FAULTS[fault]) is not None:
        own = replace(own, fault=(text.format(size=20 + seed % 21),))
    return own if motion == "measured" else by_chance(own)


def measure(fault: str, motion: str, seed: int) -> dict[str, Any]:
    """How a run ended; actions at which it was called lost, and the first from the fault on that touched anything."""
    steps: list[StepRecord] = []
    begun = time.process_time()
    with build(settings_of(fault, motion, seed), cache_dir=cache_folder()) as parts:
        found = ended(parts, seed, steps.append)
    alarms = [[step.step, remark.name] for step in steps for remark in step.remarks if remark.name.startswith("lost")]
    touched = [step.step for step in steps if step.step >= FROM and bool(step.reading.in_contact.any())]
    return found | {
        "steps": steps[-1].step,
        "alarms": alarms,
        "touched": touched[0] if touched else None,
        "most_nats": max(step.lost for step in steps),
        "cpu_s": time.process_time() - begun,
    }


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each fault and motion."""
    rows = []
    for motion in chosen.get("motion", MOTIONS):
        for fault in chosen.get("fault", tuple(FAULTS)):
            own = [line for line in lines if line["motion"] == motion and line["fault"] == fault]
            if not own:
                continue
            flagged = [any(step >= FROM or fault == "none" for step, _ in line["alarms"]) for line in own]
            delays = [
                line["alarms"][0][0] - line["touched"]
                for line in own
                if line["alarms"] and line["touched"] is not None and line["alarms"][0][0] >= FROM
            ]
            rows.append(
                [
                    motion,
                    fault,
                    rate(flagged),
                    "-" if fault == "none" else middle([float(delay) for delay in delays], 0),
                    rate([right(line) for line in own]),
                    rate([wrong(line) for line in own]),
                    middle([float(line["steps"]) for line in own]),
                ]
            )
    heads = (
        "motion",
        "fault",
        "called lost",
        "actions after the first touch",
        "sure and right",
        "sure and wrong",
        "actions",
    )
    return table(heads, rows)


AXES = {"fault": tuple(FAULTS), "motion": MOTIONS}
EXPERIMENT = Experiment(__doc__, "fault_runs.jsonl", AXES, measure, show, seeds="0-19")

if __name__ == "__main__":
    script(EXPERIMENT.main)
