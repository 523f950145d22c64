"""A run of the benchmarks against earlier ones."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rumi.bench.command import SCHEMA
from rumi.errors import UsageError
from rumi.runs.jsonlines import read_lines

WORSE = 1.2
"""How many times slower, against the same baseline, counts as worse."""


@dataclass(frozen=True)
class Change:
    """A variant of this project's, now and before; times are in those of the baseline in the same run.

    Least times are compared, not medians: what else runs on a machine disturbs them less.

    Attributes:
        case: its name.
        variant: its name.
        baseline: what both are held against.
        before: time of the variant, over the baseline's, then.
        now: the same, now.
    """

    case: str
    variant: str
    baseline: str
    before: float
    now: float

    @property
    def worse(self) -> bool:
        """Whether it became slower by over a fifth."""
        return self.now > WORSE * self.before

    def __str__(self) -> str:
        """One line for people."""
        change = 100.0 * (self.now / self.before - 1.0)
        return (
            f"{self.case}, {self.variant}: {1.0 / self.now:.3g}x as quick as {self.baseline}, "
            f"before {1.0 / self.before:.3g}x ({change:+.0f} % time)"
        )


def read(path: Path) -> list[dict[str, Any]]:
    """The runs of a file, oldest first; what is cut short does not count.

    Raises:
        UsageError: there is no such file, it holds no run, or a newer version wrote it.
    """
    try:
        lines = [line for line, _ in read_lines(path)] if path.suffix == ".jsonl" else [json.loads(path.read_text())]
    except (OSError, ValueError) as error:
        raise UsageError(f"Cannot read {path}: {error}; `python -m scripts.bench --json FILE` makes one") from error
    runs = [line for line in lines if isinstance(line, dict) and "cases" in line]
    if not runs:
        raise UsageError(f"{path} holds no results: `python -m scripts.bench --json {path}` makes some")
    if (newest := max(run["schema"] for run in runs)) > SCHEMA:
        raise UsageError(f"{path} was written by a newer version (schema {newest}, this one reads {SCHEMA})")
    return runs


def compare(now: Mapping[str, Any], before: Sequence[Mapping[str, Any]]) -> tuple[list[Change], list[str]]:
    """A run against earlier ones, case by case: the newest that has the case, at the same number of threads if any.

    Returns:
        what could be compared, and remarks on what could not.
    """
    changes, remarks = [], []
    for case in now["cases"]:
        runs = [run for run in before if any(old["name"] == case["name"] for old in run["cases"])]
        alike = [run for run in runs if run["machine"]["threads"] == now["machine"]["threads"]]
        if not runs:
            remarks.append(f"{case['name']}: not there before")
            continue
        run = (alike or runs)[-1]
        old = next(old for old in run["cases"] if old["name"] == case["name"])
        if old["title"] != case["title"] or old["items"] != case["items"]:
            remarks.append(f"{case['name']}: other work before ({old['title']})")
            continue
        if not alike:
            remarks.append(f"{case['name']}: {run['machine']['threads']} threads before")
        here, there = _own_ratios(case, old), _own_ratios(old, case)
        if not here:
            remarks.append(f"{case['name']}: no baseline in common")
        changes += [
            Change(case["name"], variant, baseline, there[variant][1], ratio)
            for variant, (baseline, ratio) in here.items()
        ]
    return changes, remarks


def _own_ratios(case: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[str, float]]:
    """Baseline and time over it of this project's variants that both have."""
    times = {row["name"]: row["least_s"] for row in case["variants"]}
    common = [row["name"] for row in other["variants"] if row["name"] in times]
    if len(common) < 2:
        return {}
    shared = case["baseline"] if case["baseline"] == other["baseline"] else None
    # others' work first, which does not change with this project, then the plain version; the same from both sides
    baseline = min(
        common, key=lambda name: (_by(case, name) == "rumi", name != shared, not name.startswith("torch"), name)
    )
    own = [name for name in common if _by(case, name) == "rumi" and name != baseline]
    return {name: (baseline, times[name] / times[baseline]) for name in own}


def _by(case: Mapping[str, Any], name: str) -> str:
    return next(str(row["by"]) for row in case["variants"] if row["name"] == name)
