"""Evidence of touches and of contact signals, alone and summed up."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.contact_evidence import Feeling, TouchedSomewhere, TouchedSurface
from sdf import se3
from sdf.primitives import Sphere
from sensors.contact_reading import FeltReading, WrenchTouch
from sensors.observation import Observation
from sensors.touch.contact_model import ContactModel

RADIUS = 0.04


def ball():
    return Sphere(RADIUS)


def at(*places):
    return se3.from_planar(torch.tensor([[x, y, 0.0] for x, y in places]))


def touched(points, outlier=0.1, point_sd=0.004, normal_sd=0.3):
    points = torch.tensor(points)
    normals = torch.nn.functional.normalize(points, dim=-1)
    count = len(points)
    return TouchedSurface(
        ball(), points, normals, torch.full((count,), point_sd), torch.full((count,), normal_sd), outlier
    )


def reading(touch=None, signals=None, tools=3):
    touch = WrenchTouch.none() if touch is None else touch
    return FeltReading(
        Observation.empty(),
        torch.zeros(0).long(),
        at(*[(0.01 * k, 0.02) for k in range(tools)]),
        torch.zeros(tools, dtype=torch.bool),
        None,
        torch.zeros(3),
        torch.zeros(()),
        wrench=touch,
        signals=signals,
    )


def test_a_touch_has_the_likelihood_of_its_distance_and_angle():
    """Against the closed form for a ball moved along the normal, and aside."""
    evidence = touched([[RADIUS, 0.0, 0.0]], outlier=0.0)
    off = torch.tensor([0.0, 0.003, -0.006])
    found = evidence.log_likelihood(at(*[(float(x), 0.0) for x in off]))
    torch.testing.assert_close(found, -0.5 * (off / 0.004).square(), atol=1e-4, rtol=0.0)
    aside = 0.01
    distance = math.hypot(RADIUS, aside) - RADIUS
    expected = -0.5 * (distance / 0.004) ** 2 - 0.5 * (math.atan2(aside, RADIUS) / 0.3) ** 2
    assert float(evidence.log_likelihood(at((0.0, aside)))) == pytest.approx(expected, abs=1e-3)


def test_an_outlier_costs_no_more_than_its_share_says():
    evidence = touched([[RADIUS, 0.0, 0.0]])
    fit, near, far = evidence.log_likelihood(at((0.0, 0.0), (0.5, 0.0), (3.0, 0.0))).tolist()
    density = math.log(2.0 * math.pi * 0.004 * 0.3 / (2.0 * 0.1 * math.pi))
    assert near == pytest.approx(math.log(0.1) + density, abs=1e-3) and far == pytest.approx(near, abs=1e-4)
    assert math.log(0.9) - 1e-6 <= fit <= 0.01


def test_a_signal_is_as_likely_as_the_nearest_point_is_near():
    model = ContactModel(0.95, 0.02, 150.0)
    surface = torch.tensor([[[RADIUS, 0.0, 0.0], [0.2, 0.0, 0.0]]])
    poses = at((0.0, 0.0), (-0.01, 0.0), (-0.5, 0.0))
    found = TouchedSomewhere(ball(), surface, model).log_likelihood(poses).exp()
    expected = [0.95, 0.02 + 0.93 * math.exp(-1.5), 0.02]
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-4, rtol=0.0)


def test_log_likelihoods_of_sensors_and_of_actions_sum_up_in_any_order():
    generator = torch.Generator().manual_seed(1000)
    surface = 0.05 * torch.randn(7, 3, generator=generator)
    points = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1) * RADIUS
    normals = torch.nn.functional.normalize(points, dim=-1)
    touches = WrenchTouch(points, normals, torch.full((2,), 0.002), torch.full((2,), 0.1), torch.tensor([0, 2]))
    by_wrench = reading(touches)
    by_joints = reading(signals=torch.tensor([False, True, True]))
    frames = at((0.0, 0.0), (0.01, 0.0), (0.02, 0.01))
    feeling = Feeling(ball(), surface)
    nothing = feeling.nothing()
    poses = at((0.0, 0.0), (0.02, 0.0), (0.1, 0.05))
    one = feeling.joined(nothing, by_wrench, frames)
    other = feeling.joined(nothing, by_joints, frames)
    both = feeling.joined(one, by_joints, frames)
    reverse = feeling.joined(other, by_wrench, frames)
    expected = one.log_likelihood(poses) + other.log_likelihood(poses)
    torch.testing.assert_close(both.log_likelihood(poses), expected)
    torch.testing.assert_close(reverse.log_likelihood(poses), expected)
    assert bool((one.log_likelihood(poses) != 0).all()) and bool((other.log_likelihood(poses) != 0).all())


def test_silent_sensors_add_nothing():
    surface, poses = torch.zeros(4, 3), at((0.0, 0.0), (0.3, 0.1))
    feeling = Feeling(ball(), surface)
    nothing = feeling.nothing()
    silent = feeling.joined(nothing, reading(signals=torch.zeros(3, dtype=torch.bool)), se3.identity((3,)))
    assert torch.equal(silent.log_likelihood(poses), torch.zeros(2))


def test_what_was_felt_goes_with_the_object():
    """A motion between and after the readings leaves the likelihood of moved poses as it was."""
    surface = torch.tensor([[0.0, 0.01, 0.0], [0.02, 0.0, 0.0]])
    points = torch.tensor([[RADIUS, 0.0, 0.0]])
    touch = WrenchTouch(points, points / RADIUS, torch.tensor([0.002]), torch.tensor([0.1]), torch.tensor([1]))
    signals = torch.tensor([False, True, False])
    feeling = Feeling(ball(), surface)
    nothing = feeling.nothing()
    still = feeling.joined(nothing, reading(touch, signals), se3.identity((3,)))
    motion = se3.from_planar(torch.tensor([0.1, -0.05, 0.4]))
    poses = at((0.005, 0.002), (0.0, -0.01))
    # in the frame that rides with the object nothing changes: `world_T_attached` is the motion
    moved = reading(
        replace(touch, points=se3.apply(motion, touch.points), normals=se3.rotate(motion, touch.normals)),
        signals,
    )
    moved = replace(moved, tool_pose=motion @ moved.tool_pose)
    carried = feeling.joined(nothing, moved, motion.expand(3, 4, 4))
    torch.testing.assert_close(carried.log_likelihood(poses), still.log_likelihood(poses), atol=1e-4, rtol=1e-4)
    after = still.moved(motion).log_likelihood(motion @ poses)
    torch.testing.assert_close(after, still.log_likelihood(poses), atol=1e-4, rtol=1e-4)
