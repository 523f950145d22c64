"""Results as JSON lines, one a run, and the comparison of a run with earlier ones."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rumi.bench.measure import Result
from rumi.errors import UsageError
from rumi.runs.folder import write_json
from rumi.runs.plain import plain

SCHEMA = 1
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


def record(results: Sequence[Result], machine: Mapping[str, Any], *, stamp: str, quick: bool) -> dict[str, Any]:
    """A run as plain values."""
    return {
        "schema": SCHEMA,
        "stamp": stamp,
        "quick": quick,
        "machine": plain(machine),
        "cases": [_case(result) for result in results],
    }


def _case(result: Result) -> dict[str, Any]:
    case = result.case
    rows = []
    for row in result.rows:
        low, high = row.timing.quartiles_s
        rows.append(
            {
                "name": row.name,
                "by": row.by,
                "median_s": row.timing.median_s,
                "least_s": row.timing.least_s,
                "quartiles_s": [low, high],
                "samples": len(row.timing.samples_s),
                "quicker": result.ratio(row),
                "error": row.error,
                "note": row.note,
                "ran": row.ran,
            }
        )
    verdicts = [
        {**plain(verdict.target), "met": verdict.met, "factor": verdict.factor, "quickest": verdict.against}
        for verdict in result.verdicts
    ]
    return {
        "name": result.name,
        "title": case.title,
        "items": case.items,
        "item": case.item,
        "baseline": result.baseline,
        "agree": result.agree,
        "tolerance": case.tolerance,
        "variants": rows,
        "targets": verdicts,
        "facts": plain(case.facts),
        "remarks": list(case.remarks),
        "left_out": list(result.left_out),
    }


def check_writable(path: Path) -> None:
    """Make the folder of a file, and make sure that the file can be written there.

    Raises:
        UsageError: it cannot.
    """
    try:
        if path.is_dir():
            raise IsADirectoryError(21, "it is a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        probe = path if path.suffix == ".jsonl" else _aside(path)
        there = probe.exists()
        with probe.open("a", encoding="utf-8"):
            pass
        if not there:
            probe.unlink()
    except OSError as error:
        raise UsageError(f"Cannot write {path}: {error.strerror or error}; give another file") from error


def write(path: Path, run: Mapping[str, Any]) -> None:
    """Write a run: one more line of a file of JSON lines (.jsonl), else the whole file, in one go."""
    if path.suffix != ".jsonl":
        write_json(path, run)
        return
    line = json.dumps(plain(run), allow_nan=False) + "\n"
    with path.open("a", encoding="utf-8") as file:
        file.write(line)


def _aside(path: Path) -> Path:
    return path.with_name(path.name + ".part")


def read(path: Path) -> list[dict[str, Any]]:
    """The runs of a file, oldest first; a last line that was cut short does not count.

    Raises:
        UsageError: there is no such file, it holds no run, or a newer rumi wrote it.
    """
    try:
        content = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UsageError(
            f"Cannot read {path}: {error.strerror or error}; `rumi bench --json FILE` makes one"
        ) from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} holds no results of `rumi bench`: it is no text ({error})") from error
    runs: list[dict[str, Any]] = []
    whole = [content] if path.suffix != ".jsonl" else content.splitlines()
    for number, line in enumerate(whole, 1):
        if not line.strip():
            continue
        try:
            run = json.loads(line)
            schema, _ = run["schema"], run["cases"]
        except (ValueError, KeyError, TypeError) as error:
            if number == len(whole) and runs and not content.endswith("\n"):
                break
            raise UsageError(f"{path}, line {number}: no results of `rumi bench` ({error})") from error
        if schema > SCHEMA:
            raise UsageError(f"{path} was written by a newer rumi (schema {schema}, this one reads {SCHEMA})")
        runs.append(run)
    if not runs:
        raise UsageError(f"{path} holds no results of `rumi bench`")
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
