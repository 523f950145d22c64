"""One run, as it is kept: how it ended, what it took, and its course."""

import time
from pathlib import Path
from typing import Any

from rumi import loop
from rumi.errors import DegenerateBeliefError
from rumi.planning.policy import Plan
from rumi.records import StepRecord
from rumi.runs.plain import plain
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import Settings

DIGITS = 5
"""Significant digits of the numbers over the steps."""


def carry_out(settings: Settings, cache_dir: Path) -> dict[str, Any]:
    """Do a run.

    Args:
        settings: of the run.
        cache_dir: folder that keeps what takes seconds to work out.

    Returns:
        `figures`: the fields of `rumi.records.RunResult` with the task's threshold, steps and diagonal; of a run whose
        belief lost all weight, what is known by then, with stopped_by "degenerate". `timings`: seconds of the whole
        run and by stage, planning by stage and the number of plans. `curves`: nll, apc and expected_nll by step.

    Raises:
        KeyboardInterrupt: the run was interrupted; what there is of it is no result.
    """
    spec = find_task(settings.task)
    steps = spec.steps if settings.steps is None else settings.steps
    course = Course()
    begun = time.perf_counter()
    parts = build(settings, cache_dir=cache_dir)
    ready = time.perf_counter()
    try:
        result = loop.run_to_end(parts.task, parts.agent, seed=settings.seed, steps=steps, on_step=course)
        figures = dict(plain(result.as_dict()))
    except DegenerateBeliefError:
        figures = _degenerate(course, spec.nll_threshold)
    finally:
        parts.task.close()
    ended = time.perf_counter()
    stages = figures.pop("timings_s")
    return {
        "figures": figures
        | {"nll_threshold": spec.nll_threshold, "allowed": steps, "diagonal": float(parts.agent.model.diagonal)},
        "timings": {
            "wall_s": ended - begun,
            "build_s": ready - begun,
            "stages_s": stages,
            "planning_s": course.planning,
            "plans": course.plans,
        },
        "curves": course.curves,
    }


class Course:
    """Notes nll, apc and expected nll of every step, and what its plan took; an `on_step` of `rumi.loop.run`."""

    def __init__(self) -> None:
        self.curves: dict[str, list[float | None]] = {"nll": [], "apc": [], "expected_nll": []}
        self.planning: dict[str, float] = {}
        self.plans = 0
        self._last: Plan | None = None

    def __call__(self, step: StepRecord) -> None:
        """Note a step."""
        for name, values in self.curves.items():
            value = plain(getattr(step, name))
            values.append(None if value is None else float(f"{value:.{DIGITS}g}"))
        if step.plan is not None and step.plan is not self._last:
            self._last = step.plan
            self.plans += 1
            for stage, seconds in step.plan.timings_s.items():
                self.planning[stage] = self.planning.get(stage, 0.0) + seconds


def _degenerate(course: Course, threshold: float) -> dict[str, Any]:
    """The figures of a run that ended in a belief without weight: not right, whatever it was before."""
    nll = [value for value in course.curves["nll"] if value is not None]
    figures: dict[str, Any] = dict.fromkeys(
        ("final_nll", "apc", "expected_nll", "position_error_mm", "rotation_error_deg", "contacts", "clipped")
    )
    return figures | {
        "right": False,
        "paper_success": bool(nll) and min(nll) <= threshold,
        "paper_success_at_start": bool(nll) and nll[0] <= threshold,
        "min_nll": min(nll, default=None),
        "cumulative_nll": sum(nll) if nll else None,
        "steps": max(0, len(course.curves["nll"]) - 1),
        "stopped_by": "degenerate",
        "timings_s": {},
    }
