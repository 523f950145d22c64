"""Starts of trajectories that no view shows: jumps go about as said, and poses are brought to what was felt."""

import pytest
import torch

from rumi.belief.segments import until_felt
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_history import Kind, Segment
from rumi.belief.trajectory_moves import start_density
from rumi.belief.trajectory_starts import KNOCKS, at_rest, brought_to, jittered, jumped, least_fit
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import se3


@pytest.fixture(scope="module")
def model(box) -> ToppledObject:
    ways = torch.stack([se3.identity()])
    return ToppledObject.of(box.sdf, GripperShape(), ways, box.symmetries, spacing_m=0.02, pad_spacing_m=0.01)


def poses(count: int) -> torch.Tensor:
    return at_rest(torch.zeros(count, 3, dtype=torch.float64), torch.zeros(count, dtype=torch.long))


@pytest.mark.parametrize(("count", "others"), [(300, 400), (7, 1), (0, 5)])
@pytest.mark.parametrize("numbers", [3, 6])
def test_the_density_about_poses_is_the_mean_of_normal_ones(count, others, numbers):
    random, scale = generator(2), torch.tensor([0.001, 0.002, 0.05], dtype=torch.float64)
    about = 0.003 * torch.randn(others, numbers, generator=random, dtype=torch.float64)
    about[:, 2] = torch.pi * torch.rand(others, generator=random)  # some on either side of half a turn
    about[:, 3:] = torch.randint(2, (others, numbers - 3), generator=random).double()
    there = about[torch.randint(others, (count,), generator=random)].clone()
    there[:, 2] = (there[:, 2] + torch.pi + 0.04) % (2 * torch.pi) - torch.pi
    found = start_density(there, about, scale)
    assert found.shape == (count,)
    for pose, density in zip(there[::29], found[::29], strict=True):
        off = pose[:3] - about[:, :3]
        off[:, 2] = torch.atan2(off[:, 2].sin(), off[:, 2].cos())
        each = (-0.5 * (off / scale).square().sum(-1)).exp() / scale.prod()
        alike = (pose[3:] == about[:, 3:]).all(-1)
        assert float(density.exp()) == pytest.approx(float(each[alike].sum()), rel=1e-9)


def test_jumps_go_with_the_tool_or_fall_and_rest_again(model):
    way = torch.tensor([0.06, 0.0], dtype=torch.float64)
    after = jumped(model.rests, poses(4000), way, generator=generator(0))
    assert bool(torch.isfinite(after).all())
    assert bool((after[:, 3] < len(model.rests)).all()) and bool((after[:, 4] == -1).all())
    stayed = after[after[:, 3] == 0]
    assert 0.4 < len(stayed) / len(after) < 0.6  # the others fell
    assert float(stayed[:, 0].mean()) == pytest.approx(0.35 * 0.06, abs=0.003)
    assert float(stayed[:, 1].mean()) == pytest.approx(0.0, abs=0.003)
    assert float(stayed[:, 1].abs().max()) > KNOCKS[-1][0]
    assert torch.equal(after, jumped(model.rests, poses(4000), way, generator=generator(0)))


def test_some_lean_after_a_jump_where_the_tool_still_touches(model):
    none = torch.zeros(2, dtype=torch.float64)
    after = jumped(model.rests, poses(2000), none, generator=generator(0), held=True)
    leans = after[after[:, 4] >= 0]
    assert 0.3 < len(leans) / len(after) < 0.5
    tip = model.rests.edges.tip_rad[leans[:, 3].long(), leans[:, 4].long()]
    assert bool((leans[:, 5] >= 0).all()) and bool((leans[:, 5] < tip).all())
    assert bool((after[after[:, 4] < 0][:, 5] == 0).all())


def test_what_cannot_fall_stays_up(model):
    flat = model.rests.edges._replace(tip_rad=torch.full_like(model.rests.edges.tip_rad, torch.inf))
    ball = type(model.rests)(model.rests.turn, model.rests.height_m, model.rests.centre, model.rests.spread_m, flat)
    after = jumped(ball, poses(50), torch.zeros(2, dtype=torch.float64), generator=generator(0), held=True)
    assert bool((after[:, 4] == -1).all()) and bool((after[:, 3] == 0).all()) and bool(torch.isfinite(after).all())
    assert len(jumped(ball, poses(0), torch.zeros(2, dtype=torch.float64), generator=generator(0))) == 0


def test_poses_are_brought_to_a_point_from_the_side_and_left_alone_from_above(model):
    start = jittered(poses(60), generator=generator(1))
    low, high = model.sdf.bounds.double()
    beside = torch.tensor([float(high[0]) + 0.02, 0.0, float(model.rests.height_m[0])], dtype=torch.float64)
    points = beside.expand(60, 3)
    there = brought_to(model, start, points, 0.0015)
    local = se3.apply(se3.inverse(model.world_T_object(there)), points[:, None])[:, 0]
    torch.testing.assert_close(
        model.sdf.distance(local.to(model.sdf.bounds)).double(), torch.full((60,), 0.0015).double(), atol=5e-4, rtol=0
    )
    assert torch.equal(there[:, 2:], start[:, 2:])
    above = torch.tensor([0.0, 0.0, float(high[2] - low[2]) + 0.01], dtype=torch.float64).expand(60, 3)
    assert torch.equal(brought_to(model, start, above, 0.0), start)


def test_only_what_came_before_the_first_touch_is_of_an_object_at_rest():
    instant = torch.tensor([0, 0, 1, 1, 2])
    kind = torch.tensor([Kind.PAD_CLEAR, Kind.PAD_CLEAR, Kind.PAD_FELT, Kind.FELT, Kind.PAD_FELT])
    points = torch.arange(15, dtype=torch.float64).view(5, 3)
    segment = Segment(torch.zeros(3, 2, 4, dtype=torch.float64), True, points, instant, kind, torch.ones(5).double())
    begun = until_felt(segment)
    assert begun is not None and not begun.pushes
    assert torch.equal(begun.points, points[:4]) and int(begun.instant.sum()) == 0
    assert until_felt(segment._replace(kind=torch.full_like(kind, int(Kind.PAD_CLEAR)))) is None


def test_more_contact_may_fit_less():
    assert least_fit(20) < least_fit(1) < 0.0
