"""Why a belief is not sure, and what a run relies on, in words."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

import rumi
from rumi.belief.particles import PoseBelief
from rumi.information.stopping import STOP_RULES, StopEvidence, StopSettings, converged, shortfalls
from rumi.records import StepRecord
from rumi.runs.progress import announce
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.answer import relies_on, warnings, why_not
from rumi.tasks.rummage.build import build_rummager
from rumi.tasks.rummage.scenes import find_task, large_handled_mug, make_tool
from rumi.tasks.rummage.settings import Settings
from sdf import se3
from sdf.object_model import box_model
from tests.fixtures.made_up_run import make_up

MADE_UP = make_up(2, particles=2).steps[1]
VIEW = replace(make_up(2, particles=2).steps[0].reading, object_motion=None)


def step(poses: torch.Tensor, **numbers: float) -> StepRecord:
    known: dict[str, Any] = {"expected_nll": 1.0, "fit": 1.0, "apc": 0.001, "contacts": 5, **numbers}
    reading = replace(MADE_UP.reading, object_motion=None)
    return replace(MADE_UP, belief=PoseBelief.uniform(poses), reading=reading, **known)


def rummager(motion: str = "measured", **changes: Any) -> Rummager:
    spec, model = replace(find_task("mug-0"), **changes), large_handled_mug()
    settings = Settings()
    settings = replace(settings, filter=replace(settings.filter, motion=motion))
    return build_rummager(spec, settings, model, make_tool(spec, free_flying=True))


@pytest.fixture(scope="module")
def mug() -> Rummager:
    return rummager()


def said(agent: Rummager, record: StepRecord, stopped_by: Any = "steps", rule: str = "self") -> Any:
    agent = replace(agent, stop_rule=StopSettings(rule=rule))
    return why_not(agent, record, record.belief.summary(agent.model.symmetries), stopped_by)


def turned(*yaws: float) -> torch.Tensor:
    return se3.from_planar(torch.tensor([[0.5, 0.0, yaw] for yaw in yaws]))


def test_it_says_why_it_is_not_sure(mug):
    assert said(mug, step(turned(0.0)), "sure") is None
    assert said(mug, step(turned(0.0), fit=12.0)) == (
        "no pose explains the observations (least discrepancy 12, allowed 7.5): calibration, wrench sign, floor "
        "height, mesh? `rumi check` shows where; all actions are used up"
    )
    several = said(mug, step(turned(0.0, 0.0, 2.0), expected_nll=20.0), "nothing to do")
    assert several.startswith(
        "2 poses explain the observations (0.67, 0.33 of the weight), the first two 0 mm and 115 "
    )
    assert "would tell them apart" in several and several.endswith("no action was found worth doing")
    assert "0 actions touched" in said(mug, step(turned(0.0), contacts=0), "budget")
    assert "not closely enough (the belief expects 6.1, allowed 5)" in said(mug, step(turned(0.0), expected_nll=6.1))
    assert "rule 'never'" in said(mug, step(turned(0.0)), rule="never")
    record = step(turned(0.0))
    assert why_not(mug, record, record.belief.summary(), "steps", "it may lie") == "it may lie; all actions are used up"


def test_it_says_where_no_trajectory_explains_what_was_sensed(mug, monkeypatch):
    monkeypatch.setattr(type(mug.filter), "log_chance", lambda *_: math.log(1e-4))
    for rule in ("self", "probability"):
        words = said(mug, step(turned(0.0)), rule=rule)
        assert words.startswith(
            "no pose explains the observations (readings as unlikely as these have a chance of 0.0001"
        )


@pytest.mark.parametrize("rule", ["auto", "self", "probability", "apc", "never"])
def test_a_rule_holds_where_nothing_is_short_of_it(rule):
    assert rule in STOP_RULES
    for fit in (1.0, 5.4, 5.6, float("nan")):
        for expected in (4.9, 5.0, float("inf")):
            for contacts in (0, 1):
                now = StopEvidence(expected, fit, 0.001, 0.2, contacts)
                settings = StopSettings(rule=rule)
                assert converged(settings, now) == (not shortfalls(settings, now))
                poor = now._replace(chance=1e-3, p_right=0.99)
                assert rule == "apc" or not converged(settings, poor)


@pytest.mark.parametrize(
    ("motion", "changes", "words", "warned"),
    [
        ("measured", {}, "motion: measured; reach: none; push model: quasi-static; sensors: a first view", False),
        ("measured", {"measures_motion": False}, "not measured, each particle's own, by a push model with noise", True),
        ("trajectory", {}, "motion: sensed, as evidence of each particle's own, by a push model with noise", False),
        ("corrected", {}, "not measured, taken from the push model and corrected", True),
        ("sticking", {}, "not measured, taken to stick to the tool", True),
        ("pushed", {}, "not measured, taken from the push model; reach", True),
        ("corrected", {"looks_again": True}, "a camera that looks after every action", False),
    ],
)
def test_it_says_what_it_relies_on(motion, changes, words, warned, capsys):
    agent = rummager(motion=motion, **changes)
    announce(agent)
    lines = capsys.readouterr().err.splitlines()
    assert max(map(len, lines)) <= 80
    assert f"rumi: relies on {relies_on(agent)}" in (said := " ".join(" ".join(lines).split()))
    assert ("rumi: warning: the object's motion is not measured" in said) is warned
    assert words in relies_on(agent)
    assert bool(warnings(agent)) is warned
    if warned:
        assert "the object's motion is not measured" in warnings(agent)[0] and "sure and wrong" in warnings(agent)[0]
    record = step(turned(0.0))
    missing = warnings(agent, (record, record))
    assert bool(missing) is not bool(changes.get("looks_again"))
    if motion == "measured" and not changes:
        assert "not measured in action 1, and" in missing[0]
    free = replace(record.reading, in_contact=torch.zeros_like(record.reading.in_contact))
    none = torch.zeros(0, dtype=torch.long)
    unseen = replace(free, observation=free.observation[none], instant=none)
    assert warnings(agent, (record, replace(record, reading=VIEW))) == (), "a camera saw it again"
    assert bool(warnings(agent, (record, replace(record, reading=unseen)))) is bool(missing)


def test_in_space_it_speaks_of_space():
    agent = build_rummager(
        find_task("box"), rumi.preset("default", task="box"), box_model(), make_tool(find_task("box"), free_flying=True)
    )
    assert "slide and topple" in relies_on(agent) and "slide and topple" in warnings(agent)[0]
    assert "mugs" not in warnings(agent)[0] and "results/conditions.md" in warnings(agent)[0]


@pytest.mark.parametrize(
    ("conditions", "told"), [("ideal", True), ("ideal, but measures_motion False", True), ("lab", False)]
)
def test_the_record_of_ideal_conditions_is_told_of_those_alone(conditions, told):
    agent = replace(rummager(motion="trajectory", measures_motion=False), conditions=conditions)
    assert ("drawn mugs on record" in warnings(agent)[0]) is told
    assert ("results/conditions.md" in warnings(agent)[0]) is not told
