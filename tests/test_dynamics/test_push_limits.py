"""Pushes outside of the model: a tool that holds a rectangle at two places, and one that tips what it pushes."""

import math

import pytest
import torch

from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import Base, RectangleOutline, Support, base_of
from rumi.dynamics.push_limits import held_twice, tips
from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.sliding import rotated
from sdf.primitives import Box


def wall(begin, end, count=41):
    share = torch.linspace(0.0, 1.0, count, dtype=torch.float64)[:, None]
    return (1.0 - share) * torch.tensor(begin).double() + share * torch.tensor(end).double()


PALM = wall((0.0, -0.05), (0.0, 0.05))
"""Flat tools that touch, at (-0.06, 0), the short side of a rectangle of 120 by 60 mm from its left."""
HAND = torch.cat((PALM, wall((0.0, -0.031), (0.05, -0.031)), wall((0.0, 0.031), (0.05, 0.031))))
BEYOND = wall((-0.01, -0.031), (0.05, -0.031))
"""Along the long side, and on beyond its corner."""
CORNER = torch.cat((PALM, wall((0.0, -0.031), (0.05, -0.031))))


@pytest.mark.parametrize(
    ("points", "away", "held"),
    [
        (PALM, 0.0, False),
        (HAND, 0.0, True),
        (CORNER, 0.0, True),
        (BEYOND, 0.0, False),
        (torch.cat((BEYOND, BEYOND + torch.tensor([0.0, 0.001]).double())), 0.0, False),
        (HAND, 0.02, True),
        (HAND, 0.2, False),
        (torch.zeros(1, 2).double(), 0.0, False),
    ],
)
def test_a_tool_at_two_sides_holds_twice(points, away, held):
    base = torch.cartesian_prod(torch.linspace(-0.06, 0.06, 9), torch.linspace(-0.03, 0.03, 9)).double()
    body = PushedBody(RectangleOutline((0.06, 0.03)), Support.of_base(base, base.mean(0)), Pusher(points))
    turn = torch.tensor([0.0, 0.7, -2.0], dtype=torch.float64)
    poses = torch.stack((0.1 * turn, 0.2 - turn, turn), -1)
    at = rotated(torch.tensor([-0.061 - away, 0.0]).double().expand(3, 2), turn)
    tools = torch.cat((poses[:, :2] + at, turn[:, None]), -1)
    assert held_twice(poses, tools, body).tolist() == [held] * 3


def test_a_box_tips_over_its_near_side_alone() -> None:
    # 20 mm to the edge along x, 60 along y: at a friction of .5 it slides below 40 and 120 mm
    base = base_of(Box((0.02, 0.06, 0.1)).double())
    yaw = torch.tensor([0.0, 0.5 * math.pi, math.pi], dtype=torch.float64)
    ahead = torch.tensor([3.0, 0.0], dtype=torch.float64)
    assert tips(yaw, ahead, 0.045, base).tolist() == [True, False, True]
    assert not tips(yaw, ahead, 0.036, base).any()
    assert tips(yaw, ahead, 0.130, base).all()
    assert not tips(yaw, ahead, 0.045, base, friction=0.3).any()


def test_what_stands_aside_of_its_centre_tips_one_way() -> None:
    base = Base(torch.tensor([[-0.01, 0.0], [0.03, 0.0]]), torch.tensor([0.0, 0.0]))
    for way, expected in ((1.0, False), (-1.0, True)):
        assert bool(tips(torch.zeros(1), torch.tensor([way, 0.0]), 0.04, base)) is expected


def test_a_narrow_base_tips_aslant_too() -> None:
    """Pushed along at 30 degrees off its thin side it leans over its long edge, though it reaches far that way."""
    base = base_of(Box((0.005, 0.05, 0.1)).double())
    aslant = torch.tensor([math.cos(0.5), math.sin(0.5)], dtype=torch.float64)
    assert bool(tips(torch.zeros(1, dtype=torch.float64), aslant, 0.045, base))
    assert not bool(tips(torch.full((1,), 0.5 - 0.5 * math.pi, dtype=torch.float64), aslant, 0.045, base))


def test_the_tools_friction_holds_down_the_side_that_it_touches() -> None:
    # 30 mm to either edge: held down 60 mm behind the one that it leans over, 2/3 (h - 30) mm have to be above 30 mm
    base = base_of(Box((0.03, 0.06, 0.1)).double())
    yaw, ahead = torch.zeros(2, dtype=torch.float64), torch.tensor([1.0, 0.0], dtype=torch.float64)
    touched = torch.tensor([[-0.03, 0.0], [0.025, 0.0]], dtype=torch.float64)  # behind, and from within near the edge
    assert tips(yaw, ahead, 0.065, base, touched).tolist() == [False, True]
    assert tips(yaw, ahead, 0.085, base, touched).all() and not tips(yaw, ahead, 0.040, base, touched).any()
    without = tips(yaw, ahead, 0.065, base, touched, tool_friction=0.0)
    assert torch.equal(without, tips(yaw, ahead, 0.065, base)) and without.all()


def test_frictions_may_differ_from_object_to_object_and_wedge() -> None:
    base = base_of(Box((0.02, 0.06, 0.1)).double())
    yaw, ahead = torch.zeros(3, dtype=torch.float64), torch.tensor([1.0, 0.0], dtype=torch.float64)
    floor = torch.tensor([0.3, 0.4, 0.5], dtype=torch.float64)
    assert tips(yaw, ahead, 0.045, base, friction=floor).tolist() == [False, False, True]
    touched = torch.tensor([-0.02, 0.0], dtype=torch.float64).expand(3, 2)
    tool = torch.tensor([0.0, 0.5, 0.9], dtype=torch.float64)
    alone = [tips(yaw[:1], ahead, 0.06, base, touched[:1], friction=0.45, tool_friction=float(mu)) for mu in tool]
    assert torch.equal(tips(yaw, ahead, 0.06, base, touched, friction=0.45, tool_friction=tool), torch.cat(alone))
    # frictions whose product is above 1 do not let it slide
    assert tips(yaw, ahead, 0.06, base, touched, friction=1.4, tool_friction=0.9).all()
