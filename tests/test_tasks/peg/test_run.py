"""The whole peg task, its command and its figures."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from rumi import loop
from rumi.belief.static_filter import StaticBelief
from rumi.cli import main
from rumi.information.state_rules import TargetEstimate
from rumi.runs.jsonlines import read_lines
from rumi.tasks.peg import selection as refine
from rumi.tasks.peg.agent import build_peg
from rumi.tasks.peg.entry import summary
from rumi.tasks.peg.figures import clusters, draw_run
from rumi.tasks.peg.search import lanes
from rumi.tasks.peg.selection import sure
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.peg.simulated import PegTask
from sensors.touch.rectangle_touch import RectangleTouches


def run_of(settings, seed):
    return loop.run(*build_peg(settings), seed=seed)


QUICK = PegSettings(particles=200, search_particles=600, point_m=0.001, normal_deg=2.0)


def test_a_sharp_sensor_finds_the_hole():
    for seed in range(3):
        run = run_of(QUICK, seed)
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


@pytest.mark.parametrize(("point_m", "normal_deg", "seed"), [(2e-4, 0.3, 6), (5e-5, 0.1, 0), (5e-5, 0.1, 1)])
def test_a_nearly_exact_sensor_does_not_take_one_side_for_another(point_m, normal_deg, seed):
    """Readings much more exact than particles are apart used to leave only the one that happened to fit."""
    run = run_of(PegSettings(point_m=point_m, normal_deg=normal_deg, evaluation_s=0.003), seed)
    assert run.stopped_by == "sure" and run.hole_error_m < 0.001


def test_it_ends_where_nothing_can_be_done():
    allowed = replace(QUICK, action_budget_s=1.0, doublings=0)
    run = run_of(allowed, 0)
    assert run.stopped_by == "nothing to do" and len(run.felt) == 0 and run.as_dict()["touches"] == 1
    assert summary(run)[0].startswith("no time for any motion after 1 touch, ")
    few = run_of(replace(QUICK, most_actions=1), 0)
    assert few.stopped_by == "steps" and len(few.felt) == 1
    assert summary(few)[0].startswith("not sure after 2 touches, ")


def test_it_ends_where_nothing_tells_anything(monkeypatch):
    monkeypatch.setattr(refine, "touch_gain", lambda *_, **__: torch.zeros(()))
    run = run_of(QUICK, 0)
    assert run.stopped_by == "nothing to do" and run.thoughts[-1].selection.evaluated > 0
    assert summary(run)[0].startswith("nothing more that a touch would tell after 1 touch, ")


def test_a_run_that_ended_before_its_first_motion_is_drawn(tmp_path):
    run = loop.run(*build_peg(QUICK), seed=0, steps=0)
    assert not run.searched and run.as_dict()["search_s"] == 0.0
    assert [path.name for path in draw_run(run, tmp_path)] == ["contacts.png", "timeline.png"]


def test_it_ends_where_no_lane_meets_the_block():
    class Elsewhere(PegTask):
        def reset(self, seed):
            result = super().reset(seed)
            self.cell.truth = self.cell.truth + 5.0
            return result

    run = loop.run(Elsewhere(QUICK), build_peg(QUICK).agent, seed=0)
    assert run.stopped_by == "nothing to do" and run.inserted is None and run.why_not == "the block was not met"
    assert len(run.searched) == len(lanes(QUICK)) - 1
    assert summary(run)[0] == "nothing met on any lane after 0 touches"


def test_the_papers_stop():
    run = run_of(replace(QUICK, stop="contacts"), 0)
    assert run.stopped_by == "sure" and run.as_dict()["touches"] >= 4


def test_stops_by_spread_and_by_entropy():
    """Both end sure, later where they ask for more, and the belief then is what they ask for."""
    ends = {}
    for stop, limits in (("covariance", ({"spread_m": 0.01, "spread_deg": 9.0}, {"spread_m": 0.0005})),
                         ("entropy", ({"most_nats": -9.0}, {"most_nats": -16.0}))):  # fmt: skip
        runs = [run_of(replace(QUICK, stop=stop, contacts=1, most_actions=12, **limit), 1) for limit in limits]
        assert [run.stopped_by for run in runs] == ["sure", "sure"]
        assert len(runs[0].felt) < len(runs[1].felt)
        ends[stop] = runs[1]
    for run in ends.values():
        assert run.as_dict()["right"]


def test_the_entropy_of_the_block_knows_no_half_turns():
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([0.002, 0.002, 0.03], dtype=torch.float64)
    states = spread * torch.randn(400, 3, generator=generator, dtype=torch.float64)
    turned = states + torch.tensor([0.0, 0.0, torch.pi]) * (torch.arange(400) % 2)[:, None]
    flat = torch.zeros(400, dtype=torch.float64).log_softmax(-1)
    # of a normal distribution, and half a nat to each side
    nats = 1.5 * (1.0 + math.log(2.0 * math.pi)) + float(spread.log().sum())
    nothing = RectangleTouches.none(QUICK.block.half(), QUICK.noise, QUICK.radius_m)
    aim = TargetEstimate(torch.zeros(2, 2), 0.0)
    for poses in (states, turned):
        belief = StaticBelief(poses, flat, flat)
        held = [
            sure(belief, nothing, aim, replace(QUICK, stop="entropy", contacts=0, most_nats=nats + off))
            for off in (-0.3, 0.3)
        ]
        assert held == [False, True]
        wide = replace(QUICK, stop="covariance", contacts=0, spread_m=0.0025, spread_deg=math.degrees(0.0375))
        assert sure(belief, nothing, aim, wide)
        assert not sure(belief, nothing, aim, replace(wide, spread_m=0.0015))
        assert not sure(belief, nothing, aim, replace(wide, spread_deg=1.2))


def test_the_command(tmp_path, capsys):
    folder = tmp_path / "run"
    arguments = ["run", "peg", "--action-budget-s", "10", "--seed", "3", "--out", str(folder)]
    assert main([*arguments, "--point-m", "0.001", "--normal-deg", "2", "--particles", "200"]) == 0
    assert "touches" in capsys.readouterr().out
    found = json.loads((folder / "result.json").read_text())
    assert json.loads((folder / "settings.json").read_text())["peg"]["action_budget_s"] == 10.0 and found["in_hole"]
    steps = [line for line, _ in read_lines(folder / "steps.jsonl")]
    assert {step["felt"] for step in steps} <= {"nothing", "side", "top"} and steps[-1]["sure"]
    pictures = [folder / "figures" / name for name in ("contacts.png", "timeline.png")]
    assert all(path.stat().st_size > 10_000 for path in pictures)
    assert main(["plot", str(folder), "--out", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again/timeline.png").read_bytes() == pictures[1].read_bytes()
    assert main(["replay", str(folder)]) == 0
    assert f"the recorded one, bit for bit, after each of {len(steps)} readings" in capsys.readouterr().out


def test_labels_of_touches_that_lie_together_are_one():
    ahead, aside = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    near = [(np.array([0.001 * index, 0.0]), ahead) for index in range(4)]
    touches = [*near[:2], (np.array([0.0, 0.0]), aside), *near[2:], (np.array([0.5, 0.0]), ahead)]
    named = clusters(touches)
    assert [words for words, _, _ in named] == ["1–2, 4–5", "3", "6"]
    np.testing.assert_allclose(named[0][1], [0.0015, 0.0])
    assert named[0][2] is ahead
