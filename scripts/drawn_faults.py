"""Drawn scenes with a drawn fault, each beside the same run without one: whether a lost run says so, and ends right.

python -m scripts.drawn_faults run --seeds 1000-1019 --tasks mug    # tuning; the same command goes on
python -m scripts.drawn_faults run                                  # the record: seeds 0-99 of the five drawn tasks
python -m scripts.drawn_faults run --conditions lab --seeds 0-19 --tasks mug
python -m scripts.drawn_faults show

The kinds take turns by the seed, so that each comes about as often; size and step are drawn by it. Nothing measures the
object's motion: particles have trajectories of their own. A reading is changed by the fault where it differs from that
of the same seed without it.
"""

import hashlib
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any, get_args

import torch

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.records import StepRecord
from rumi.seeding import split
from rumi.sim.conditions import Conditions
from rumi.sim.faults import FAULTS
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.explanations import HAND_OR_CAMERA, NOTHING_FELT
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import Experiment, Line
from scripts.outcomes import by_chance, ended, right, sure, wrong
from scripts.reproduce.cells import middle, rate, table
from sensors.reading import Reading

NAMED = {
    "knock": ("knocked",),
    "absent": ("absent", NOTHING_FELT),
    "dead": ("dead hand", NOTHING_FELT),
    "false-contact": ("false contacts",),
    "hand": ("hand off", HAND_OR_CAMERA),
    "camera": ("camera off", HAND_OR_CAMERA),
    "friction": ("push model off",),
    "mass": ("push model off",),
    "scale": ("another size",),
    "stale": ("stale camera",),
    "stuck": ("stuck hand",),
    "second": ("second object",),
}
"""What a fault is called where it is named, two that nothing tells apart as one; any other is none of these."""

SIZES = {
    "knock": (20.0, 40.0),
    "scale": (3.0, 8.0),
    "hand": (4.0, 8.0),
    "camera": (6.0, 15.0),
    "false-contact": (0.2, 0.6),
    "friction": (2.0, 4.0),
    "second": (80.0, 140.0),
    "mass": (2.0, 4.0),
}
STEPS, LATEST = 25, 6  # actions of a run, and the last one that a fault begins with
TUNING = 1000  # seeds from here on are for tuning
FAR_MM, FAR_DEG = 20.0, 20.0


def kinds_of(task: str) -> list[str]:
    """The faults that a task can have."""
    spec = DRAWN[task]
    without = set() if spec.looks_again else {"stale"}
    if spec.camera is None:
        without.add("camera")
    return [kind for kind in FAULTS if kind in {*NAMED, *SIZES} and kind not in without]


def drawn_fault(task: str, seed: int) -> str:
    """A fault as `--fault` takes it."""
    kinds, random = kinds_of(task), split(seed, "drawn fault")
    kind = kinds[seed % len(kinds)]
    share, step, sign = torch.rand(3, generator=random, dtype=torch.float64).tolist()
    first, last = FAULTS[kind].steps
    last = 0 if kind == "camera" and not DRAWN[task].looks_again else int(min(last, LATEST))  # it looks but once
    text = kind
    if kind in SIZES:
        low, high = SIZES[kind]
        size = low + (high - low) * share
        if kind == "scale" and sign < 0.5:
            size = -size
        text += f":{size:.3g}"
    return f"{text}@{first + int(step * (last - first + 1))}"


def settings_of(task: str, seed: int, fault: str | None, conditions: Conditions = "ideal") -> Settings:
    """Settings of a run in which nothing measures the object's motion."""
    steps = min(STEPS, DRAWN[task].steps)
    own = preset(task=task, seed=seed, steps=steps, conditions=conditions, **{"filter.motion": "trajectory"})
    return by_chance(own if fault is None else replace(own, fault=(fault,)))


def measure(task: str, seed: int, conditions: Conditions = "ideal") -> dict[str, Any]:
    """Both runs of a seed."""
    fault = drawn_fault(task, seed)
    plain, readings = _run(settings_of(task, seed, None, conditions), seed)
    faulted, changed = _run(settings_of(task, seed, fault, conditions), seed)
    differs = [k for k, (one, other) in enumerate(zip(readings, changed, strict=False)) if one != other]
    first = differs[0] if differs else None
    return {"fault": fault, "faultless": plain, "faulted": faulted | {"changed": first}}


def _run(settings: Settings, seed: int) -> tuple[dict[str, Any], list[str]]:
    """How a run ended, and a digest of each of its readings."""
    steps: list[StepRecord] = []
    begun = time.process_time()
    with build(settings, cache_dir=cache_folder()) as parts:
        found = ended(parts, seed, steps.append)
    said = [(step.step, remark.name) for step in steps for remark in step.remarks]
    found |= {
        "alarms": [[step, name.removeprefix("lost: ")] for step, name in said if name.startswith("lost: ")],
        "odd": sorted({name for _, name in said if not name.startswith("lost: ")}),
        "steps": steps[-1].step,
        "least_p": min(step.p_value for step in steps),
        "cpu_s": time.process_time() - begun,
    }
    return found, [_digest(step.reading) for step in steps]


def _digest(reading: Reading) -> str:
    parts = (reading.observation.points, reading.tool_pose, reading.in_contact)
    return hashlib.sha256(b"".join(part.numpy().tobytes() for part in parts)).hexdigest()[:16]


def far(run: Mapping[str, Any]) -> bool:
    """Whether a run's answer is more than 20 mm or 20 degrees off."""
    return run["mm"] is None or run["mm"] > FAR_MM or run["deg"] > FAR_DEG


def flagged(run: Mapping[str, Any]) -> bool:
    """Whether a run ended lost, or not sure; one that searched again and is sure says nothing any more."""
    return not sure(run)


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A table for each task and its conditions, seeds for tuning apart."""
    groups: dict[tuple[str, str, bool], list[Line]] = {}
    for line in sorted(lines, key=itemgetter("seed")):
        groups.setdefault((line["task"], line["conditions"], line["seed"] >= TUNING), []).append(line)
    parts = []
    for (task, conditions, _), some in sorted(groups.items()):
        seeds = f"seeds {some[0]['seed']} to {some[-1]['seed']}, {len(some)} of them"
        parts.append(f"{task}, {conditions}, {seeds}:\n\n{_table(some)}")
    return "\n".join(parts)


def _table(lines: Sequence[Line]) -> str:
    """A row for each kind of fault, one of all, and one of the runs without any."""
    kinds = {_kind(line) for line in lines}
    rows = [_row(kind, [line for line in lines if _kind(line) == kind]) for kind in FAULTS if kind in kinds]
    if len(rows) > 1:
        rows.append(_row("any", lines))
    heads = (
        "fault",
        "far off, not flagged",
        "named first",
        "actions to it",
        "ends right",
        "sure and wrong",
        "taken for",
    )
    faultless = [line["faultless"] for line in lines]
    alarms, rights = rate([bool(run["alarms"]) for run in faultless]), rate([right(run) for run in faultless])
    errs = rate([run["stopped_by"] == "sure" and not run["right"] for run in faultless])
    steps = middle([float(run["steps"]) for run in faultless])
    told = f"\nWithout a fault: false alarms {alarms}, ends right {rights}, sure and wrong {errs}, {steps} actions.\n"
    return table(heads, rows) + told


def _kind(line: Line) -> str:
    return str(line["fault"]).partition("@")[0].partition(":")[0]


def _row(kind: str, lines: Sequence[Line]) -> list[str]:
    runs = [line["faulted"] for line in lines]
    told = [(line, run) for line, run in zip(lines, runs, strict=True) if run["changed"] is not None]
    named = [_first(run) in NAMED[_kind(line)] for line, run in told]
    delays = [
        float(run["alarms"][0][0] - run["changed"])
        for _, run in told
        if run["alarms"] and run["alarms"][0][0] >= run["changed"]
    ]
    return [
        kind,
        rate([far(run) and not flagged(run) for run in runs]),
        rate(named),
        middle(delays, 0),
        rate([right(run) for run in runs]),
        rate([wrong(run) for run in runs]),
        ", ".join(f"{name} {count}" for name, count in Counter(_first(run) for _, run in told).most_common()) or "-",
    ]


def _first(run: Mapping[str, Any]) -> str:
    """What the first alarm from the first changed reading on was taken for."""
    return next((name for step, name in run["alarms"] if step >= run["changed"]), "nothing")


EXPERIMENT = Experiment(
    __doc__,
    "drawn_faults.jsonl",
    {"task": tuple(DRAWN), "conditions": get_args(Conditions)},
    measure,
    show,
    seeds="0-99",
    usual={"conditions": ("ideal",)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
