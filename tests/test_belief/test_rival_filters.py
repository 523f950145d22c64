"""Beliefs under faults that hold from the first view on: each is the likeliest where its fault is true."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.offset_rings import CAMERA, HAND, STRAIGHT_RAD, drawn
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.rival_filters import (
    MOVED_KERNEL,
    NO_FAULT,
    RIVALS,
    Rival,
    adopted,
    begun,
    doubted,
    followed,
    is_asked_again,
    left,
    log_none,
    log_none_by,
    log_ratios,
)
from rumi.belief.systematic_errors import NUMBERS
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading

DOUBLE = {"dtype": torch.float64}
SENSED = PoseTrajectorySettings(particles=60)
HALF = (0.04, 0.06, 0.03)


@pytest.fixture(scope="module")
def pose_filter() -> PoseTrajectoryFilter:
    block = GridSDF.from_sdf(Box(list(HALF)), 0.003)
    model = PushedObject.of(
        block, GripperShape(), height_m=0.03, resting_m=HALF[2], spacing_m=0.006, pad_spacing_m=0.006
    )
    return PoseTrajectoryFilter(FilterSettings(trajectories=SENSED), Discrepancy(block, 0.1), model)


def seen(factor: float) -> Segment:
    """A view of three sides of the block in another size, that stands at the origin; heights from its own."""
    x, y, z = (factor * half for half in HALF)
    u = torch.linspace(-0.8, 0.8, 9, **DOUBLE)
    one, other = (part.flatten() for part in torch.meshgrid(u, u, indexing="ij"))
    sides = (
        torch.stack((torch.full_like(one, -x), y * one, z * other), -1),
        torch.stack((x * one, torch.full_like(one, -y), z * other), -1),
        torch.stack((x * one, y * other, torch.full_like(one, z)), -1),
    )
    points = torch.cat(sides) + torch.tensor([0.0, 0.0, z - HALF[2]], **DOUBLE)  # it rests on the same floor
    weight = torch.full((len(points),), SENSED.seen_points / len(points), **DOUBLE)
    kinds, still = torch.full((len(points),), int(Kind.SEEN)), torch.zeros(1, 2, 3, **DOUBLE)
    return Segment(still, False, points, torch.zeros(len(points), dtype=torch.long), kinds, weight)


def believed(factor: float) -> Trajectories:
    """Particles about the pose that shows it, with the view."""
    pose = 5e-4 * torch.randn(60, 3, generator=generator(1), **DOUBLE)
    history = History.empty().appended(seen(factor))
    return Trajectories.drawn(pose, history, generator(2))


@pytest.mark.parametrize("factor", [0.93, 1.07])
def test_a_view_of_another_size_speaks_for_it_and_of_its_own_against(pose_filter, factor):
    other = log_ratios(begun(pose_filter, believed(factor), generator(3)), 0.0)
    same = log_ratios(begun(pose_filter, believed(1.0), generator(3)), 0.0)
    assert other["another size"] > 3.0 and same["another size"] < -1.0
    assert other.keys() == set(RIVALS) and other["hand off"] == other["camera off"] == pytest.approx(0.0, abs=1e-6)


def test_an_object_in_another_size_has_its_distances_and_outline(pose_filter):
    larger = pose_filter.model.resized(1.1)
    places = 0.1 * torch.rand(50, 3, generator=generator(4)) - 0.05
    torch.testing.assert_close(
        larger.sdf.distance(1.1 * places), 1.1 * pose_filter.model.sdf.distance(places), atol=1e-5, rtol=0
    )
    assert larger.resting_m == pytest.approx(1.1 * HALF[2])
    middle = larger.outline(torch.tensor([[0.0, 1.1 * HALF[1]]], **DOUBLE)).distance
    assert abs(float(middle)) < 1e-3
    with pytest.raises(TypeError, match="tabulated"):
        replace(larger, sdf=Box(list(HALF))).resized(1.1)


@pytest.mark.parametrize(("name", "middle"), [("hand off", HAND.middle), ("camera off", CAMERA.middle)])
def test_what_was_moved_begins_at_its_distance_and_keeps_nothing_of_the_view(pose_filter, name, middle):
    some = [rival for rival in begun(pose_filter, believed(1.0), generator(5)) if rival.name == name]
    assert some and not any(len(rival.now.history) for rival in some)
    assert all(rival.seen is None for rival in some)
    off = pose_filter.supposing(own=replace(SENSED, view_off_m=0.0024))
    first = believed(1.0)
    first = replace(first, physics=torch.cat((first.physics, torch.zeros(60, NUMBERS, **DOUBLE)), -1))
    turned = pose_filter.supposing(own=replace(SENSED, view_off_rad=0.01, view_about_m=(0.3, 0.0)))
    for one in (off, turned):
        kept = [rival.seen is not None for rival in begun(one, first, generator(5)) if rival.name == name]
        assert kept and all(kept)
    far = torch.cat([rival.now.pose[:, :2].norm(dim=-1) for rival in some])
    assert float(far.median()) == pytest.approx(middle, rel=0.15)


def test_rivals_that_are_hopeless_are_left_out_and_those_of_a_name_share_their_evidence(pose_filter):
    now = believed(1.0)
    even = torch.zeros(60, **DOUBLE).log_softmax(-1)
    some = [Rival("another size", -0.7, pose_filter, now, even, view) for view in (2.0, -20.0)]
    assert left(some, 0.0) == (some[0],)
    found = log_ratios(some[:1], 0.0)
    assert found["another size"] == pytest.approx(1.3) and found["hand off"] == -torch.inf
    assert len(adopted(some[0], 17)) == 17


def test_a_reading_far_from_the_object_tells_none_from_another(pose_filter):
    away = se3.from_planar(torch.tensor([[1.0, 1.0, 0.0], [1.1, 1.0, 0.0]]))
    none, places = torch.zeros(0, dtype=torch.long), Observation.empty()
    reading = Reading(places, none, away, torch.zeros(2, dtype=torch.bool), None, torch.zeros(3), torch.zeros(()))
    rivals = begun(pose_filter, believed(1.0), generator(6))
    assert log_ratios(followed(rivals, reading, generator(7)), 0.0) == log_ratios(rivals, 0.0)


def test_no_fault_is_the_mean_over_its_copies_and_the_belief_that_a_run_goes_by(pose_filter):
    now, even = believed(1.0), torch.zeros(60, **DOUBLE).log_softmax(-1)
    share = -torch.tensor(3.0).log().item()
    copies = [Rival(NO_FAULT, 0.0, pose_filter, replace(now, log_evidence=told), even, 0.0) for told in (-30.0, -34.0)]
    mean = torch.tensor([-40.0, -30.0, -34.0], **DOUBLE).logsumexp(0).item() + share
    assert log_none(copies, -40.0) == pytest.approx(mean)
    fault = Rival("push model off", 0.0, pose_filter, replace(now, log_evidence=-31.0), even, 0.0)
    assert log_ratios([*copies, fault], -40.0)["push model off"] == pytest.approx(-31.0 - mean, abs=1e-5)
    lone = fault._replace(name="another size")
    hopeless = lone._replace(now=replace(now, log_evidence=-60.0))
    assert left([*copies, lone, hopeless], -30.0) == (*copies, lone)  # a copy stays, however unlikely
    assert left([*copies, fault], 0.0) == ()  # unless nothing is asked any more


def test_moves_leave_an_offset_its_prior(pose_filter):
    hand = next(rival for rival in begun(pose_filter, believed(1.0), generator(8)) if rival.name == "hand off")
    moves = hand.pose_filter.moves(hand.pose_filter.model, hand.pose_filter.own, generator(9))
    now = hand.now
    for _ in range(30):
        now = moves.sweep(now, now.history, whole=True)
    far = now.pose[:, :2].norm(dim=-1)
    assert float(far.mean()) == pytest.approx(HAND.middle, abs=1.5e-3) and float(far.max()) < 0.016
    assert not torch.equal(now.pose, hand.now.pose)


@pytest.mark.parametrize("ring", [HAND, CAMERA])
def test_offsets_are_about_so_far_any_way_and_hardly_turn(ring):
    offsets = drawn(ring, 20000, generator(10))
    far = offsets[:, :2].norm(dim=-1)
    assert float(far.mean()) == pytest.approx(ring.middle, rel=0.02)
    assert float(far.std()) == pytest.approx(ring.spread, rel=0.05)
    assert float(offsets[:, :2].mean(0).norm()) < 0.02 * ring.middle
    assert float(offsets[:, 2].std()) == pytest.approx(STRAIGHT_RAD, rel=0.05)


def test_no_fault_by_an_offset_s_own_particles_is_what_it_is_by_the_view(pose_filter):
    """Readings that are a normal density of the start pose: the particles of the offset tell what the view's would."""
    random = generator(11)
    seen = torch.randn(300, 3, generator=random, **DOUBLE) * torch.tensor([0.0025, 0.0025, 0.03], **DOUBLE)
    moved = seen[torch.randint(300, (400,), generator=random)] + drawn(HAND, 400, random)
    kernel = torch.tensor(MOVED_KERNEL, **DOUBLE)
    start = moved[torch.randint(400, (20000,), generator=random)]
    start = start + kernel * torch.randn(20000, 3, generator=random, **DOUBLE)

    def told(poses: torch.Tensor) -> torch.Tensor:
        return -0.5 * ((poses[:, :2] - torch.tensor([0.003, 0.0], **DOUBLE)) / 0.002).square().sum(-1)

    now = Trajectories.drawn(start, History.empty(), random, moved)
    evidence = float(told(start).logsumexp(0)) - math.log(20000)
    now = replace(now, log_evidence=evidence)
    rival = Rival("hand off", -1.0, pose_filter, now, told(start).log_softmax(0), 0.0, seen)
    # the density of the view: its draws, with a kernel of half their deviation
    width = 0.5 * float(seen[:, :2].std(0).amax())
    view = seen[torch.randint(300, (200000,), generator=random)]
    view = view + torch.tensor([width, width, MOVED_KERNEL[2]], **DOUBLE) * torch.randn(
        200000, 3, generator=random, **DOUBLE
    )
    expected = float(told(view).logsumexp(0)) - math.log(200000)
    assert log_none_by(rival) == pytest.approx(-1.0 + expected, abs=0.1)
    # however much the marginal likelihood errs by, it is no evidence of the offset
    lucky = rival._replace(now=replace(now, log_evidence=evidence + 20.0))
    assert log_ratios([lucky], evidence)["hand off"] == pytest.approx(evidence - expected, abs=0.1)
    assert log_none_by(rival._replace(seen=None)) == -torch.inf
    assert log_none_by(rival._replace(now=replace(now, starts=moved[:0]))) == -torch.inf  # forgotten


def test_where_an_alarm_is_due_no_fault_has_further_copies(pose_filter):
    first = believed(1.0)
    rivals = begun(pose_filter, first, generator(12))
    further = doubted(pose_filter, first, [], generator(13))
    assert not is_asked_again(rivals) and is_asked_again([*rivals, *further])
    assert {(rival.name, len(rival.now)) for rival in further} == {(NO_FAULT, SENSED.particles)}
    lucky = [rival._replace(now=replace(rival.now, log_evidence=-3.0)) for rival in further]
    copies = [rival for rival in rivals if rival.name == NO_FAULT]
    unlikely = [rival._replace(now=replace(rival.now, log_evidence=-30.0)) for rival in copies]
    count = len(unlikely) + len(further) + 1
    assert log_none([*unlikely, *lucky], -30.0) == pytest.approx(-3.0 + math.log(len(further) / count), abs=1e-6)
