"""Tables that are made of many runs of touch alone."""

import dataclasses
import hashlib
import itertools
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch

from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings
from scripts.reproduce.intervals import mcnemar, wilson

Line = dict[str, Any]
_BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.0)


def digest(task: TouchTask, settings: TouchSettings, robot: str) -> str:
    """A name of all that decides a run but its seed and the code."""
    values = (dataclasses.asdict(task), dataclasses.asdict(settings), robot)
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


class Summary(NamedTuple):
    """Many runs with one setting.

    Attributes:
        runs: how many.
        lifted: of these.
        actions: mean.
        deviation: standard deviation of the actions.
        sure: runs in which the threshold was reached.
        believed: mean probability at the grasp.
        readings: mean, of a poke.
        seconds: of all but the robot, mean of a poke (thinking).
    """

    runs: int
    lifted: int
    actions: float
    deviation: float
    sure: int
    believed: float
    readings: float
    seconds: float


def summarise(lines: Sequence[Line]) -> Summary:
    """Figures over some runs; at least one."""
    actions = torch.tensor([float(line["actions"]) for line in lines])
    steps = [step for line in lines for step in line["steps"]]
    thought = [sum(v for k, v in step["seconds"].items() if k not in ("simulate", "robot")) for step in steps]
    count = max(1, len(steps))
    return Summary(
        len(lines),
        sum(line["lifted"] for line in lines),
        float(actions.mean()),
        float(actions.std()) if len(lines) > 1 else 0.0,
        sum(line["sure"] for line in lines),
        sum(line["believed"] for line in lines) / len(lines),
        sum(len(step["readings"]) for step in steps) / count,
        sum(thought) / count,
    )


def table(groups: dict[str, list[Line]]) -> str:
    """Table I, Markdown: a method a line; then each against the first, paired by seed."""
    lines = [
        "| method | lifted | actions, mean (std) | believed | unsure at the end | readings a poke | s a poke |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, own in groups.items():
        if not own:
            continue
        s = summarise(own)
        low, high = wilson(s.lifted, s.runs)
        lines.append(
            f"| {name} | {s.lifted}/{s.runs} = {s.lifted / s.runs:.2f} [{low:.2f}, {high:.2f}] | {s.actions:.1f} "
            f"({s.deviation:.1f}) | {s.believed:.2f} | {s.runs - s.sure} | {s.readings:.0f} | {s.seconds:.2f} |"
        )
    names = [name for name, own in groups.items() if own]
    if len(names) > 1:
        lines += ["", f"| {names[0]} against | actions, paired | only the first lifted | only the other | p |"]
        lines.append("|---|---|---|---|---|")
    for other in names[1:]:
        pairs = paired(groups[names[0]], groups[other])
        if not pairs:
            continue
        apart = torch.tensor([float(a["actions"] - b["actions"]) for a, b in pairs])
        half = 1.96 * float(apart.std()) / math.sqrt(len(apart)) if len(apart) > 1 else math.nan
        first, second = [a["lifted"] for a, _ in pairs], [b["lifted"] for _, b in pairs]
        lines.append(
            f"| {other} | {float(apart.mean()):+.1f} ± {half:.1f} (n = {len(pairs)}) | "
            f"{sum(a and not b for a, b in zip(first, second, strict=True))} | "
            f"{sum(b and not a for a, b in zip(first, second, strict=True))} | {mcnemar(first, second):.2f} |"
        )
    return "\n".join(lines)


def paired(first: Iterable[Line], second: Iterable[Line]) -> list[tuple[Line, Line]]:
    """Runs of one seed each."""
    others = {line["seed"]: line for line in second}
    return [(line, others[line["seed"]]) for line in first if line["seed"] in others]


def calibration(lines: Sequence[Line]) -> str:
    """Markdown: what was believed at the grasp, and what came true."""
    rows = ["| believed at the grasp | runs | mean believed | lifted | difference |", "|---|---|---|---|---|"]
    for low, high in itertools.pairwise(_BINS):
        own = [x for x in lines if low <= x["believed"] < high or (high == _BINS[-1] and x["believed"] == high)]
        if own:
            rows.append(_calibrated(f"{low:.2f} to {high:.2f}", own))
    sure = [line for line in lines if line["sure"]]
    if sure:
        rows.append(_calibrated("sure (threshold reached)", sure))
    return "\n".join(rows)


def _calibrated(name: str, own: Sequence[Line]) -> str:
    count, right = len(own), sum(line["lifted"] for line in own)
    believed = sum(line["believed"] for line in own) / count
    low, high = wilson(right, count)
    return (
        f"| {name} | {count} | {believed:.2f} | {right}/{count} = {right / count:.2f} [{low:.2f}, {high:.2f}] | "
        f"{right / count - believed:+.2f} |"
    )
