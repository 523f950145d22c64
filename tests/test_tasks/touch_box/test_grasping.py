"""Where to grasp and how likely that succeeds."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.tasks.grasp_table import GraspTable, _local_means, best_grasp, clearance_table, relative

TABLE = clearance_table(0.03, 0.08, 0.08)


def pose(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_the_open_fingers_must_clear_the_box():
    box = pose(0.3, -0.2, 0.7)
    across = torch.tensor([math.cos(0.7), math.sin(0.7), 0.0], dtype=torch.float64)
    assert float(TABLE(box, box)) == 1.0
    assert float(TABLE(box, box + 0.008 * across)) == 1.0
    assert float(TABLE(box, box + 0.014 * across)) == 0.0
    along = torch.tensor([-math.sin(0.7), math.cos(0.7), 0.0], dtype=torch.float64)
    assert float(TABLE(box, box + 0.06 * along)) == 1.0
    assert float(TABLE(box, box + 0.10 * along)) == 0.0
    assert float(TABLE(box, box + pose(0.0, 0.0, 1.2))) == 0.0
    assert float(TABLE(box, box + pose(0.0, 0.0, math.pi))) == 1.0


def test_values_at_nodes_and_between(generator):
    table = GraspTable(torch.rand(3, 4, 5, generator=generator, dtype=torch.float64), (0.02, 0.09, 0.8))
    zero = pose(0.0, 0.0, 0.0)
    assert float(table(zero, pose(0.01, 0.03, 0.4))) == pytest.approx(float(table.odds[1, 1, 3]))
    between = 0.5 * float(table.odds[1, 1, 3] + table.odds[1, 2, 3])
    assert float(table(zero, pose(0.01, 0.045, 0.4))) == pytest.approx(between)


@pytest.mark.parametrize("turn", ["half", "mirror"])
def test_the_table_knows_the_symmetries_of_box_and_fingers(turn, generator):
    table = GraspTable(torch.rand(4, 4, 5, generator=generator, dtype=torch.float64), (0.02, 0.09, 0.8))
    place = torch.tensor([0.02, 0.09, 0.8]) * (2 * torch.rand(50, 3, generator=generator) - 1)
    place, zero = place.double(), torch.zeros(50, 3, dtype=torch.float64)
    # seen from a gripper that is turned by half a turn, or in a mirror along the box
    sign = pose(-1.0, -1.0, 1.0) if turn == "half" else pose(-1.0, 1.0, -1.0)
    torch.testing.assert_close(table(zero, place), table(zero, sign * place))


def test_relative_poses_take_the_nearer_half_turn():
    apart, yaw = relative(pose(0.0, 0.0, 0.1), pose(0.0, 0.0, 0.1 + math.pi - 0.2))
    assert float(yaw) == pytest.approx(-0.2)
    torch.testing.assert_close(apart, torch.zeros(2, dtype=torch.float64))


def test_the_best_grasp_takes_in_the_most(generator):
    near = pose(0.4, 0.2, 0.3) + 0.002 * torch.randn(60, 3, generator=generator, dtype=torch.float64)
    far = pose(0.4, -0.2, -0.3) + 0.002 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    poses = torch.cat((near, far))
    found = best_grasp(poses, torch.zeros(100, dtype=torch.float64), TABLE)
    assert found.probability == pytest.approx(0.6)
    torch.testing.assert_close(found.pose[:2], pose(0.4, 0.2), atol=0.01, rtol=0)


def test_the_mean_of_poses_half_a_turn_apart_is_one_of_them():
    """Two hypotheses that are 16 mm apart: only the middle lifts both, whichever way round they are told."""
    poses = torch.stack((pose(-0.008, 0.0, 0.0), pose(0.008, 0.0, math.pi)))
    found = best_grasp(poses, torch.zeros(2, dtype=torch.float64), TABLE)
    assert found.probability == pytest.approx(1.0)
    assert abs(float(found.pose[0])) < 0.003
    # of an object that half a turn changes they are two
    means = _local_means(poses, poses, pose(0.5, 0.5), replace(TABLE, period=2.0 * math.pi))
    torch.testing.assert_close(means, poses)
