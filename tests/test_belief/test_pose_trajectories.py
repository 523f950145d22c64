"""Trajectories: the compiled replay is the plain one, moves keep the posterior, histories can be tempered."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.pushed_object import PushedObject
from rumi.belief.systematic_errors import NUMBERS
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_likelihood import log_likelihood_of
from rumi.belief.trajectory_moves import Moves
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.bench.drawn_segments import drawn_push, drawn_truth, drawn_view
from rumi.dynamics.along_path import Pusher, push_along_path
from rumi.dynamics.sliding import Sliding
from rumi.resampling import resample_systematic
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import backend, se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Cylinder, Placed, Union
from sdf.so3 import wrap

DOUBLE = {"dtype": torch.float64}
OWN = PoseTrajectorySettings(particles=60, branches=3, rounds=1)
SHAPE, HEIGHT = GripperShape(), 0.03

pytestmark = pytest.mark.usefixtures("by_numba")


def approach(first_x=-0.11, step=0.006, count=6, y=0.01) -> torch.Tensor:
    """A tool that comes along x towards a block at the origin, whose face is at -0.04 and pads' tips 35 mm ahead."""
    x = first_x + step * torch.arange(count + 1, **DOUBLE)
    tool = torch.stack((x, 0 * x + y, 0 * x), -1)
    return torch.stack((tool[:-1], tool[1:]), 1)


def segment(path=None, *, pushes=True, points=12, seed=0) -> Segment:
    path = approach() if path is None else path
    random = generator(seed)
    place = 0.1 * (torch.rand(points, 3, generator=random, **DOUBLE) - 0.5)
    instant = torch.randint(len(path), (points,), generator=random).sort().values
    kind = torch.randint(len(Kind), (points,), generator=random)
    return Segment(path, pushes, place, instant, kind, torch.rand(points, generator=random, **DOUBLE))


def drawn(history: History, count: int, *, seed=1, spread=(0.004, 0.004, 0.2)) -> Trajectories:
    random = generator(seed)
    start = torch.randn(count, 3, generator=random, **DOUBLE) * torch.tensor(spread, **DOUBLE)
    physics = torch.randn(count, PHYSICS, generator=random, **DOUBLE)
    noise = torch.randn(count, len(history), NOISE, generator=random, **DOUBLE)
    poses = start[:, None].repeat(1, len(history) + 1, 1)
    return Trajectories(physics, noise, poses, start.new_zeros(count, len(history)), history, start)


def long_history() -> History:
    history = History.empty().appended(segment(pushes=False, path=torch.zeros(1, 2, 3, **DOUBLE), points=30, seed=5))
    turning = approach(-0.074, 0.004, 5)
    turning[:, 1, 2] = turning[1:, 0, 2].new_tensor([0.02, 0.05, 0.03, -0.04, 0.0])
    turning[1:, 0, 2] = turning[:-1, 1, 2].clone()
    history = history.appended(segment()).appended(segment(turning, seed=2), opens=False)
    return history.appended(segment(approach(-0.05, 0.005, 4, y=-0.02), points=0))


@pytest.mark.parametrize("own", [OWN, replace(OWN, push_m=0.0), replace(OWN, rim=True, ahead=(1.0, 0.5), push_m=0.002)])
def test_the_compiled_replay_is_the_plain_one(model, own):
    history = long_history()
    given, first = drawn(history, 40), torch.arange(40) % len(history)
    found = {}
    for version in ("torch", "numba"):
        with backend.force(version):
            whole = given.replayed(model, own, history, torch.zeros(40, dtype=torch.long))
            found[version] = whole, whole.replayed(model, own, history, first)
    for one, other in zip(*found.values(), strict=True):
        assert float((one.poses[:, -1, :2] - one.poses[:, 0, :2]).norm(dim=-1).max()) > 0.01  # it was pushed
        torch.testing.assert_close(one.poses, other.poses, atol=2e-7, rtol=0)
        torch.testing.assert_close(one.log_likelihood, other.log_likelihood, atol=2e-3, rtol=2e-4)
    again = found["numba"][1]
    torch.testing.assert_close(again.poses, found["numba"][0].poses, atol=0, rtol=0)  # the same from any segment on


def test_what_cannot_reach_its_least_likelihood_is_given_up_and_nothing_else(model):
    history = long_history()
    given, first = drawn(history, 60), torch.arange(60) % len(history)
    whole = given.replayed(model, OWN, history, first)
    late = torch.arange(len(history)) >= first[:, None]
    total = torch.where(late, whole.log_likelihood, 0.0).sum(-1)
    least = total + 30.0 * (torch.rand(60, generator=generator(4), **DOUBLE) - 0.5)
    found = given.replayed(model, OWN, history, first, least)
    kept = torch.isfinite(found.log_likelihood).all(-1)
    assert torch.equal(kept, total >= least) and 10 < int(kept.sum()) < 50
    torch.testing.assert_close(found.poses[kept], whole.poses[kept], atol=0, rtol=0)
    torch.testing.assert_close(found.log_likelihood[kept], whole.log_likelihood[kept], atol=0, rtol=0)


def test_no_point_of_the_tool_that_may_be_deepest_is_left_out(model):
    """Tools all about an L of two blocks push it as the plain version, which looks at all points."""
    aside = se3.from_planar(torch.tensor([-0.02, 0.03, 0.0]))
    corner = Union([Placed(Box([0.02, 0.05, 0.03]), aside), Box([0.05, 0.02, 0.03])])
    sdf = GridSDF.from_sdf(corner, 0.003)
    own = PushedObject.of(sdf, SHAPE, height_m=HEIGHT, resting_m=0.03, spacing_m=0.004, pad_spacing_m=0.006)
    random, poses = generator(7), {}
    angle = 2 * math.pi * torch.rand(40, 1, generator=random, **DOUBLE)
    there = torch.cat((0.13 * angle.cos(), 0.13 * angle.sin(), angle + math.pi), -1)
    there = there + 0.03 * torch.randn(40, 3, generator=random, **DOUBLE)
    path = torch.stack((there, there - 0.02 * torch.cat((angle.cos(), angle.sin(), 0 * angle), -1)), 1)
    history = History.empty()
    for each in path:
        history = history.appended(segment(each[None], points=0))
    given = drawn(history, 20, spread=(0.01, 0.01, 1.0))
    for version in ("torch", "numba"):
        with backend.force(version):
            poses[version] = given.replayed(own, OWN, history, torch.zeros(20, dtype=torch.long)).poses
    moved = (poses["torch"].diff(dim=1).abs().amax(-1) > 0).double().mean()
    assert 0.05 < float(moved) < 0.95
    torch.testing.assert_close(poses["numba"], poses["torch"], atol=1e-6, rtol=0)


@pytest.mark.parametrize("along", [0.0, 0.2, 0.5, 0.8])
def test_a_thin_bar_is_pushed_alike_by_any_place_of_a_side(along):
    """A side that comes along -y, its points as far apart as by default, carries a bar as far as it goes."""
    spacing = PoseTrajectorySettings().tool_spacing_m
    bar = Cylinder(0.008, 0.05)
    own = PushedObject.of(bar, SHAPE, height_m=0.0, resting_m=0.05, spacing_m=spacing, pad_spacing_m=0.01)
    pose = torch.tensor([[-0.07 + along * spacing, -0.06, 0.0]], **DOUBLE)
    sliding = Sliding(torch.zeros(1, 3, **DOUBLE), torch.tensor([0.005], **DOUBLE), torch.tensor([0.4], **DOUBLE))
    still = replace(OWN, ahead=(0.0, 0.0), centre_m=0.0)
    for step in range(10):
        before = torch.tensor([0.0, -0.002 * step, 0.0], **DOUBLE)
        after = before - torch.tensor([0.0, 0.002, 0.0], **DOUBLE)
        pose = own.step(still, pose, before, after, sliding, torch.zeros(1, 5, **DOUBLE))
    # the side ends at y = -50 - 20 mm
    expected = torch.tensor([[-0.07 + along * spacing, -0.078]], **DOUBLE)
    torch.testing.assert_close(pose[:, :2], expected, atol=8e-4, rtol=0)  # points 3 mm apart: 1 mm off


def test_two_particles_by_hand(model):
    """Without noise and shifts the motion is the push model's; the likelihood sums points at their instants."""
    still = {"friction_change": 0.0, "ahead": (0.0, 0.0), "centre_m": 0.0, "push_m": 0.0}
    own = replace(OWN, **still, along=0.0, across=0.0, turn_rad_per_m=0.0)
    point = torch.tensor([[-0.045, 0.0, 0.0]], **DOUBLE).repeat(2, 1)
    both = Segment(
        approach(),
        True,
        point,
        torch.tensor([0, 5]),
        torch.tensor([Kind.FELT, Kind.FELT]),
        torch.tensor([1.0, 2.0], **DOUBLE),
    )
    history = History.empty().appended(both)
    given = drawn(history, 2, spread=(0.0, 0.0, 0.0))
    given = replace(given, physics=torch.zeros(2, PHYSICS, **DOUBLE), noise=0 * given.noise)
    given.poses[1, :, 0] = 0.5  # far away: nothing moves it
    found = given.replayed(model, own, history, torch.zeros(2, dtype=torch.long))
    body = Sliding(
        model.centre,
        torch.tensor(own.lever_ratio[0] * model.spread_m, **DOUBLE),
        torch.tensor(own.friction[0], **DOUBLE),
    )
    path = torch.cat((both.tool[:1, 0], both.tool[:, 1]))[None]
    track = push_along_path(given.poses[:1, 0], path, Pusher(model.tool), model.outline, body, substeps=1).track[0]
    torch.testing.assert_close(found.pose[0], track[-1], atol=1e-9, rtol=0)
    torch.testing.assert_close(found.pose[1], given.poses[1, 0], atol=0, rtol=0)
    places = torch.stack([se3.apply(se3.inverse(se3.from_planar(track[k])), point[:1])[0] for k in (0, 5)])
    each = log_likelihood_of(model.sdf.distance(places.float()).double()[None], both.kind, own)[0]
    assert float(found.log_likelihood[0, 0]) == pytest.approx(float(each @ both.weight), abs=1e-3)
    assert float(found.log_likelihood[1, 0]) == pytest.approx(3 * math.log(own.outliers), abs=1e-6)


def same_from_behind(yaw: torch.Tensor) -> torch.Tensor:
    """Yaw within a quarter turn: moves turn the block to where it is the same as before."""
    return 0.5 * wrap(2.0 * yaw)


def test_metropolis_moves_keep_a_posterior_that_a_grid_gives(model):
    """A view of two sides leaves (x, y, yaw) open: moves from far too wide starts come to the grid's moments."""
    # with few outliers: else poses that one side alone explains have a share beyond the grid
    own = replace(OWN, seen_sd_m=0.003, outliers=1e-5)
    wall = torch.linspace(-0.03, 0.03, 9, **DOUBLE)
    seen = torch.cat(
        (
            torch.stack((0 * wall - 0.04, wall, 0 * wall), -1),
            torch.stack((wall * 1.1, 0 * wall - 0.06, 0 * wall), -1),
        )
    )
    still = Segment(
        torch.zeros(1, 2, 3, **DOUBLE),
        False,
        seen,
        torch.zeros(18, dtype=torch.long),
        torch.zeros(18, dtype=torch.long),
        torch.full((18,), 0.3, **DOUBLE),
    )
    history = History.empty().appended(still)
    axes = torch.linspace(-0.009, 0.009, 31, **DOUBLE), torch.linspace(-0.18, 0.18, 31, **DOUBLE)
    nodes = torch.stack(torch.meshgrid(axes[0], axes[0], axes[1], indexing="ij"), -1).reshape(-1, 3)
    grid = replace(drawn(history, len(nodes)), poses=nodes[:, None].repeat(1, 2, 1))
    weights = (
        grid.replayed(model, own, history, torch.zeros(len(nodes), dtype=torch.long)).log_likelihood[:, 0].softmax(0)
    )
    mean = weights @ nodes
    sd = (weights @ (nodes - mean).square()).sqrt()
    given = drawn(history, 600, spread=(0.004, 0.004, 0.06)).replayed(
        model, own, history, torch.zeros(600, dtype=torch.long)
    )
    moves = Moves(model, own, generator(3))
    for _ in range(40):
        given = moves.sweep(given, history, whole=True)
    starts = given.poses[:, 0].clone()
    starts[:, 2] = same_from_behind(starts[:, 2])
    assert bool(((starts.mean(0) - mean).abs() < 0.2 * sd).all())
    torch.testing.assert_close(starts.std(0), sd, rtol=0.12, atol=0)
    # what no reading tells of keeps its prior
    torch.testing.assert_close(given.physics.std(0), torch.ones(PHYSICS, **DOUBLE), rtol=0.15, atol=0)


@pytest.mark.parametrize("off_m", [0.0, 0.0015])
def test_moves_keep_the_posterior_of_motion_and_physics_that_draws_of_the_prior_give(model, off_m):
    """Of readings drawn from the model: weighted draws of its prior, and after many moves, have the same moments."""
    own = replace(OWN, pad_slope_m=0.001, friction=(0.4, 0.6), friction_change=0.3, lever_ratio=(1.25, 0.3))
    own = replace(own, along=0.03, across=0.03, turn_rad_per_m=0.5, seen_sd_m=0.001, centre_change_m=0.002)
    # by as much as one deviation, each another way
    own = replace(own, tool_off_m=off_m, view_off_m=off_m, view_off_rad=4.0 * off_m, view_about_m=(0.0, 0.1))
    random, pose, count = generator(18), torch.zeros(3, **DOUBLE), 40000 if off_m == 0 else 150_000
    own = replace(own, size_off=10.0 * off_m)  # whose truth is the model's
    errors = torch.zeros(1, NUMBERS * own.systematic, **DOUBLE)
    errors[:, :1], errors[:, 5:6] = 1.0, -1.0
    seen = torch.tensor([0.0, -off_m, 0.0], **DOUBLE)
    view = drawn_view(model, own, seen, 12, random)
    truth = drawn_truth(pose, random)
    truth = replace(truth, physics=torch.cat((torch.tensor([[1.5, -1.0, 0.0, 0.0, 0.0]], **DOUBLE), errors), -1))
    push, _ = drawn_push(model, own, truth, approach(count=10, y=0.03), model.pads[::6], random)
    history = History.empty().appended(view).appended(push)
    scale = torch.tensor([0.001 + off_m, 0.001 + off_m, 0.03], **DOUBLE)
    prior = drawn(history, count, spread=scale.tolist())
    numbers = torch.randn(count, errors.shape[1], generator=random, **DOUBLE)
    prior = replace(prior, physics=torch.cat((prior.physics, numbers), -1))
    prior = prior.replayed(model, own, history, torch.zeros(count, dtype=torch.long))
    off = prior.poses[:, 0] / scale
    weights = prior.log_likelihood.sum(-1) + 0.5 * off.square().sum(-1)  # start poses are even

    def moments(some: Trajectories, weights: torch.Tensor) -> torch.Tensor:
        last = some.poses[:, -1].clone()
        last[:, 2] = same_from_behind(last[:, 2])
        parts = torch.cat((last / scale, some.physics[:, :2], some.noise[:, 1, :2], some.systematic), -1)
        mean = weights @ parts
        return torch.stack((mean, (weights @ (parts - mean).square()).sqrt()))

    wanted = moments(prior, weights.softmax(0))
    assert float(wanted[0, 4]) > 0.25  # the readings tell of the lever
    now = prior.at(resample_systematic(weights, 600, generator=random))
    now = replace(now, starts=now.poses[:, 0])
    moves, found = Moves(model, own, random), []
    for _ in range(16):
        now = moves.sweep(now, history, whole=True)
        found.append(moments(now, torch.full((600,), 1.0 / 600, **DOUBLE)))
    assert len(torch.unique(now.physics[:, 1])) > 590
    torch.testing.assert_close(torch.stack(found).mean(0), wanted, atol=0.12, rtol=0)


def test_drawing_friction_given_its_segments_moves_nothing_and_keeps_the_prior(model):
    history = long_history()
    given = drawn(history, 4000).replayed(model, OWN, history, torch.zeros(4000, dtype=torch.long))
    moved = Moves(model, OWN, generator(2)).learnt(given, history)
    assert float((moved.physics[:, :2] - given.physics[:, :2]).abs().mean()) > 0.05
    again = moved.replayed(model, OWN, history, torch.zeros(4000, dtype=torch.long))
    torch.testing.assert_close(again.poses, given.poses, atol=1e-6, rtol=0)
    for part in (moved.physics[:, :2], moved.noise[:, history.moving(), :2]):
        torch.testing.assert_close(part.std(0), torch.ones_like(part[0]), atol=0.06, rtol=0)
        torch.testing.assert_close(part.mean(0), torch.zeros_like(part[0]), atol=0.06, rtol=0)


def test_tempering_and_parts_of_a_history():
    history = long_history()
    assert len(history) == 4 and history.action.tolist() == [0, 1, 1, 3] and history.moving().tolist() == [1, 2, 3]
    half = long_history().appended(segment(seed=9)).tempered(0.5)
    torch.testing.assert_close(half.weight[-12:], 0.5 * segment(seed=9).weight)
    torch.testing.assert_close(half.weight[:-12], history.weight)
    last = half.last()
    assert len(last) == 1 and last.ends.tolist() == [6] and int(last.point_ends[-1]) == len(last.points) == 12
    assert len(history.since_push()) == 0


def test_noise_of_other_objects_has_room_for_what_tips_and_rolls() -> None:
    # a motion that is off by many deviations costs little of the prior: its size is drawn, too
    size = torch.linspace(0.0, 8.0, 801, **DOUBLE)
    for own in (PoseTrajectorySettings().for_mugs(), PoseTrajectorySettings().for_others()):
        for deviations, nats in ((3.0, 3.0), (6.0, 4.5), (10.0, 6.0)):
            z = deviations * (-0.5 * own.tails * size.square()).exp()
            assert float((0.5 * (z.square() + size.square())).min()) < nats


def test_numbers_for_others_leave_what_is_set() -> None:
    own = PoseTrajectorySettings(across=0.02, particles=30)
    wide, fitted = own.for_others(), PoseTrajectorySettings().for_mugs()
    assert (wide.across, wide.particles, wide.seen_sd_m) == (0.02, 30, own.seen_sd_m)
    assert (
        wide.along > fitted.along and wide.pad_slope_m > fitted.pad_slope_m and wide.lever_ratio != fitted.lever_ratio
    )


def test_numbers_for_mugs_leave_what_is_set_and_settings_of_before() -> None:
    own = PoseTrajectorySettings(across=0.02, particles=30).for_mugs()
    assert own.rim and (own.across, own.particles) == (0.02, 30) and own.ahead != PoseTrajectorySettings().ahead
    before = PoseTrajectorySettings(rim=False, push_m=0.0)
    assert before.for_mugs() == before and not PoseTrajectorySettings().for_others().rim
