"""Drawn faults: each kind as often, each one that a run takes, and a table that tells what was found."""

from collections import Counter
from typing import Any

import pytest

from rumi.cli import main
from rumi.sim.faults import parse_fault
from rumi.tasks.rummage.build import faults_of
from rumi.tasks.rummage.drawn_scenes import DRAWN
from scripts import drawn_faults
from scripts.drawn_faults import STEPS, drawn_fault, far, flagged, kinds_of, settings_of, show
from scripts.outcomes import right


def ended(**changes: Any) -> dict[str, Any]:
    found = {"stopped_by": "sure", "right": True, "lost": False, "mm": 1.0, "deg": 2.0, "alarms": [], "odd": []}
    return found | {"steps": 7, "least_p": 0.5, "cpu_s": 3.0, "changed": 4} | changes


def line(fault: str, faulted: dict[str, Any], faultless: dict[str, Any] | None = None) -> dict[str, Any]:
    made = {"task": "mug", "conditions": "ideal", "seed": 1, "fault": fault}
    return made | {"faulted": faulted, "faultless": faultless or ended()}


@pytest.mark.parametrize("task", DRAWN)
def test_every_kind_comes_as_often_and_can_be(task):
    drawn = [drawn_fault(task, seed) for seed in range(100)]
    kinds = Counter(text.partition("@")[0].partition(":")[0] for text in drawn)
    assert kinds.keys() == set(kinds_of(task)) and min(kinds.values()) >= 100 // len(kinds)
    assert len(set(drawn)) > 50 and drawn == [drawn_fault(task, seed) for seed in range(100)]
    for text in drawn:
        parse_fault(text, steps=STEPS)
        assert faults_of(DRAWN[task], settings_of(task, 1, text))


def test_what_counts_as_far_flagged_and_right():
    assert far(ended(mm=21.0)) and far(ended(deg=21.0)) and far(ended(mm=None)) and not far(ended())
    assert flagged(ended(lost=True)) and flagged(ended(stopped_by="steps"))
    assert not flagged(ended(alarms=[[4, "knocked"]]))  # it searched again, and says that it is sure
    assert right(ended()) and not right(ended(lost=True)) and not right(ended(right=False))


def test_the_table_tells_each_kind_and_the_runs_without():
    lines = [
        line("knock:30@3", ended(alarms=[[5, "knocked"]])),
        line("knock:25@3", ended(alarms=[[2, "absent"], [4, "hand off"]], right=False, mm=30.0)),
        line("mass:3@1", ended(changed=None), ended(alarms=[[3, "knocked"]])),
    ]
    text = show(lines, {})
    knock, mass, some = (row.split(" | ") for row in text.splitlines()[4:7])
    assert knock[0] == "| knock" and knock[1].startswith("1/2") and knock[2].startswith("1/2")
    assert knock[3].startswith("1 [") and knock[4].startswith("1/2")
    assert mass[0] == "| mass" and mass[2] == "-" and mass[-1] == "- |"
    assert knock[-1] == "knocked 1, hand off 1 |"
    assert some[0] == "| any" and some[1].startswith("1/3")
    assert "false alarms 1/3" in text
    assert show([], {}) == ""
    more = show([*lines, lines[0] | {"conditions": "lab"}, lines[0] | {"seed": 1003}], {})
    assert more.startswith(text) and more.count("| fault |") == 3
    assert "mug, lab, seeds 1 to 1, 1 of them:" in more and "mug, ideal, seeds 1003 to 1003, 1 of them:" in more


def test_the_conditions_are_the_run_s():
    assert (
        settings_of("mug", 1, "knock@3", "lab").conditions == "lab"
        and settings_of("mug", 1, None).conditions == "ideal"
    )
    assert not settings_of("mug", 1, None, "lab").simulator.measures_motion


def test_a_fault_of_the_first_view_is_named_by_the_first_alarm_of_all():
    lines = [
        line("camera:12@0", ended(changed=0, alarms=[[2, "camera off"]])),
        line("camera:9@0", ended(changed=0, alarms=[[2, "knocked"], [4, "camera off"]])),
    ]
    row = show(lines, {}).splitlines()[4].split(" | ")
    assert row[0] == "| camera" and row[2].startswith("1/2") and row[3].startswith("2 [")


def test_the_stress_command_tells_what_went_wrong(monkeypatch, capsys):
    found = {1000: line("knock:30@3", ended()), 1001: line("absent@2", ended(mm=500.0))}
    monkeypatch.setattr(drawn_faults, "measure", lambda task, seed: found.get(seed, found[1000]) | {"seed": seed})
    assert main(["stress", "--only", "faults", "--seed", "1000", "--rounds", "1"]) == 0
    assert main(["stress", "--only", "faults", "--seed", "1000", "--rounds", "2"]) == 1
    assert "far off, not flagged: seed 1001, absent@2" in capsys.readouterr().out
    assert main(["stress", "--only", "faults", "--seed", "1000", "--rounds", "40"]) == 0  # one of 40 may be chance
    assert main(["stress", "--only", "faults", "--rounds", "0"]) == 2
