"""What the timed work should achieve, and tables of results with it for a page."""

from collections.abc import Iterable, Mapping
from typing import Any

from rumi.bench import table
from rumi.bench.measure import Result

_VALUE, _GRADIENT = ("CachedSDF", "ComposedSDF"), ("CachedSDF+grad", "ComposedSDF+grad")
_CHSEL, _NAIVE, _LOOP, _MPPI = (
    ("chsel default", "chsel Eq 3"),
    ("all points, all steps",),
    ("torch.unique",),
    ("pytorch-mppi",),
)

Target = tuple[str, float] | tuple[str, float, tuple[str, ...]]
"""A variant with its most seconds, or how many times quicker than the quickest of some others it should be."""

_FIELD = {"mug": (12e-3, 3e-3), "box": (110e-3, 10e-3)}
TARGETS: dict[str, list[Target]] = {
    **{
        f"field-{name}{mode}": [
            ("torch", slow),
            ("numba", quick),
            *([("numba", 8.0, _VALUE), ("numba", 14.0, _GRADIENT)] if not mode else []),
        ]
        for name, (slow, quick) in _FIELD.items()
        for mode in ("", "-mi")
    },
    "gradient-mug": [("torch", 30e-9 * 656_100), ("numba", 6e-9 * 656_100)],
    "gradient-box": [("torch", 30e-9 * 1_849_100), ("numba", 6e-9 * 1_849_100)],
    "rollouts": [("numba", 15e-3), ("numba", 15.0, _NAIVE), ("torch", 80e-3)],
    "trajectory": [("numba", 5e-3), ("numba", 30.0, _LOOP), ("torch", 40e-3)],
    "reach-mug": [("torch, one correlation", 1e-3)],
    "reach-box": [("torch, one correlation", 5e-3)],
    "registration": [("numba", 1.0)],
    **{
        name: [
            ("torch, step by step", 1e-3),
            ("torch, step by step", 5.0, _MPPI),
            ("torch, whole sequences", 5.0, _MPPI),
        ]
        for name in ("kmppi-paper", "kmppi-toy")
    },
    "plan-mug": [("torch", 165e-3), ("numba", 30e-3)],
    "plan-mug-pushed": [("torch", 165e-3), ("numba", 30e-3)],
    "plan-box": [("torch", 500e-3), ("numba", 120e-3)],
    "run-mug": [("numba", 5.0)],
    "import": [("rumi", 1.5)],
}
"""Promises by case; of `import` beyond what torch and numpy take."""

GOALS: dict[str, list[Target]] = {
    "field-mug": [("numba", 20.0, _GRADIENT)],
    "field-box": [("numba", 20.0, _GRADIENT)],
    "rollouts": [("numba", 25.0, _NAIVE)],
    "plan-mug": [("numba", 20e-3)],
    "plan-mug-pushed": [("numba", 20e-3)],
    "plan-box": [("numba", 60e-3)],
}
"""Something to aim at, not a promise."""


def verdicts(result: Result) -> list[dict[str, Any]]:
    """Which of a case's targets are met; those that name what was not timed are left out."""
    medians = {row.name: row.timing.median_s for row in result.rows}
    found = []
    for goal, targets in ((False, TARGETS), (True, GOALS)):
        for variant, bound, *others in targets.get(result.name, ()):
            against = {name: medians[name] for name in (others[0] if others else ()) if name in medians}
            if variant not in medians or (others and not against):
                continue
            verdict: dict[str, Any] = {"variant": variant, "goal": goal}
            if others:
                quickest = min(against, key=lambda name: against[name])
                factor = against[quickest] / medians[variant]
                verdict |= {"at_least": bound, "quickest": quickest, "factor": factor, "met": factor >= bound}
            else:
                beyond = medians[result.baseline] if result.name == "import" else 0.0
                verdict |= {"at_most_s": bound, "met": medians[variant] - beyond <= bound}
            found.append(verdict)
    return found


def markdown(results: Iterable[Result], machine: Mapping[str, Any]) -> str:
    """Tables for a page."""
    lines = [f"{line}\n" for line in table.about(dict(machine)).strip().splitlines()]
    for result in results:
        lines += [f"**{result.name}**: {table.headline(result)}\n"]
        lines += [f"| {' | '.join((*table.HEADER, 'targets'))} |", "|---" * (len(table.HEADER) + 1) + "|"]
        for row in table.cells(result):
            own = "; ".join(_said(verdict) for verdict in verdicts(result) if verdict["variant"] == row[0])
            lines.append(f"| {' | '.join((*row, own))} |")
        lines += ["", *(f"- {note}" for note in table.notes(result)), ""]
    return "\n".join(lines)


def _said(verdict: Mapping[str, Any]) -> str:
    if "factor" in verdict:
        bound = f">= {verdict['at_least']:g}x {verdict['quickest']}: {table.digits(verdict['factor'])}x"
    else:
        bound = f"<= {table.seconds(verdict['at_most_s'])}"
    return f"{'goal ' if verdict['goal'] else ''}{bound}, {'met' if verdict['met'] else 'MISSED'}"
