"""Readings that err, and the robot whose truth is the quasi-static model."""

import math

import pytest
import torch

from rumi.tasks.grasp_table import clearance_table
from rumi.tasks.touch_box.planar_robot import PlanarRobot
from rumi.tasks.touch_box.robot import Readings, TouchRobot
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask, draw_truth, mean_distance

SHARP = TouchTask(rates=(1.0, 0.0))
TABLE = clearance_table(0.03, 0.08, 0.08)


def truth(*pose):
    return BoxTruth(torch.tensor(pose, dtype=torch.float64), 0.4, 0.4, 0.5)


def straight(begin, end, count=40):
    share = torch.linspace(0.0, 1.0, count + 1, dtype=torch.float64)[:, None]
    begin, end = (torch.tensor([*p, 0.0], dtype=torch.float64) for p in (begin, end))
    return begin + share * (end - begin)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_readings_err_at_their_rates(correlation, generator):
    reading = Readings((0.7, 0.2), correlation, generator)
    touching = [bool(k % 50 < 25) for k in range(20_000)]
    said = [reading(one) for one in touching]
    for state, rate in ((True, 0.7), (False, 0.2)):
        own = [s for s, t in zip(said, touching, strict=True) if t is state]
        assert sum(own) / len(own) == pytest.approx(rate, abs=0.035)


def test_correlated_readings_repeat_their_errors(generator):
    def agreeing(correlation):
        reading = Readings((0.5, 0.1), correlation, generator)
        said = [reading(True) for _ in range(8000)]
        return sum(a == b for a, b in zip(said[1:], said[:-1], strict=True)) / (len(said) - 1)

    assert agreeing(0.0) == pytest.approx(0.5, abs=0.03)
    assert agreeing(0.9) == pytest.approx(0.95, abs=0.02)


def test_truths_of_a_seed_are_the_same_and_within_their_ranges():
    task = TouchTask()
    drawn = [draw_truth(task, seed) for seed in range(200)]
    assert all(task.friction[0] <= one.friction <= task.friction[1] for one in drawn)
    assert all(task.mass_kg[0] <= one.mass_kg <= task.mass_kg[1] for one in drawn)
    assert 0.35 < sum(float(one.pose[1]) > 0 for one in drawn) / 200 < 0.65
    torch.testing.assert_close(drawn[7].pose, draw_truth(task, 7).pose, rtol=0, atol=0)


def test_mean_distance_is_that_of_a_rectangle():
    x, y = torch.meshgrid(torch.linspace(-0.03, 0.03, 601), torch.linspace(-0.08, 0.08, 1601), indexing="ij")
    assert mean_distance((0.03, 0.08)) == pytest.approx(float(torch.hypot(x, y).mean()), abs=1e-4)


def test_it_pushes_feels_and_lifts():
    robot = PlanarRobot(SHARP, TABLE)
    assert isinstance(robot, TouchRobot)
    robot.reset(truth(0.4, 0.0, 0.0), 0)
    # the finger's border is 10 mm ahead of its middle: it meets the box's side at x = 0.37
    touched = robot.execute(straight((0.3, 0.0), (0.4, 0.0), 20), lambda so_far: True)
    first = int(touched.contact.to(torch.uint8).argmax())
    assert float(touched.path[first + 1, 0]) == pytest.approx(0.36, abs=0.006)
    assert bool(touched.contact[first:].all())
    assert touched.stopped == "end"
    assert float(robot.box_pose()[0]) == pytest.approx(0.44, abs=0.002)
    assert robot.grasp(robot.box_pose())
    assert not robot.grasp(torch.tensor([0.40, 0.0, 0.0], dtype=torch.float64))


def test_it_stops_when_told_and_is_blocked_by_the_box():
    robot = PlanarRobot(SHARP, TABLE)
    robot.reset(truth(0.4, 0.0, 0.0), 0)
    touched = robot.execute(straight((0.3, 0.0), (0.4, 0.0), 20), lambda so_far: len(so_far.contact) < 5)
    assert (len(touched.contact), touched.stopped, len(touched.path)) == (5, "belief", 6)
    blocked = robot.execute(straight((0.4, 0.05), (0.2, 0.0)), lambda so_far: True)
    assert blocked.blocked and len(blocked.contact) == 0
    torch.testing.assert_close(robot.box_pose(), torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64))


def test_a_box_of_70_mm_fits_and_a_wider_one_into_a_wider_gripper():
    assert TouchTask(half=(0.035, 0.08)).half[0] == 0.035
    assert TouchTask(half=(0.045, 0.08), opening_m=0.1).opening_m == 0.1


def test_the_fingers_footprint_is_two_discs():
    fingers = TouchTask().fingers
    assert fingers.radius == pytest.approx(0.02)
    assert math.isclose(fingers.thickness, 0.01)
