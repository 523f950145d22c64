"""Carrying out a case: do its variants agree, how long does each take, and are the targets met."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from rumi.bench.case import By, Case, Variant
from rumi.bench.timing import Timing, time_in_turn
from rumi.runs.plain import plain
from sdf import backend


@dataclass(frozen=True)
class Row:
    """One variant's result.

    Attributes:
        name, by, note: of the variant.
        timing: of the whole work, scaled up where the variant did a share of it.
        error: distance of its result from the reference's; None where there is none.
        ran: the version of each dispatched operation that ran.
    """

    name: str
    by: By
    timing: Timing
    error: float | None = None
    note: str = ""
    ran: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    """A case, carried out.

    Attributes:
        name: of the case.
        case: what was carried out.
        rows: one a variant.
        baseline: the variant that ratios are taken against.
        agree: whether all variants of this project gave the same.
        left_out: what was not timed, and why.
    """

    name: str
    case: Case
    rows: tuple[Row, ...]
    baseline: str
    agree: bool
    left_out: tuple[str, ...]

    def row(self, name: str) -> Row:
        """The row of a variant."""
        return next(row for row in self.rows if row.name == name)

    def ratio(self, row: Row) -> float:
        """How many times quicker than the baseline a variant is."""
        return self.row(self.baseline).timing.median_s / row.timing.median_s

    def as_dict(self) -> dict[str, Any]:
        """As plain values."""
        case = self.case
        rows = [
            {
                "name": row.name,
                "by": row.by,
                "median_s": row.timing.median_s,
                "least_s": row.timing.least_s,
                "quartiles_s": list(row.timing.quartiles_s),
                "samples": len(row.timing.samples_s),
                "quicker": self.ratio(row),
                "error": row.error,
                "note": row.note,
                "ran": row.ran,
            }
            for row in self.rows
        ]
        return {
            "name": self.name,
            "title": case.title,
            "items": case.items,
            "item": case.item,
            "baseline": self.baseline,
            "agree": self.agree,
            "tolerance": case.tolerance,
            "variants": rows,
            "facts": plain(case.facts),
            "remarks": list(case.remarks),
            "left_out": list(self.left_out),
        }


def carry_out(
    name: str,
    case: Case,
    *,
    budget_s: float,
    least: int = 3,
    device: torch.device | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Result:
    """Do a case.

    A variant of others that fails is left out, with what it said; one of this project's own fails the case.

    Args:
        name: of the case.
        case: its work.
        budget_s: seconds for the timed rounds.
        least: rounds at least.
        device: that is waited for before the clock is read.
        clock: gives seconds.
    """
    wait = torch.cuda.synchronize if device is not None and device.type == "cuda" else None
    found: dict[str, Any] = {}
    ran: dict[str, dict[str, str]] = {}
    left_out = list(case.left_out)
    for variant in case.variants:
        if not case.warm:
            found[variant.name], ran[variant.name] = None, {}
            continue
        try:
            with backend.observed() as ran[variant.name]:
                found[variant.name] = variant()
        except Exception as error:  # what a library of others raises is its own affair
            if variant.by == "rumi":
                raise
            left_out.append(
                f"{variant.name}: failed, {type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
            )
    variants = [variant for variant in case.variants if variant.name in found]
    errors = _errors(case, variants, found)
    own = [errors[variant.name] for variant in variants if variant.by == "rumi"]
    agree = all(error is None or error <= case.tolerance for error in own)

    def waited(variant: Variant) -> Callable[[], object]:
        if wait is None:
            return variant

        def call() -> None:
            variant()
            wait()

        return call

    most = 100 if case.rounds is None else case.rounds
    timings = time_in_turn(
        {v.name: waited(v) for v in variants},
        budget_s=budget_s,
        least=min(least, most),
        most=most,
        clock=clock,
        warm=case.warm,
    )
    rows = tuple(
        Row(v.name, v.by, timings[v.name].scaled(1.0 / v.share), errors[v.name], _note(v), ran[v.name])
        for v in variants
    )
    there = [name for name in case.baselines if name in found] or [case.otherwise]
    medians = {row.name: row.timing.median_s for row in rows}
    baseline = min(there, key=lambda name: medians[name])
    return Result(name, case, rows, baseline, agree, tuple(left_out))


def _errors(case: Case, variants: list[Variant], found: dict[str, Any]) -> dict[str, float | None]:
    error = case.error
    if error is None:
        return {variant.name: None for variant in variants}
    first = next(variant.name for variant in variants if variant.by == "rumi")
    reference = found[first] if case.reference is None else case.reference
    itself = first if case.reference is None else None
    return {
        variant.name: error(found[variant.name], reference) if variant.comparable and variant.name != itself else None
        for variant in variants
    }


def _note(variant: Variant) -> str:
    if variant.share == 1.0:
        return variant.note
    part = f"1/{1.0 / variant.share:.0f} of the work timed"
    return f"{variant.note}; {part}" if variant.note else part
