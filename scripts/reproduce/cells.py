"""Parts of tables: Markdown rows, rates and medians with their intervals."""

from collections.abc import Iterable, Mapping, Sequence
from statistics import median

import torch
from torch import Tensor

from scripts.reproduce.intervals import bootstrap_median, wilson
from scripts.reproduce.records import Record

NOTHING = "-"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; empty without rows."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    if not lines:
        return ""
    return "\n".join(["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|", *lines]) + "\n"


def rate(flags: Sequence[bool]) -> str:
    """Successes with their Wilson interval (95 %)."""
    if not flags:
        return NOTHING
    low, high = wilson(sum(flags), len(flags))
    return f"{sum(flags)}/{len(flags)} [{low:.2f}, {high:.2f}]"


def middle(values: Sequence[float], digits: int = 1) -> str:
    """Median with its bootstrap interval (95 %)."""
    if not values:
        return NOTHING
    centre, low, high = bootstrap_median(values)
    return f"{centre:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def flags(records: Iterable[Record], name: str) -> list[bool]:
    """A yes or no of each run."""
    return [bool(record.figures[name]) for record in records]


def numbers(records: Iterable[Record], name: str) -> list[float]:
    """A number of each run that has it."""
    return [float(record.figures[name]) for record in records if record.figures.get(name) is not None]


def cumulative(record: Record, *, held: bool = False) -> float | None:
    """Sum of the nll over the steps; None where the truth was not known.

    Args:
        record: of a run.
        held: hold the last nll to the last step that was allowed, as if the run had stood still after its stop.
    """
    total, course = record.figures.get("cumulative_nll"), record.curves.get("nll") or []
    if total is None or not course or course[-1] is None:
        return None
    left = int(record.figures["allowed"]) + 1 - len(course) if held else 0
    return float(total) + max(0, left) * float(course[-1])


def held(course: Sequence[float | None], allowed: int) -> list[float]:
    """Numbers over all steps that were allowed, the last one held; NaN where there is none."""
    values = [float("nan") if value is None else float(value) for value in course]
    return values + values[-1:] * max(0, allowed + 1 - len(values))


def plain_median(values: Sequence[float], digits: int = 0) -> str:
    """Median alone."""
    return f"{median(values):.{digits}f}" if values else NOTHING


def push_errors(errors: Mapping[str, tuple[Tensor, Tensor]]) -> str:
    """Errors of place (m) and of yaw (rad) by model."""
    rows = []
    for name, (place, turn) in errors.items():
        values = (1e3 * place, torch.rad2deg(turn.abs()))
        rows.append([name, *(f"{float(x):.1f}" for v in values for x in (v.median(), v.mean(), v.quantile(0.9)))])
    heads = ("model", "place: median, mm", "mean", "90 %", "yaw: median, degrees", "mean", "90 %")
    return table(heads, rows)
