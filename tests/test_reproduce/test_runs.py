"""What is kept of a run that did not end as it should."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from rumi.errors import DegenerateBeliefError
from rumi.tasks.rummage.settings import preset
from scripts.reproduce import runs
from tests.fixtures.made_up_run import make_up


@pytest.fixture
def closed(monkeypatch):
    """A task and an agent that are there in name only; how often the task was closed."""
    found = []
    parts = SimpleNamespace(
        task=SimpleNamespace(close=lambda: found.append(True)),
        agent=SimpleNamespace(model=SimpleNamespace(diagonal=0.2)),
    )
    monkeypatch.setattr(runs, "build", lambda settings, cache_dir: parts)
    return found


def test_a_belief_without_weight_is_a_result(monkeypatch, closed):
    first = replace(make_up(1).steps[0], nll=12.5, apc=0.0123456789, expected_nll=float("nan"))

    def lost(task, agent, *, seed, steps, on_step):
        on_step(first)
        on_step(replace(first, nll=30.0))
        raise DegenerateBeliefError("no weight left")

    monkeypatch.setattr(runs.loop, "run_to_end", lost)
    found = runs.carry_out(preset(task="mug-0"), Path("cache"))
    figures = found["figures"]
    assert (figures["stopped_by"], figures["right"], figures["steps"]) == ("degenerate", False, 1)
    assert (figures["min_nll"], figures["cumulative_nll"]) == (12.5, 42.5)
    assert figures["paper_success"] is True and figures["allowed"] == 40
    assert found["curves"] == {"nll": [12.5, 30.0], "apc": [0.012346] * 2, "expected_nll": [None] * 2}
    assert json.dumps(found, allow_nan=False)
    assert closed == [True]


def test_an_interrupted_run_is_none(monkeypatch, closed):
    def interrupted(task, agent, *, seed, steps, on_step):
        raise KeyboardInterrupt

    monkeypatch.setattr(runs.loop, "run_to_end", interrupted)
    with pytest.raises(KeyboardInterrupt):
        runs.carry_out(preset(task="mug-0"), Path("cache"))
    assert closed == [True]


def test_every_plan_counts_once():
    steps, timed = make_up(9).steps, {}
    course = runs.Course()
    for step in steps:
        plan = step.plan and timed.setdefault(id(step.plan), replace(step.plan, timings_s={"fields": 0.5}))
        course(replace(step, plan=plan))
    assert course.plans == 3
    assert course.planning == {"fields": 1.5}
    assert course.curves["nll"] == [float(f"{step.nll:.5g}") for step in steps]
