"""Faults before a box: it is moved or taken away, and the hand is off, dead, or feels what is not there."""

import math

import pytest
import torch

from rumi import exit_codes
from rumi.cli import main
from rumi.sim.faults import parse_fault
from rumi.tasks.grasp_table import clearance_table
from rumi.tasks.touch_box.entry import TOUCH_BOX, TouchBoxSettings
from rumi.tasks.touch_box.faulty import FaultyRobot
from rumi.tasks.touch_box.planar_robot import PlanarRobot
from rumi.tasks.touch_box.scene import TouchTask, draw_truth

TASK = TouchTask(rates=(1.0, 0.0))
AWAY = torch.tensor([[-1.0, -1.0, 0.0], [-0.99, -1.0, 0.0], [-0.98, -1.0, 0.0]], dtype=torch.float64)


def robot(*texts: str) -> FaultyRobot:
    made = PlanarRobot(TASK, clearance_table(0.03, 0.08, 0.08))
    found = FaultyRobot(made, [parse_fault(text, steps=15, seed=4) for text in texts])
    found.reset(draw_truth(TASK, 1), 1)
    return found


def poke(own: FaultyRobot, path: torch.Tensor = AWAY):
    return own.execute(path, lambda so_far: True)


def into(own: FaultyRobot) -> torch.Tensor:
    """A poke that comes to the middle of the box."""
    x, y, _ = own.box_pose().tolist()
    steps = torch.linspace(-0.3, 0.0, 40, dtype=torch.float64)[:, None]
    return torch.cat((x + steps, y + 0 * steps, 0 * steps), -1)


def test_a_box_is_knocked_or_gone_from_its_poke_on():
    own = robot("knock:20@2")
    before = own.box_pose()
    poke(own)
    assert torch.equal(own.box_pose(), before)
    poke(own)
    moved = own.box_pose() - before
    assert float(moved[:2].norm()) == pytest.approx(0.020, abs=1e-6) and abs(float(moved[2])) < math.radians(20.1)
    own = robot("absent@1")
    path = into(own)
    assert not bool(poke(own, path).contact.any())
    own.reset(draw_truth(TASK, 1), 1)  # a run begins with the box in its place
    assert torch.equal(own.box_pose(), before)


def test_a_hand_that_is_off_reports_the_way_that_it_was_to_go():
    own, plain = robot("hand:6@1"), robot()
    there = poke(own, into(own)), poke(plain, into(plain))
    torch.testing.assert_close(there[0].path[:5], there[1].path[:5])
    assert not torch.equal(own.box_pose(), plain.box_pose())


def test_a_dead_hand_feels_nothing_and_another_what_is_not_there():
    assert bool(poke(robot(), into(robot())).contact.any())
    assert not bool(poke(robot("dead@1"), into(robot())).contact.any())
    felt = [
        int(poke(own, torch.linspace(-1.0, -0.9, 12)[:, None].expand(-1, 3).double()).contact.sum())
        for own in [robot("false-contact:1@1")]
        for _ in range(6)
    ]
    assert felt == [1] * 6


def test_faults_of_other_tasks_or_of_the_arm_are_refused(capsys):
    own = TouchBoxSettings(fault=("dead@2",))
    assert TOUCH_BOX.from_dict(TOUCH_BOX.as_dict(own)) == own
    for wrong, said in (
        (["--fault", "camera:10"], "one of knock, absent, hand, dead, false-contact"),
        (["--fault", "knock@99"], "the run's last"),
        (["--fault", "knock@2", "--robot", "arm"], "gripper or planar"),
    ):
        assert main(["run", "touch-box", *wrong]) == exit_codes.BAD_INPUT
        assert said in capsys.readouterr().err
