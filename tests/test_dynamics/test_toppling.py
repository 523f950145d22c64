"""Resting poses and toppling: a box by hand, and the compiled replay in space is the plain one."""

import itertools
import math

import pytest
import torch

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.prior import lying
from rumi.belief.pushed_object import PushedObject
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.resting import RestingPoses, tilted
from rumi.dynamics.sliding import Sliding
from rumi.dynamics.toppling import Leaning, push_in_space
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import backend, se3
from sdf.drill import drill_model
from sdf.object_model import ObjectModel, box_model

DOUBLE = {"dtype": torch.float64}
OWN = PoseTrajectorySettings()
HALF = (0.030, 0.079, 0.105)
SOFT = 0.001


@pytest.fixture(scope="module")
def box() -> ObjectModel:
    return box_model()


@pytest.fixture(scope="module")
def toppled(box) -> ToppledObject:
    ways = torch.stack([lying(box.exact.bounds, up) for up in "xyz"])
    return ToppledObject.of(box.sdf, GripperShape(), ways, box.symmetries, spacing_m=0.008, pad_spacing_m=0.006)


def test_a_box_rests_on_three_faces_and_falls_over_each_edge_to_the_next(toppled):
    rests, edges = toppled.rests, toppled.rests.edges
    assert len(rests) == 3  # the other three are these, turned
    torch.testing.assert_close(rests.height_m, torch.tensor(HALF, **DOUBLE), atol=3e-4, rtol=0)
    torch.testing.assert_close(rests.centre, torch.zeros(3, 2, **DOUBLE), atol=1e-3, rtol=0)
    for rest in range(3):
        up, sides = HALF[rest], [half for axis, half in enumerate(HALF) if axis != rest]
        assert int(edges.tip_rad[rest].isfinite().sum()) == 4
        for edge in range(4):
            off = float(edges.point[rest, edge].norm())
            assert min(abs(off - side) for side in sides) < 1.5e-3
            assert float(edges.tip_rad[rest, edge]) == pytest.approx(math.atan2(off, up), abs=0.02)
            # a quarter turn about the edge: the origin comes as far beyond it as it was high, and as high as it was off
            following = int(edges.next[rest, edge])
            assert HALF[following] == pytest.approx(off, abs=1.5e-3)
            moved = edges.change[rest, edge, :2]
            torch.testing.assert_close(moved, (off + up) * edges.normal[rest, edge], atol=4e-3, rtol=0)


def test_a_fall_is_the_turn_about_its_edge(toppled, box):
    """The pose after a fall shows the same shape as a quarter turn about the edge does."""
    rests, edges = toppled.rests, toppled.rests.edges
    planar = torch.tensor([0.1, -0.2, 0.7], **DOUBLE)
    for rest in range(3):
        for edge in range(4):
            lean = torch.tensor([rest, edge, 0.5 * math.pi], **DOUBLE)
            turned = rests.world_T_object(planar, lean)
            change = edges.change[rest, edge]
            at = se3.from_planar(planar) @ se3.from_planar(change)
            flat = torch.tensor([float(edges.next[rest, edge]), -1.0, 0.0], **DOUBLE)
            fallen = rests.world_T_object(se3.to_planar(at), flat)
            apart = se3.inverse(turned) @ fallen
            assert float(apart[:3, 3].norm()) < 4e-3
            angles = [
                float(se3.distance(apart, se3.make(turn.double(), torch.zeros(3, **DOUBLE)))[1])
                for turn in box.symmetries.rotations
            ]
            assert min(angles) < 0.02


def test_a_tilt_turns_about_its_edge():
    turn = tilted(torch.tensor([0.03, 0.0], **DOUBLE), torch.tensor([1.0, 0.0], **DOUBLE), torch.tensor(0.3, **DOUBLE))
    edge, top = torch.tensor([[0.03, 0.5, 0.0], [0.03, 0.0, 0.1]], **DOUBLE)
    torch.testing.assert_close(se3.apply(turn, edge[None])[0], edge)
    raised = torch.tensor([0.03 + 0.1 * math.sin(0.3), 0.0, 0.1 * math.cos(0.3)], **DOUBLE)
    torch.testing.assert_close(se3.apply(turn, top[None])[0], raised)


def test_a_drill_stands_and_lies_on_its_sides():
    model = drill_model()
    rests = RestingPoses.of(model.sdf, lying(model.exact.bounds)[None], model.symmetries)
    up = rests.turn[:, 2]
    assert float(up[0, 2]) == 1.0 and float(rests.height_m[0]) == pytest.approx(0.0, abs=1e-6)
    sides = [float((up @ torch.tensor(way, **DOUBLE)).max()) for way in ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0))]
    assert min(sides) > 0.99
    assert bool(rests.edges.next.lt(len(rests)).all())


def pushed(toppled, rest, yaw, height, way=0.05, friction=0.5):
    """What a tool does that comes along x and goes on by `way` after the first touch."""
    front = HALF[0] if rest else HALF[1]
    state = Leaning(torch.tensor([[0.0, 0.0, yaw]], **DOUBLE), torch.tensor([[rest, -1.0, 0.0]], **DOUBLE))
    begin, one = -front - 0.036, torch.ones(1, **DOUBLE)
    body = Sliding(torch.zeros(1, 2, **DOUBLE), 0.05 * one, friction * one)
    fell = False
    for step in range(int(way / 0.002)):
        before, after = (torch.tensor([begin + 0.002 * (step + k), 0.0, 0.0, height], **DOUBLE) for k in (0, 1))
        done = push_in_space(
            toppled.sdf, toppled.rests, toppled.tool, state, before, after, body, one, SOFT * one, 0.0 * one
        )
        state, fell = done.state, fell or bool(done.fell.any())
    return state, fell


def test_a_low_push_slides_a_high_one_leans_and_a_long_one_topples(toppled):
    # on its face y, turned so that it is 60 mm deep along x: slides below s (1 / mu + mu) = 75 mm
    low, fell = pushed(toppled, 1, 0.5 * math.pi, 0.05)
    assert not fell and float(low.planar[0, 0]) > 0.02 and float(low.lying[0, 1]) < 0
    high, fell = pushed(toppled, 1, 0.5 * math.pi, 0.12, way=0.03)
    assert not fell and float(high.planar[0, 0]) == 0.0 and float(high.lying[0, 1]) >= 0
    # what the tool has gone beyond the face, over its height, is the tilt
    assert float(high.lying[0, 2]) == pytest.approx(math.atan(0.03 / 0.12), abs=0.06)
    over, fell = pushed(toppled, 1, 0.5 * math.pi, 0.12, way=0.08)
    assert fell and int(over.lying[0, 0]) == 0
    # a thin box that lies flat never topples
    flat, fell = pushed(toppled, 0, 0.0, 0.04)
    assert not fell and int(flat.lying[0, 0]) == 0 and float(flat.planar[0, 0]) > 0.02


def gone_over(toppled, rest, path, friction=0.5, grip=0.0):
    """States of an object at rest after each motion of a tool, along x at a height each: (x, z)."""
    state = Leaning(torch.zeros(1, 3, **DOUBLE), torch.tensor([[rest, -1.0, 0.0]], **DOUBLE))
    one, states = torch.ones(1, **DOUBLE), []
    tools = torch.tensor([(x, 0.0, 0.0, z) for x, z in path], **DOUBLE)
    for before, after in itertools.pairwise(tools):
        body = Sliding(torch.zeros(1, 2, **DOUBLE), 0.05 * one, friction * one)
        own = body, one, SOFT * one, grip * one
        state = push_in_space(toppled.sdf, toppled.rests, toppled.tool, state, before, after, *own).state
        states.append(state)
    return states


def test_a_tool_that_goes_on_over_the_top_of_a_tall_box_tips_it_and_a_flat_one_stays(toppled):
    # it rubs along the top, 22 mm below its middle, near the edge ahead
    ends = {}
    for rest, up, rise in ((0, HALF[0], 0.0), (2, HALF[2], 0.0005), (2, HALF[2], 0.0)):
        path = [(0.003 * k, 2.0 * up + 0.0215 + rise * k) for k in range(8)]
        ends[rest, rise] = gone_over(toppled, rest, path)[-1]
    flat, tall, held = ends.values()
    assert float(flat.lying[0, 1]) < 0 and float(flat.planar.abs().max()) == 0
    assert float(tall.lying[0, 1]) >= 0
    assert float(tall.lying[0, 2]) == pytest.approx(7 * 0.003 / 0.21, rel=0.1)
    # it rises behind the edge, as far as the tool above lets it
    assert 0.0 < float(held.lying[0, 2]) < 0.5 * float(tall.lying[0, 2])


def test_a_flat_box_goes_along_with_a_tool_that_grips_its_top(toppled):
    path = [(0.003 * k, 2.0 * HALF[0] + 0.0215) for k in range(8)]
    free, some, whole = (gone_over(toppled, 0, path, grip=grip)[-1] for grip in (0.0, 0.5, 1.0))
    assert float(free.planar.abs().max()) == 0
    gone = float(whole.planar[0, 0])  # it turns a little, as it is held beside its middle
    assert 0.8 * 7 * 0.003 < gone <= 7 * 0.003
    assert float(some.planar[0, 0]) == pytest.approx(0.5 * gone, rel=0.1)
    assert some.lying.tolist() == whole.lying.tolist() == [[0.0, -1.0, 0.0]]


def test_a_fall_begins_slowly_goes_on_without_the_tool_and_ends(toppled):
    tip = float(toppled.rests.edges.tip_rad[2].min())
    edge = int(toppled.rests.edges.tip_rad[2].argmin())
    state = Leaning(torch.zeros(1, 3, **DOUBLE), torch.tensor([[2.0, float(edge), tip + 1e-3]], **DOUBLE))
    away, one, tilts = torch.tensor([5.0, 0.0, 0.0, 0.1], **DOUBLE), torch.ones(1, **DOUBLE), []
    body = Sliding(torch.zeros(1, 2, **DOUBLE), 0.05 * one, 0.5 * one)
    for _ in range(12):
        done = push_in_space(
            toppled.sdf, toppled.rests, toppled.tool, state, away, away, body, one, SOFT * one, 0.0 * one
        )
        state = done.state
        if bool(done.fell):
            break
        tilts.append(float(state.lying[0, 2]) - tip)
    assert bool(done.fell) and int(state.lying[0, 0]) == int(toppled.rests.edges.next[2, edge])
    gained = [later - sooner for sooner, later in itertools.pairwise(tilts)]
    assert gained == sorted(gained) and 3 <= len(tilts) <= 8
    # of a thin rod: energy is kept
    swings = 0.75 * 9.81 / math.hypot(0.03, 0.105)
    time = 0.05 * len(tilts)
    assert tilts[-1] == pytest.approx(0.5 / swings**0.5 * math.sinh(swings**0.5 * time), rel=0.1)


def history(points=40) -> History:
    random, found = generator(0), History.empty(4)
    for height in (0.05, 0.11, 0.03):
        x = torch.linspace(-0.20, -0.06, 21, **DOUBLE)
        tool = torch.stack((x, 0 * x + 0.01, 0 * x, 0 * x + height), -1)
        place = 0.2 * torch.rand(points, 3, generator=random, **DOUBLE) - torch.tensor([0.1, 0.1, 0.0], **DOUBLE)
        instant = torch.randint(20, (points,), generator=random).sort().values
        kind = torch.randint(len(Kind), (points,), generator=random)
        weight = torch.rand(points, generator=random, **DOUBLE)
        path = torch.stack((tool[:-1], tool[1:]), 1)
        found = found.appended(Segment(path, True, place, instant, kind, weight))
    return found


@pytest.fixture(scope="module")
def drill() -> ToppledObject:
    model = drill_model()
    ways = lying(model.exact.bounds)[None]
    return ToppledObject.of(model.sdf, GripperShape(), ways, model.symmetries, spacing_m=0.008, pad_spacing_m=0.006)


@pytest.mark.parametrize("which", ["toppled", "drill"])
def test_the_compiled_replay_in_space_is_the_plain_one(which, request):
    toppled, random, told, count = request.getfixturevalue(which), generator(1), history(), 45
    start = torch.randn(count, 6, generator=random, **DOUBLE) * torch.tensor([0.04, 0.04, 2.0, 0, 0, 0], **DOUBLE)
    start[:, 3], start[:, 4] = torch.arange(count) % min(3, len(toppled.rests)), -1.0
    physics = torch.randn(count, PHYSICS, generator=random, **DOUBLE)
    noise = torch.randn(count, 3, NOISE, generator=random, **DOUBLE)
    given = Trajectories(physics, noise, start[:, None].repeat(1, 4, 1), start.new_zeros(count, 3), told, start)
    found = []
    for version in ("torch", "numba"):
        with backend.force(version):
            whole = given.replayed(toppled, OWN, told, torch.zeros(count, dtype=torch.long))
            found.append(whole)
            again = whole.replayed(toppled, OWN, told, torch.arange(count) % 3)
            torch.testing.assert_close(again.poses, whole.poses, atol=0, rtol=0)
    one, other = found
    assert float((one.pose - start)[:, :2].norm(dim=-1).max()) > 0.01 and bool((one.poses[..., 4] >= 0).any())
    torch.testing.assert_close(one.poses, other.poses, atol=1e-4, rtol=0)  # which of two points is deepest
    torch.testing.assert_close(one.log_likelihood, other.log_likelihood, atol=2e-3, rtol=2e-4)


def test_the_plane_is_the_case_without_a_tilt(box, toppled):
    """A box on its thin face, a level tool: the replay in space goes as the one in the plane, by an outline."""
    flat = PushedObject.of(
        toppled.sdf, GripperShape(), height_m=0.08, resting_m=HALF[2], spacing_m=0.003, pad_spacing_m=0.006
    )
    x = torch.linspace(-0.10, -0.03, 15, **DOUBLE)
    own = PoseTrajectorySettings(ahead=(0.0, 0.0), firm_change=0.0)
    path = torch.stack((x[:-1], x[1:]), -1)[..., None] * torch.tensor([1.0, 0.0, 0.0], **DOUBLE)
    path = path + torch.tensor([0.0, 0.04, 0.0], **DOUBLE)
    # across its long side, 158 mm deep: it slides at this height, and turns
    some = torch.tensor([[0.06, 0.0, 0.5 * math.pi]], **DOUBLE)
    plane = flat.tracks(own, some, path)[0, -1]
    up = torch.cat((path, torch.full_like(path[..., :1], 0.08)), -1)
    space = toppled.tracks(own, torch.cat((some, torch.tensor([[2.0, -1.0, 0.0]], **DOUBLE)), -1), up)[0, -1]
    assert float((plane[:2] - some[0, :2]).norm()) > 0.01
    torch.testing.assert_close(space[:2], plane[:2], atol=2e-3, rtol=0)
    assert float(space[2] - plane[2]) == pytest.approx(0.0, abs=0.03)
    assert space[3:].tolist() == [2.0, -1.0, 0.0]
