"""What was measured, as it is kept in files of JSON lines and as tables take it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rumi.agent import stop_reason
from rumi.errors import UsageError
from rumi.runs.jsonlines import append_line
from scripts.reproduce.jobs import Job, column_name, identity, named
from scripts.store import Line, Store, commit, machine

SCHEMA = 1
AS_PRINTED = ("7947043fb1d5", "57019228b80a", "ae9fa96ca06f")
"""Code by which the preset `paper` had all numbers of Table IV as they are printed, of lines with a schema."""
Key = tuple[str, str, str, str, tuple[str, ...], int]


@dataclass(frozen=True)
class Record:
    """One result.

    Attributes:
        kind, task, method, preset, seed, overrides: as of `scripts.reproduce.jobs.Job`.
        figures: how it ended.
        timings: seconds; all that differs when the same work is done again.
        curves: numbers over the steps, the first view's first.
        id: of the work; empty in lines of before there were any.
        code: hash of the code that made it.
        commit: of the checkout, with a + where files differed.
        machine: what it ran on.
        as_printed: whether it is of the preset `paper` of before two of its numbers were read otherwise.
    """

    kind: str
    task: str
    method: str
    preset: str
    seed: int
    overrides: tuple[str, ...]
    figures: dict[str, Any]
    timings: dict[str, Any]
    curves: dict[str, list[float | None]]
    id: str = ""
    code: str = ""
    commit: str = ""
    machine: str = ""
    as_printed: bool = False

    @property
    def key(self) -> Key:
        """What was done, whatever the code was."""
        return (self.kind, self.task, self.method, self.preset, named(self.overrides), self.seed)

    @property
    def column(self) -> str:
        """Method, preset and overrides, as tables show them."""
        return column_name(self.method, self.label, self.overrides)

    @property
    def label(self) -> str:
        """The preset, as tables show it."""
        return f"{self.preset} as printed" if self.as_printed else self.preset


def key_of(job: Job) -> Key:
    """The key that the record of some work will have."""
    return (job.kind, job.task, job.method, job.preset, named(job.overrides), job.seed)


def line_of(job: Job, result: dict[str, Any]) -> dict[str, Any]:
    """A result as one line."""
    return {"schema": SCHEMA, "id": job.id, **job.describe(), "commit": commit(), "machine": machine(), **result}


def record_of(line: dict[str, Any]) -> Record | None:
    """The record of a line, also of one that the first table of the mugs left; None for a line of something else."""
    if line.get("experiment") == "mugs":
        return _first_table(line)
    if line.get("schema") != SCHEMA or "id" not in line:
        return None
    described = {name: line[name] for name in _DESCRIBED}
    # the name of the work by the present code, where that is on record as the same
    about = {name: line[name] for name in _ABOUT} | {"id": identity(described)}
    about["as_printed"] = line["preset"] == "paper" and line["code"] in AS_PRINTED
    return Record(**about | {"overrides": tuple(line["overrides"]), "figures": _figures(line["figures"])})


def _figures(figures: dict[str, Any]) -> dict[str, Any]:
    """The same in today's words."""
    return figures | {"stopped_by": stop_reason(figures["stopped_by"])} if "stopped_by" in figures else figures


_DESCRIBED = ("kind", "task", "method", "preset", "overrides", "seed", "settings", "code")
_ABOUT = (*("kind", "task", "method", "preset", "seed", "figures", "timings", "curves"), "code", "commit", "machine")
_FIGURES = (
    *("right", "paper_success", "paper_success_at_start", "min_nll", "final_nll", "cumulative_nll", "steps"),
    *("stopped_by", "apc", "expected_nll", "position_error_mm", "rotation_error_deg", "contacts", "clipped"),
)


def _first_table(line: dict[str, Any]) -> Record:
    """Lines of `scripts/results/mugs.jsonl`: figures beside all else, only the nll over the steps."""
    method, _, preset = line["column"].partition("/")
    figures = _figures({name: line[name] for name in _FIGURES}) | {"nll_threshold": 20.0, "allowed": 40}
    figures["apc_ratio_at_start"] = line["apc_ratio_at_start"]
    timings = {"wall_s": line["wall_s"], "stages_s": line["timings_s"]}
    return Record(
        "run",
        line["task"],
        method,
        preset,
        line["seed"],
        tuple(line["changes"]),
        figures,
        timings,
        {"nll": line["nll"]},
        "",
        line["code"],
        line["commit"],
        line["machine"],
        preset == "paper",
    )


class Records(Store):
    """A file of results, read as it grows.

    Args:
        path: of the file, of JSON lines.
    """

    def __init__(self, path: Path) -> None:
        self.by_id: dict[str, Record] = {}
        self.every: list[Record] = []
        super().__init__(path)

    def take(self, line: Line) -> None:
        """Take in a result; of the same work done twice, where locks do not reach, the first counts."""
        record = record_of(line)
        if record is not None and not (record.id and record.id in self.by_id):
            self.every.append(record)
            if record.id:
                self.by_id[record.id] = record

    def keep(self, job: Job, result: dict[str, Any]) -> None:
        """Write a result down."""
        append_line(self.path, line_of(job, result))

    def done(self, jobs: Iterable[Job]) -> list[Record]:
        """Results of some work by the present code and settings, in the order of the work; of what is there."""
        return [self.by_id[job.id] for job in jobs if job.id in self.by_id]

    def newest(self, *code: str) -> list[Record]:
        """Results by one code for each kind of work, the last one of each piece.

        Args:
            code: hashes of the code of the runs, the one to prefer last; by default that of the last line of each kind.

        Raises:
            UsageError: there are no results by one of these codes.
        """
        codes = {record.kind: [record.code] for record in self.every}
        if code:
            known = dict.fromkeys(record.code for record in self.every if record.kind == "run")
            missing = [one for one in code if one not in known]
            if missing:
                raise UsageError(
                    f"There are no runs by the code {missing[0]} in {self.path}; there are by {', '.join(known)}"
                )
            codes["run"] = list(code)
        order = [(kind, one) for kind, own in codes.items() for one in own]
        kept = sorted((r for r in self.every if r.code in codes[r.kind]), key=lambda r: order.index((r.kind, r.code)))
        return list({record.key: record for record in kept}.values())


def by_column(records: Iterable[Record]) -> Iterator[tuple[str, list[Record]]]:
    """Records of each column, in the order of their first."""
    columns: dict[str, list[Record]] = {}
    for record in records:
        columns.setdefault(record.column, []).append(record)
    yield from columns.items()
