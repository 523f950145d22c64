"""The same runs on several processors: what is the method's, and what the last digit's.

    python -m scripts.processors          # a table of rumi/default, seeds 0-9, a row a processor

A row comes from `rumi reproduce table5 --methods rumi --presets default --results FILE` on it,
or under `ATEN_CPU_CAPABILITY=default NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= MKL_CBWR=COMPATIBLE`.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import tyro

from rumi.cli import script
from rumi.errors import UsageError
from scripts.reproduce.cells import middle, rate, table
from scripts.reproduce.records import Record, record_of
from scripts.reproduce.seeds import seeds_of
from scripts.store import Store

_FOLDER = Path(__file__).parent / "results"
RESULTS = (_FOLDER / "runs.jsonl", _FOLDER / "processors.jsonl")
Runs = Mapping[tuple[str, int], Record]
"""Runs by task and seed."""


@dataclass(frozen=True)
class Options:
    """The table of processors.

    Attributes:
        results: files of runs.
        seeds: of the runs.
        code: hashes of the code whose runs to show; all if none is given.
    """

    results: tuple[Path, ...] = RESULTS
    seeds: str = "0-9"
    code: tuple[str, ...] = ()


def columns(options: Options) -> dict[str, Runs]:
    """Runs of rumi/default without changed settings, by processor and code, in the order of the file."""
    seeds, found = set(seeds_of(options.seeds)), defaultdict[str, dict[tuple[str, int], Record]](dict)
    for line in (line for path in options.results for line in Store(path).lines):
        of_default = line.get("method") == "rumi" and line.get("preset") == "default" and not line.get("overrides")
        record = record_of(line) if of_default and line["seed"] in seeds else None
        if record is not None and (not options.code or line["code"] in options.code):
            found[f"{line['machine']}, code {line['code']}"][line["task"], line["seed"]] = record
    return dict(found)


def show(found: Mapping[str, Runs]) -> str:
    """Rates and actions of each column, and what differs from the first, run by run."""
    first = next(iter(found.values()))
    rows = []
    for name, runs in found.items():
        both = sorted(first.keys() & runs.keys())
        steps = [(first[key].figures["steps"], runs[key].figures["steps"]) for key in both]
        lost = sum(bool(first[key].figures["right"]) and not runs[key].figures["right"] for key in both)
        won = sum(bool(runs[key].figures["right"]) and not first[key].figures["right"] for key in both)
        kinds = sorted({task.split("-")[0] for task, _ in runs})
        by_kind = {kind: [run for (task, _), run in runs.items() if task.split("-")[0] == kind] for kind in kinds}
        rows.append(
            [
                name,
                rate([bool(run.figures["right"]) for run in runs.values()]),
                ", ".join(
                    f"{kind} {sum(bool(run.figures['right']) for run in of)}/{len(of)}" for kind, of in by_kind.items()
                ),
                ", ".join(f"{kind} {median(run.figures['steps'] for run in of):g}" for kind, of in by_kind.items()),
                "-" if runs is first else f"{sum(a != b for a, b in steps)} of {len(both)}",
                "-" if runs is first else middle([float(b - a) for a, b in steps]),
                "-" if runs is first else f"-{lost} +{won}",
            ]
        )
    heads = ["processor", "right", "by kind", "actions, median", "other actions", "more actions, median", "right"]
    return table(heads, rows)


def main(options: Options) -> None:
    """Print the table."""
    found = columns(options)
    if not found:
        names = ", ".join(map(str, options.results))
        raise UsageError(f"Expected runs of rumi/default in {names}, got none: see the commands above")
    print(show(found), end="")


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options, description=__doc__)))
