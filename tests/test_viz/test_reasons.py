"""Reasons of an action: gain, place and risk as the plan tells them."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.planning.policy import Plan
from rumi.viz.reasons import reason_of
from tests.fixtures.made_up_run import make_up, scene


@pytest.fixture(scope="module")
def plan():
    return next(step.plan for step in reversed(make_up(6, particles=10).steps) if step.plan is not None)


def test_what_is_left_of_a_plan_is_told(plan):
    reason = reason_of(plan, 0)
    assert reason.gain == pytest.approx((0.5, 3.8)) and reason.total == plan.info["information_total"]
    assert reason.best[0] == 2 and reason.best[1] == tuple(plan.path[2].tolist())
    assert reason.shift_m == pytest.approx((0.0, 0.14)) and reason.costs == (-2.0, 1.0)
    later = reason_of(plan, 2)
    assert later.gain == pytest.approx((0.1, 1.3)) and later.best[0] == 1
    assert later.best[1] == tuple(plan.path[3].tolist())
    assert later.shift_m == pytest.approx((0.01, 0.13))
    assert reason_of(plan, 15).gain is None


def test_information_that_is_pushed_out_of_reach_is_a_risk(plan):
    """All of it at one place, which the robot reaches to the left of a line."""
    _, workspace, _, geometry = scene()
    at = (workspace.points - torch.tensor([0.4, 0.0, 0.0475])).norm(dim=-1).argmin()
    information = torch.zeros(len(workspace.points))
    information[at] = 3.0
    near = (workspace.points[:, 0] < 0.455).float()
    moves = [[0.0, 0.0, 0.0]] + 14 * [[0.01, 0.0, 0.0]]
    info = plan.info | {"predicted_displacement": moves}
    made = replace(plan, fields={"information": information}, info=info)
    assert reason_of(made, 0, replace(geometry, reachability=near)).beyond == (0.0, 0.0, 1.0)
    assert reason_of(made, 0, replace(geometry, reachability=0.25 * torch.ones_like(near))).beyond[0] == 0.75
    far = replace(made, info=info | {"predicted_displacement": 15 * [[9.0, 0.0, 0.0]]})
    assert reason_of(far, 0, geometry).beyond[1] == 1.0, "nobody reaches what is outside of the workspace"


def test_a_plan_that_tells_nothing_has_no_reasons():
    bare = Plan(torch.zeros(1, 3), torch.zeros(2, 3))
    reason = reason_of(bare)
    assert reason.lines() == []
    assert all(value is None for value in vars(reason).values())
    nothing = replace(bare, info={"predicted_information": [0.0], "predicted_displacement": [[0.0, 0.0, 0.0]]})
    assert reason_of(nothing).best is None and "**gain** 0, of the whole plan 0" in reason_of(nothing).lines()[0]


def test_every_line_is_finite(plan):
    lines = reason_of(plan, 1, make_up(2, particles=10).geometry).lines()
    assert [line.split("**")[1] for line in lines] == ["gain", "where", "risk", "risk", "costs"]
    assert not any(str(math.nan) in line for line in lines)
