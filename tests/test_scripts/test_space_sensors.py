"""What readings are worth at true poses, and what touches do, by hand."""

import math

import torch

from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.robot.tool import level_pose
from rumi.seeding import generator
from rumi.sim.tool_offset import ToolOffset
from scripts.space_sensors import distances, nats_of, shifted, true_tool
from scripts.space_truth import touches
from sdf import se3
from sdf.primitives import Box

DOUBLE = {"dtype": torch.float64}


def test_the_true_tool_is_the_one_that_was_taken_for_another():
    offset = ToolOffset.drawn(0.002, 0.02, spatial=True, seed=3)
    true = torch.randn(5, 4, generator=generator(1), **DOUBLE)
    taken = level_pose(offset.taken(true), None)
    torch.testing.assert_close(true_tool(offset, taken), level_pose(true, None), atol=1e-9, rtol=0)


def test_a_shift_is_the_same_at_all_instants_and_the_first_is_none():
    there = se3.from_planar(torch.tensor([[0.5, 0.1, 0.3], [0.52, 0.1, 0.4], [0.55, 0.12, 0.5]], **DOUBLE))
    found = shifted(there)
    torch.testing.assert_close(found[0], there, atol=1e-9, rtol=0)
    moves = found @ se3.inverse(there)
    torch.testing.assert_close(moves, moves[:, :1].expand_as(moves), atol=1e-9, rtol=0)
    # about the object: its middle goes a few millimetres at most, whatever the turn
    assert float((found[:, 1, :3, 3] - there[1, :3, 3]).norm(dim=-1).max()) < 0.006


def test_a_pad_that_is_in_the_object_and_feels_it_costs_nothing_and_one_that_does_not_an_outlier():
    own = PoseTrajectorySettings()
    box = Box((0.02, 0.03, 0.04)).double()
    pads = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], **DOUBLE)
    still = se3.identity((1,), **DOUBLE)
    found = distances(box, still, still, pads)
    assert float(found[0, 0]) < 0 < float(found[0, 1])
    right = nats_of(own, found, torch.tensor([[True, False]]))
    wrong = nats_of(own, found, torch.tensor([[False, True]]))
    torch.testing.assert_close(right, torch.full_like(right, own.pad_weight * math.log(1.0 - own.outliers)))
    torch.testing.assert_close(wrong, torch.full_like(wrong, own.pad_weight * math.log(own.outliers)))


def test_touches_are_told_apart_by_how_far_they_move_what_is_known_about():
    def step(near, p, mm, moved=0.0, tilt=0.0, touched=True):
        return {"near": near, "p": p, "mm": mm, "moved": moved, "tilt": tilt, "touched": touched, "contacts": 1}

    steps = [step(1.0, 0.5, 4.0), step(1.0, 0.96, 2.0, moved=5.0), step(0.1, 0.6, 9.0, moved=40.0)]
    steps += [step(1.0, 0.6, 3.0, moved=1.0), step(1.0, 0.2, 8.0, moved=30.0, tilt=20.0), step(1, 1, 1, touched=False)]
    rows = touches([{"steps": steps}]).splitlines()
    assert rows[2] == "| 3 to 10 mm | 1 | 0.50; 0.96 | 4.0; 2.0 | 1 |"
    assert rows[3] == "| 25 to 300 mm | 1 | 0.96; 0.60 | 2.0; 9.0 | 0 |"
    assert rows[4] == "| tilted | 1 | 0.60; 0.20 | 3.0; 8.0 | 0 |"
    assert len(rows) == 5  # the one that moved nothing began where nothing was known
