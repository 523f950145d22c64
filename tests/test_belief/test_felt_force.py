"""A felt force's direction as evidence of a trajectory: by hand, in every history operation, and in the replay."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.felt_force import log_likelihood_of_forces
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from sdf import backend
from tests.fixtures.pushed_square import square, two_at_rest

DOUBLE = {"dtype": torch.float64}
OWN = PoseTrajectorySettings(force_rad=0.2, outliers=0.01)


def segment(force=None, *, direction=0.0) -> Segment:
    """A tool that goes 10 mm in a direction, in two instants."""
    way = torch.tensor([math.cos(direction), math.sin(direction), 0.0], **DOUBLE)
    place = torch.tensor([-0.065, 0.0, 0.0], **DOUBLE) + 0.005 * torch.arange(3, **DOUBLE)[:, None] * way
    none = torch.zeros(0, dtype=torch.long)
    path = torch.stack((place[:-1], place[1:]), 1)
    flat = torch.zeros(0, **DOUBLE)
    return Segment(
        path, True, flat.view(0, 3), none, none, flat, None if force is None else torch.tensor(force, **DOUBLE)
    )


def likelihood(poses, history, *, centre=(0.0, 0.0), ahead=0.0):
    poses = torch.tensor(poses, **DOUBLE)
    count = len(poses)
    return log_likelihood_of_forces(
        poses, torch.tensor(centre, **DOUBLE).expand(count, 2), torch.full((count, 1), ahead, **DOUBLE), history, OWN
    )


def near(off: float) -> float:
    return math.log(OWN.outliers + (1.0 - OWN.outliers) * math.exp(-0.5 * (off / OWN.force_rad) ** 2))


def test_the_angle_between_the_force_and_the_way_of_the_centre_counts():
    """Along it, 0.3 rad beside, against it, and an object that stays."""
    history = History.empty().appended(segment([3.0, 0.0, 0.5]))
    ends = ([0.01, 0.0, 0.0], [0.01 * math.cos(0.3), 0.01 * math.sin(0.3), 0.0], [-0.01, 0.0, 0.0], [0.0, 0.0, 0.0])
    found = likelihood([[[0.0, 0.0, 0.0], end] for end in ends], history)[:, 0]
    expected = [0.5 * near(off) for off in (0.0, 0.3, math.pi, math.pi)]
    torch.testing.assert_close(found, torch.tensor(expected, **DOUBLE), atol=1e-9, rtol=0)


def test_it_is_the_way_of_the_centre_of_friction_not_of_the_frame():
    """A turn about the origin moves a centre beside it across; pressure ahead of it moves further across."""
    history = History.empty().appended(segment([0.0, 1.0, 1.0]))
    poses = [[[0.0, 0.0, 0.0], [0.0, 0.0, 0.02]]]
    assert float(likelihood(poses, history)[0, 0]) == pytest.approx(near(math.pi))
    assert float(likelihood(poses, history, centre=(0.03, 0.0))[0, 0]) == pytest.approx(near(0.01), abs=1e-6)
    assert float(likelihood(poses, history, ahead=0.03)[0, 0]) == pytest.approx(near(0.0), abs=1e-6)


def test_neither_the_force_s_size_nor_the_world_s_axes_matter():
    turn = 2.1
    cos, sin = math.cos(turn), math.sin(turn)
    plain = likelihood([[[0.01, 0.02, 0.3], [0.018, 0.022, 0.35]]], History.empty().appended(segment([1.0, 0.1, 1.0])))
    force = [7.0 * (cos - 0.1 * sin), 7.0 * (sin + 0.1 * cos), 1.0]
    poses = [
        [x * cos - y * sin, x * sin + y * cos, yaw + turn] for x, y, yaw in ((0.01, 0.02, 0.3), (0.018, 0.022, 0.35))
    ]
    turned = likelihood([poses], History.empty().appended(segment(force, direction=turn)))
    torch.testing.assert_close(turned, plain, atol=1e-9, rtol=0)


def test_a_history_keeps_tempers_and_counts_forces():
    history = History.empty().appended(segment()).appended(segment([1.0, 2.0, 0.5])).appended(segment([3.0, 4.0, 1.0]))
    torch.testing.assert_close(history.force[:, 2], torch.tensor([0.0, 0.5, 1.0], **DOUBLE))
    torch.testing.assert_close(history.tempered(0.25).force[:, 2], torch.tensor([0.0, 0.5, 0.25], **DOUBLE))
    torch.testing.assert_close(history.last().force, torch.tensor([[3.0, 4.0, 1.0]], **DOUBLE))
    torch.testing.assert_close(history.worth()[:, Kind.FELT], torch.tensor([0.0, 0.5, 1.0], **DOUBLE))


def test_a_replay_adds_forces_from_its_first_segment_on_once():
    none = torch.zeros(2, **DOUBLE)
    history = History.empty().appended(segment()).appended(segment([1.0, 0.5, 1.0]))
    block, given = square(), two_at_rest(history)
    own = replace(OWN, ahead=(0.0, 0.0))
    with backend.force("torch"):
        whole = given.replayed(block, own, history, torch.zeros(2, dtype=torch.long))
        again = whole.replayed(block, own, history, torch.tensor([1, 2]))
        unfelt = given.replayed(
            block, own, replace(history, force=0.0 * history.force), torch.zeros(2, dtype=torch.long)
        )
    told = log_likelihood_of_forces(whole.poses, none.expand(2, 2), none[:, None], history, own)
    torch.testing.assert_close(whole.log_likelihood, unfelt.log_likelihood + told)
    assert bool((told[:, 1] < 0).all()) and not bool(told[:, 0].any())
    torch.testing.assert_close(again.log_likelihood, whole.log_likelihood)
