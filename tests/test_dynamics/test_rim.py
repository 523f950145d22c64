"""What is pushed high on a rough floor tips to its rim ahead and turns about it; a long step is taken in parts."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.pushed_object import PushedObject, parts_of
from rumi.belief.trajectory_history import History, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.sliding import Sliding, gathered
from rumi.robot.gripper import GripperShape
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Cylinder, Placed, Union

DOUBLE = {"dtype": torch.float64}
RADIUS, HIGH = 0.04, 0.05  # of a cup, and half of its height
ARM = (0.03, 0.004, 0.01)  # half sides of its handle, which begins at its side
HEIGHT, FINGER = 0.045, 0.008  # of the tool, and its radius
OWN = PoseTrajectorySettings(least_m=0.0, centre_m=0.0, push_m=0.0)


@pytest.fixture(scope="module")
def cup() -> PushedObject:
    """An upright cup with a handle along x, that a finger pushes."""
    arm = Placed(Box(ARM), se3.make(torch.eye(3), torch.tensor((RADIUS + ARM[0], 0.0, HEIGHT - HIGH))))
    sdf = GridSDF.from_sdf(Union((Cylinder(RADIUS, HIGH), arm)), 0.002)
    model = PushedObject.of(sdf, GripperShape(), height_m=HEIGHT, resting_m=HIGH, spacing_m=0.004, pad_spacing_m=0.01)
    angle = 2 * math.pi * torch.arange(24, **DOUBLE) / 24
    finger = FINGER * torch.stack((angle.cos(), angle.sin()), -1)
    return replace(model, tool=finger, centre=torch.zeros(2, **DOUBLE))


def pushed(
    cup: PushedObject,
    own: PoseTrajectorySettings,
    at: tuple[float, float],
    way: tuple[float, float],
    steps: int,
    friction: float = 0.5,
) -> torch.Tensor:
    """Pose (x, y, yaw) after the finger has gone so far, the lever at rest being the radius."""
    numbers = torch.tensor([[RADIUS, friction]], **DOUBLE)
    body, pose = Sliding(torch.zeros(1, 3, **DOUBLE), numbers[:, 0], numbers[:, 1]), torch.zeros(1, 3, **DOUBLE)
    ways = [(at[0] + way[0] * k / steps, at[1] + way[1] * k / steps, 0.0) for k in range(steps + 1)]
    for before, after in itertools.pairwise(torch.tensor(ways, **DOUBLE)):
        pose = cup.step(own, pose, before, after, body, torch.zeros(1, 5, **DOUBLE))
    return pose[0]


def test_pressure_goes_ahead_by_the_balance_of_moments_and_the_lever_follows_the_parallel_axis_theorem() -> None:
    """Points on a rim, whose weights vary as the cosine, have their centre and their spread as `gathered` has it."""
    angle = 2 * math.pi * torch.arange(360, **DOUBLE) / 360
    rim = RADIUS * torch.stack((angle.cos(), angle.sin()), -1)
    for tilt in (0.0, 0.3, 0.8, 1.0):
        weight = (1 + tilt * angle.cos()) / 360
        middle = (weight[:, None] * rim).sum(0)
        spread = (weight * (rim - middle).square().sum(-1)).sum().sqrt()
        arm = torch.tensor(0.045, **DOUBLE)
        ahead, lever = gathered(middle[0] / arm, arm, torch.tensor(RADIUS, **DOUBLE))
        torch.testing.assert_close(torch.stack((ahead, lever)), torch.stack((middle[0], spread)))


def test_nothing_gathers_behind_and_nothing_beyond_the_rim() -> None:
    share = torch.tensor([0.5, 0.0, 9.0, -0.1, -0.1], **DOUBLE)
    arm = torch.tensor([-0.02, 0.04, 0.04, 0.04, -0.02], **DOUBLE)
    ahead, lever = gathered(share, arm, torch.full((5,), RADIUS, **DOUBLE))
    assert ahead.tolist() == pytest.approx([0.0, 0.0, 0.95 * RADIUS, 0.0, 0.0])
    assert bool((lever > 0).all()) and lever[0] == RADIUS


@pytest.mark.parametrize(("friction", "far_m"), [(0.0, 0.0), (0.4, 0.018), (0.9, 0.038)])
def test_a_cup_pushed_by_its_handle_turns_about_a_point_farther_ahead_the_rougher_the_floor(cup, friction, far_m):
    """A push of 1 mm straight aside of the middle: the axis of the turn is off by c^2 / arm from the pressure."""
    own = replace(OWN, rim=True, ahead=(friction, 0.0))
    x, y, yaw = pushed(cup, own, (0.08, -0.0121), (0.0, 0.001), 2, friction=0.0).tolist()
    assert yaw > 0.002
    turned_about = torch.tensor((-y / yaw, x / yaw), **DOUBLE)  # of a small turn
    lever, arm = math.sqrt(RADIUS**2 - far_m**2), 0.08
    torch.testing.assert_close(turned_about, torch.tensor((-(lever**2) / arm, far_m), **DOUBLE), atol=1e-3, rtol=0)


def test_a_contact_behind_holds_its_side_down(cup) -> None:
    """At the side of the cup, 39 mm behind, friction .85 takes 33 of 45 mm from the arm of the push."""
    at, way = (-math.sqrt(0.0481**2 - 0.01**2), 0.01), (0.0005, 0.0)
    turns = {}
    for name, own in (
        ("not ahead", replace(OWN, rim=True, ahead=(0.0, 0.0))),
        ("held", replace(OWN, rim=True, ahead=(0.4, 0.0))),
        ("not held", replace(OWN, rim=True, ahead=(0.4 * 45.0 / 12.0, 0.0))),
    ):
        turns[name] = abs(float(pushed(cup, own, at, way, 1, 0.85)[2]))
    held, free = (turns[name] / turns["not ahead"] - 1.0 for name in ("held", "not held"))
    assert 0.02 < abs(held) < 0.5 * abs(free)


def test_a_tool_that_only_turns_shifts_nothing(cup) -> None:
    """The handle's side is met by a finger off the tool's middle, which stays."""
    turning = replace(cup, tool=cup.tool + torch.tensor([0.0, 0.06], **DOUBLE))
    ends = [torch.tensor([0.06, -0.0725, yaw], **DOUBLE) for yaw in (0.0, 0.02)]
    body = Sliding(torch.zeros(1, 3, **DOUBLE), torch.full((1,), RADIUS, **DOUBLE), torch.full((1,), 0.5, **DOUBLE))
    poses = []
    for own in (replace(OWN, rim=True, ahead=(0.8, 0.0)), OWN):
        pose = torch.tensor([[0.0, 0.0, -0.02]], **DOUBLE)
        poses.append(turning.step(own, pose, *ends, body, torch.zeros(1, 5, **DOUBLE)))
    assert not torch.equal(poses[1], pose)
    torch.testing.assert_close(poses[0], poses[1], atol=0, rtol=0)


@pytest.mark.parametrize(
    ("at", "way"), [((0.08, -0.0121), (0.0, 0.002)), ((-math.sqrt(0.0481**2 - 0.015**2), -0.015), (0.002, 0.0))]
)
def test_the_force_that_moves_a_cup_is_the_likeliest(cup, at, way) -> None:
    """Without friction at the tool it lies along the contact's normal, at the handle as at the side."""
    own = replace(OWN, rim=True, ahead=(0.6, 0.0), friction=(1e-3, 0.0), lever_ratio=(RADIUS / cup.spread_m, 0.0))
    end = pushed(cup, own, at, way, 1, 1e-3)
    normal = (0.0, 1.0) if at[0] > 0 else (-at[0], -at[1])
    none, flat = torch.zeros(0, dtype=torch.long), torch.zeros(0, **DOUBLE)
    path = torch.tensor([[(*at, 0.0), (at[0] + way[0], at[1] + way[1], 0.0)]], **DOUBLE)
    told = []
    for turn in (-0.4, 0.0, 0.4):
        cos, sin = math.cos(turn), math.sin(turn)
        force = torch.tensor([cos * normal[0] - sin * normal[1], sin * normal[0] + cos * normal[1], 1.0], **DOUBLE)
        history = History.empty().appended(Segment(path, True, flat.view(0, 3), none, none, flat, force))
        poses = torch.stack((torch.zeros(3, **DOUBLE), end))[None]
        told.append(float(cup.told_by_force(own, torch.zeros(1, 5, **DOUBLE), poses, history)))
    assert told[1] > max(told[0], told[2]) + 0.5 and told[1] > -0.3


def test_a_step_through_a_thin_handle_pushes_it_ahead(cup) -> None:
    """In one piece a step that ends beyond the middle of the bar pushes it back; in parts it is carried along."""
    at, way = (0.085, -0.0121), (0.0, 0.015)
    whole = pushed(cup, replace(OWN, push_m=0.0), at, way, 1)
    parts, fine = (pushed(cup, replace(OWN, push_m=0.004), at, way, steps) for steps in (1, 60))
    assert whole[2] < 0 < 0.1 < parts[2]
    torch.testing.assert_close(parts, fine, atol=0.01, rtol=0.1)


def test_no_part_of_a_tool_goes_farther_than_the_longest() -> None:
    ends = torch.tensor([0.0, 0.0, 0.1], **DOUBLE), torch.tensor([0.003, 0.004, 0.0], **DOUBLE)
    assert [parts_of(*ends, 0.0, most) for most in (0.0, 0.01, 0.005, 0.0024)] == [1, 1, 1, 3]
    assert [parts_of(*ends, 0.05, most) for most in (0.0, 0.01, 0.005, 0.0024)] == [1, 1, 2, 5]
