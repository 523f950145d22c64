"""The whole peg task, its command and its figures."""

import json
from dataclasses import replace
from itertools import pairwise

import pytest

from rumi import commands
from rumi.errors import UsageError
from rumi.peg.run import run_peg
from rumi.peg.settings import PegSettings
from rumi.peg_command import PegOptions, settings_of
from rumi.sim.touch_cell import TOP

QUICK = PegSettings(particles=200, search_particles=600, point_m=0.001, normal_deg=2.0)


def test_a_sharp_sensor_finds_the_hole():
    for seed in range(3):
        run = run_peg(QUICK, seed)
        found = run.as_dict()
        assert run.stopped_by == "sure" and run.aim.probability >= 0.95
        assert found["in_hole"] and found["hole_error_mm"] < 5.0
        assert 4 <= found["touches"] <= 12
        # no decision and its motion took longer than allowed
        assert found["late_s"] <= 1e-9
        for thought, felt in zip(run.thoughts, run.felt, strict=True):
            assert felt.ended_s - thought.begun_s <= thought.selection.t_max_s + 1e-9
        # time goes on without gaps or overlaps
        spans = [(t.begun_s, t.ended_s) for t in run.thoughts] + [(f.begun_s, f.ended_s) for f in run.felt]
        spans.sort()
        assert all(b >= a for (_, a), (b, _) in pairwise(spans))
        assert found["contact_s"] == sorted(found["contact_s"]) and found["contact_s"][0] == found["search_s"]
        assert run.total_s > found["contact_s"][-1]
        assert len(run.probabilities) == len(run.felt) + 1
        json.dumps(found, allow_nan=False)


def test_the_same_seed_twice():
    first, second = (run_peg(QUICK, 7) for _ in range(2))
    assert first.as_dict() == second.as_dict()
    assert run_peg(QUICK, 8).truth.tolist() != first.truth.tolist()


def test_it_ends_where_nothing_can_be_done():
    allowed = replace(QUICK, t_max_s=1.0, doublings=0)
    run = run_peg(allowed, 0)
    assert run.stopped_by == "stay" and len(run.felt) == 0 and run.as_dict()["touches"] == 1
    few = run_peg(replace(QUICK, most_actions=1), 0)
    assert few.stopped_by == "actions" and len(few.felt) == 1


def test_the_papers_stop():
    run = run_peg(replace(QUICK, stop="contacts"), 0)
    assert run.stopped_by == "sure" and run.as_dict()["touches"] >= 4


def test_the_command(tmp_path, capsys):
    folder = tmp_path / "run"
    arguments = ["peg", "--t-max", "10", "--seed", "3", "--out", str(folder)]
    code = commands.run([*arguments, "--set", "point_m=0.001", "normal_deg=2", "particles=200"])
    assert code == 0
    assert "touches" in capsys.readouterr().out
    found = json.loads((folder / "result.json").read_text())
    assert found["settings"]["t_max_s"] == 10.0 and found["in_hole"]
    assert {motion["kind"] for motion in found["motions"]} <= {"nothing", "side", "top"}
    assert len(found["decisions"]) == found["actions"]
    assert (folder / "contacts.png").stat().st_size > 10_000 and (folder / "timeline.png").stat().st_size > 10_000
    commands.tasks([])
    assert "peg" in capsys.readouterr().out
    assert TOP == 2  # the names of the kinds in the record are in this order


def test_what_cannot_be():
    for options, message in (
        (PegOptions(evaluation="quick"), "seconds or real"),
        (PegOptions(set=("colour=blue",)), "no setting 'colour'"),
        (PegOptions(set=("particles",)), "setting of peg and its value"),
        (PegOptions(set=("particles=many",)), "another kind"),
    ):
        with pytest.raises(UsageError, match=message):
            settings_of(options)
    with pytest.raises(ValueError, match="t_max_s above 0"):
        settings_of(PegOptions(t_max=0.0))
    assert settings_of(PegOptions(evaluation="real")).evaluation_s is None
