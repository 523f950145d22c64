"""Approach: what cannot touch is carried out as planned; what may stops short of the touch, or goes slowly into it."""

from dataclasses import replace

import pytest
import torch

import rumi
from rumi.belief.particles import PoseBelief, normalise
from rumi.robot.tool import Tool
from rumi.tasks.rummage.approach import shortened
from rumi.tasks.rummage.build import build
from sdf.primitives import Box
from tests.test_tasks.rummage.test_trajectory_runs import settings

SLOW_M = 0.04
BOX = Box((0.05, 0.05, 0.05))


def tool() -> Tool:
    return Tool(torch.tensor([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]]), action_scale_m=0.08, action_scale_rad=0.5)


def believed(*places: tuple[float, float, float], weights: tuple[float, ...] = ()) -> PoseBelief:
    poses = torch.eye(4).repeat(len(places), 1, 1)
    poses[:, :3, 3] = torch.tensor(places)
    share = torch.tensor(weights or (1.0,) * len(places))
    return PoseBelief(torch.eye(4), poses, normalise(share.log()), torch.zeros(len(places)), None)


def reach() -> float:
    """How far the tool's foremost point is ahead of it along x, by its own points."""
    return float(tool().points(torch.zeros(4))[:, 0].max())


def ahead(gap_m: float) -> PoseBelief:
    """A box that the tool at the origin, half a metre up, touches after a way along x."""
    return believed((reach() + 0.003 + 0.05 + gap_m, 0.0, 0.5))


HERE = torch.tensor([0.0, 0.0, 0.5, 0.0])
ALONG = torch.tensor([1.0, 0.0, 0.0, 0.0])


def test_what_touches_nothing_is_as_planned():
    asked = ALONG.clone()
    for belief in (ahead(0.2), ahead(0.1), believed((0.0, 0.0, -5.0)), believed((1e6, 0.0, 0.0))):
        assert torch.equal(shortened(asked, tool(), HERE, belief, BOX, SLOW_M), ALONG)
    assert torch.equal(asked, ALONG)


def test_it_stops_short_of_a_touch_that_is_far():
    for gap in (0.055, 0.07, 0.078):
        control = shortened(ALONG, tool(), HERE, ahead(gap), BOX, SLOW_M)
        way = float(control[0]) * 0.08
        assert gap - 0.003 - 0.08 / 20 - 1e-6 <= way <= gap + 1e-6  # to a part of the action
        torch.testing.assert_close(control, ALONG * control[0])  # along the way that was planned


def test_it_goes_on_slowly_into_a_touch_that_is_near():
    for gap, least, most in ((0.0, 0.04, 0.04), (0.02, 0.04, 0.046), (0.045, 0.06, 0.071)):
        way = float(shortened(ALONG, tool(), HERE, ahead(gap), BOX, SLOW_M)[0]) * 0.08
        assert least - 1e-6 <= way <= most + 1e-6


def test_a_short_action_and_one_away_are_as_planned():
    short = 0.5 * ALONG
    assert torch.equal(shortened(short, tool(), HERE, ahead(0.0), BOX, SLOW_M), short)
    turn = torch.tensor([0.0, 0.0, 0.0, 1.0])
    assert torch.equal(shortened(turn, tool(), HERE, ahead(0.02), BOX, SLOW_M), turn)
    still = torch.zeros(4)
    assert torch.equal(shortened(still, tool(), HERE, ahead(0.0), BOX, SLOW_M), still)


@pytest.mark.parametrize(("share", "slow"), [(0.3, True), (0.0, False), (1e-6, False)])
def test_what_few_believe_is_not_waited_for(share, slow):
    there, elsewhere = ahead(0.02), (0.0, 0.0, -5.0)
    near = tuple(there.attached_T_object[0, :3, 3].tolist())
    belief = believed(near, elsewhere, weights=(share, 1.0 - share))
    assert torch.equal(shortened(ALONG, tool(), HERE, belief, BOX, SLOW_M), ALONG) != slow


def test_double_precision_keeps_its_type():
    control = shortened(ALONG.double(), tool().double(), HERE.double(), ahead(0.02), BOX, SLOW_M)
    assert control.dtype == torch.float64 and control[0] < 1.0


@pytest.mark.sim
def test_a_run_in_space_does_so_where_the_motion_is_no_command(all_in_reach):
    for motion, measured, asked, expected in (
        ("measured", True, None, 0.0),
        ("measured", False, None, 0.04),
        ("auto", True, None, 0.04),
        ("auto", False, 0.0, 0.0),
        ("measured", True, 0.03, 0.03),
    ):
        own = rumi.preset("fast", task="drill-0", conditions="ideal", **{"filter.motion": motion})
        tried = replace(own, approach_m=asked, simulator=replace(own.simulator, measures_motion=measured))
        with build(tried, cache_dir=all_in_reach) as (_, agent):
            assert agent.approach_m == expected


@pytest.mark.sim
@pytest.mark.parametrize(("approach_m", "part"), [(0.04, 0.25), (0.0, 1.0)])
def test_a_run_carries_out_the_shortened_control(approach_m, part, all_in_reach, monkeypatch):
    own = replace(settings(), task="drill-0", steps=1, approach_m=approach_m, retreats=False)
    monkeypatch.setattr("rumi.tasks.rummage.agent.shortened", lambda control, *_: 0.25 * control)
    records = []
    with build(own, cache_dir=all_in_reach) as (sim, agent):
        rumi.run(sim, agent, seed=0, on_step=records.append)
    last = records[-1]
    torch.testing.assert_close(last.control, part * last.plan.controls[0])


@pytest.mark.sim
@pytest.mark.parametrize(
    ("task", "careful"), [("drill", True), ("box", False), ("drawn-shelf-box", False), ("mug", False)]
)
def test_only_what_is_soon_toppled_is_approached_with_care(task, careful, all_in_reach):
    for conditions in ("lab", "ideal"):
        with build(rumi.preset("fast", task=task, conditions=conditions), cache_dir=all_in_reach) as (_, agent):
            assert (agent.approach_m > 0, agent.retreats) == (careful, careful)
    told = rumi.preset("fast", task=task, conditions="ideal", **{"filter.motion": "measured"})
    with build(told, cache_dir=all_in_reach) as (_, agent):
        assert (agent.approach_m, agent.retreats) == (0.0, False)
