"""Made-up results, of which every figure of the tables is known."""

from collections.abc import Callable

import pytest

from scripts.reproduce.records import Record


def make(task: str = "mug-0", method: str = "rumi", seed: int = 0, *, nll: tuple[float, ...], **changes) -> Record:
    """A run with a course of nll; it stops by itself where that ends below 20 before the 4 allowed actions."""
    steps, threshold = len(nll) - 1, 20.0
    figures = {
        "right": nll[-1] <= threshold,
        "paper_success": min(nll) <= threshold,
        "paper_success_at_start": nll[0] <= threshold,
        "min_nll": min(nll),
        "final_nll": nll[-1],
        "cumulative_nll": sum(nll),
        "steps": steps,
        "stopped_by": "sure" if steps < 4 else "steps",
        "apc": 0.001,
        "expected_nll": nll[-1],
        "position_error_mm": 1.0 if nll[-1] <= threshold else 9.0,
        "rotation_error_deg": 2.0,
        "contacts": 1,
        "clipped": 0,
        "nll_threshold": threshold,
        "allowed": 4,
        "diagonal": 0.2,
    }
    timings = {"wall_s": 2.0 * steps, "stages_s": {}, "planning_s": {"fields": 0.1, "costs": 0.3}, "plans": 2}
    curves = {"nll": [*nll], "apc": [value / 1000 for value in nll], "expected_nll": [50.0 - value for value in nll]}
    values = {"preset": "default", "overrides": (), "code": "c0de", "commit": "abc", "machine": "here"} | changes
    return Record(
        kind="run", task=task, method=method, seed=seed, figures=figures, timings=timings, curves=curves, **values
    )


@pytest.fixture(scope="session")
def made() -> Callable[..., Record]:
    """Makes up a run; see `make`."""
    return make
