"""Named faults of trajectories: densities are densities, and each fault ranks first where it happened."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.stuck_hand import Told
from rumi.belief.tempering import log_mean
from rumi.belief.trajectory_faults import TRAJECTORY_FAULTS, last_contact_off, log_ratios, new_segments
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

DOUBLE = {"dtype": torch.float64}
OWN, SENSED = MisfitSettings(), PoseTrajectorySettings()
FACE = torch.stack((torch.full((9,), -0.04), torch.linspace(-0.02, 0.02, 9), torch.zeros(9)), -1).double()


def particles(spread: float = 5e-4, count: int = 80) -> Trajectories:
    pose = spread * torch.randn(count, 1, 3, generator=generator(1), **DOUBLE)
    none = torch.zeros(count, 0, **DOUBLE)
    return Trajectories(
        none.new_zeros(count, 5), none[..., None].expand(-1, -1, 11), pose, none, History.empty(), pose[:0, 0]
    )


def reading(kind: Kind, shift: float, instants: int = 5) -> Segment:
    """The block's face, moved, felt or passed at some instants, by a tool that pushes nothing."""
    points = (FACE + torch.tensor([shift, 0.0, 0.0], **DOUBLE)).repeat(instants, 1)
    pads = int(Kind.PAD_FELT if kind == Kind.FELT else Kind.PAD_CLEAR)
    when = torch.arange(instants).repeat_interleave(len(FACE)).repeat_interleave(2)
    kinds = torch.tensor([pads, int(kind)]).repeat(len(points))
    weight = torch.where(kinds >= Kind.PAD_FELT, 0.5, SENSED.felt_weight / len(FACE))
    return Segment(torch.zeros(instants, 2, 3, **DOUBLE), False, points.repeat_interleave(2, 0), when, kinds, weight)


def pushed_face(turned: float) -> Segment:
    """The block's face, felt while the tool's pads push it 20 mm ahead; by then it has turned so far, radians."""
    steps = 10
    way = torch.linspace(0.0, 0.02, steps + 1, **DOUBLE)
    tool = torch.zeros(steps, 2, 3, **DOUBLE)
    reach = 0.04 + GripperShape().outline(0.006)[:, 0].max().double()
    tool[:, 0, 0], tool[:, 1, 0] = way[:-1] - reach, way[1:] - reach
    parts = []
    for step in range(1, steps + 1):
        angle = torch.tensor(turned * step / steps, **DOUBLE)
        turn = torch.stack((torch.stack((angle.cos(), -angle.sin())), torch.stack((angle.sin(), angle.cos()))))
        face = FACE.clone()
        face[:, 0] -= SENSED.felt_m
        face[:, :2] = face[:, :2] @ turn.T
        face[:, 0] += way[step]
        parts.append(face)
    points = torch.cat(parts)
    when = torch.arange(steps).repeat_interleave(len(FACE))
    kinds, weight = torch.full((len(points),), int(Kind.FELT)), torch.full((len(points),), SENSED.felt_weight / 3.0)
    return Segment(tool, True, points, when, kinds, weight.double())


def taken_in(before: Trajectories, segment: Segment, model) -> Trajectories:
    """What the filter would have after it: here nothing is resampled."""
    history = before.history.appended(segment)
    after = before.lengthened(torch.zeros(len(before), 1, 11, **DOUBLE), history)
    after = after.replayed(model, SENSED, history, torch.full((len(before),), len(history) - 1))
    told = log_mean(torch.zeros(len(before), **DOUBLE), after.log_likelihood[:, -1])
    return replace(after, log_evidence=before.log_evidence + told)


def ratios(
    model, segment: Segment, sensed: PoseTrajectorySettings = SENSED, stuck: float = -math.inf
) -> dict[str, float]:
    before = particles()
    after = taken_in(before, segment._replace(weight=segment.weight.double()), model)
    even = torch.zeros(len(before), **DOUBLE).log_softmax(0)
    pose_filter = PoseTrajectoryFilter(FilterSettings(trajectories=sensed), Discrepancy(model.sdf, 0.1), model)
    found = log_ratios(before, even, after, pose_filter, OWN, generator=generator(2), stuck=Told(stuck, stuck))
    assert not bool(found.isnan().any()) and float(found.max()) < torch.inf
    return dict(zip(TRAJECTORY_FAULTS, found.tolist(), strict=True))


def test_what_fits_speaks_for_no_fault(model):
    found = ratios(model, reading(Kind.FELT, -SENSED.felt_m))
    assert max(found.values()) <= 0.0
    empty = ratios(model, reading(Kind.PAD_CLEAR, -0.05))  # far in front of it
    assert max(empty.values()) < 1.0


def test_a_face_felt_elsewhere_for_long_is_a_knock(model):
    found = ratios(model, reading(Kind.FELT, -0.03))
    assert found["knocked"] > 5.0 and max(found, key=found.__getitem__) == "knocked"


def test_a_touch_where_nothing_is_that_lasts_an_instant_is_false(model):
    brief = ratios(model, reading(Kind.FELT, -0.3, instants=1))
    assert max(brief, key=brief.__getitem__) == "false contacts" and brief["false contacts"] > 5.0
    assert ratios(model, reading(Kind.FELT, -0.3))["false contacts"] < brief["false contacts"] - 2.0


def test_pads_that_are_stated_to_feel_falsely_are_no_fault_when_they_do_once(model):
    stated = replace(SENSED, false=2e-4)
    brief = reading(Kind.FELT, -0.3, instants=1)
    found = ratios(model, brief, stated)["false contacts"]
    chance = 1.0 - (1.0 - 2e-4) ** 2  # two pads at one instant
    assert found == pytest.approx(math.log(0.3 * 0.8 / (chance + 0.1 * OWN.outlier)))
    longer = reading(Kind.FELT, -0.3)  # no pad that errs for an instant does that
    assert ratios(model, longer, stated)["false contacts"] == ratios(model, longer)["false contacts"]


def test_a_last_touch_that_pads_are_stated_to_feel_falsely_is_beside_nothing(model):
    segment = reading(Kind.FELT, -0.3, instants=1)
    after = taken_in(particles(), segment, model)
    for false, off in ((0.0, 0.3), (2e-4, 0.0)):
        settings = FilterSettings(trajectories=replace(SENSED, false=false))
        pose_filter = PoseTrajectoryFilter(settings, Discrepancy(model.sdf, 0.1), model)
        assert last_contact_off(after, 1, pose_filter) == pytest.approx(off, abs=0.05)


def test_pads_that_pass_through_the_object_and_feel_nothing_say_that_it_is_gone_or_the_hand_dead(model):
    found = ratios(model, reading(Kind.PAD_CLEAR, 0.03))
    assert found["absent"] == found["dead hand"] > 5.0 > found["false contacts"]


def seen(points: torch.Tensor) -> Segment:
    return Segment(
        torch.zeros(1, 2, 3, **DOUBLE),
        False,
        points,
        torch.zeros(len(points), dtype=torch.long),
        torch.full((len(points),), int(Kind.SEEN)),
        torch.full((len(points),), 2.0, **DOUBLE),
    )


def test_a_view_that_does_not_fit_is_no_dead_hand_since_the_object_is_there(model):
    found = ratios(model, seen(FACE + torch.tensor([-0.012, 0.0, 0.0], **DOUBLE)))
    assert found["knocked"] > 5.0 and found["dead hand"] < 1.0


def test_a_touch_where_nothing_is_that_lasts_while_the_object_is_felt_too_is_a_second_object(model):
    strange, own = reading(Kind.FELT, -0.3, instants=10), reading(Kind.FELT, -SENSED.felt_m, instants=10)
    both = own._replace(  # the object itself first, then something else
        tool=torch.zeros(20, 2, 3, **DOUBLE),
        points=torch.cat((own.points, strange.points)),
        instant=torch.cat((own.instant, strange.instant + 10)),
        kind=torch.cat((own.kind, strange.kind)),
        weight=torch.cat((own.weight, strange.weight)),
    )
    found = ratios(model, both)
    assert max(found, key=found.__getitem__) == "second object" and found["second object"] > 5.0


def test_a_hand_that_feels_the_same_everywhere_is_stuck_and_no_second_object(model):
    way = torch.linspace(0.0, 0.1, 10, **DOUBLE)
    points = (FACE - torch.tensor([0.2, 0.0, 0.0], **DOUBLE)).repeat(10, 1)
    when = torch.arange(10).repeat_interleave(len(FACE))
    points[:, 0] += way[when]  # carried by the hand through free space
    tool = torch.zeros(10, 2, 3, **DOUBLE)
    tool[:, 1, 0] = way
    kinds = torch.tensor([int(Kind.PAD_FELT), int(Kind.FELT)]).repeat(len(points))
    weight = torch.where(kinds == Kind.PAD_FELT, 0.5, SENSED.felt_weight / len(FACE))
    stuck = Segment(tool, True, points.repeat_interleave(2, 0), when.repeat_interleave(2, 0), kinds, weight)
    assert ratios(model, stuck)["stuck hand"] == -torch.inf
    # what it feels where nothing is costs it no more than a second object, and that is seldom felt alike
    for told in (3.0, 9.2):
        found = ratios(model, stuck, stuck=told)
        assert max(found, key=found.__getitem__) == "stuck hand"
        assert found["stuck hand"] - found["second object"] == pytest.approx(told - math.log(3 * 0.3 * 1e-3), abs=0.1)
    # one that had no chance to repeat itself is no more likely than before
    found = ratios(model, stuck, stuck=0.0)
    assert max(found, key=found.__getitem__) == "second object" and found["stuck hand"] == 0.0


def looked(points: torch.Tensor, place: tuple[float, float, float] = (-0.5, 0.0, 0.0)) -> Reading:
    """What a camera that looks after every action saw, world frame, with the tool somewhere."""
    world = points.float() + torch.tensor([0.0, 0.0, 0.03])
    pose, nowhere = torch.eye(4)[None].clone(), torch.zeros(len(points), dtype=torch.long)
    pose[0, :3, 3] = torch.tensor(place)
    none = torch.zeros(1, dtype=torch.bool)
    return Reading(Observation.of(world, Semantics.SURFACE), nowhere, pose, none, None, torch.zeros(3), torch.zeros(()))


def test_a_view_that_repeats_the_last_one_while_the_object_has_moved_is_stale(model):
    view, first = seen(FACE.clone()), looked(FACE)
    pose_filter = PoseTrajectoryFilter(FilterSettings(), Discrepancy(model.sdf, 0.1), model)
    beside = tuple((FACE[0].float() + torch.tensor([0.0, 0.0, 0.03]) - model.reported[0].float()).tolist())
    told = {}
    for name, moved, again, reading in (
        ("stale", 0.03, view, looked(FACE)),
        ("stale, the pads at a part of it", 0.03, view, looked(FACE, beside)),
        ("still", 0.0, view, looked(FACE)),
        ("new", 0.03, view._replace(points=FACE + 0.004), looked(FACE + 0.004)),
    ):
        before = taken_in(particles(), view, model)
        ahead = torch.tensor([moved, 0.0, 0.0], **DOUBLE)  # by what was felt since
        before = replace(before, poses=torch.cat((before.poses[:, :-1], before.poses[:, -1:] + ahead), 1))
        even = torch.zeros(len(before), **DOUBLE).log_softmax(0)
        after = taken_in(before, again, model)
        looks = (first, reading)
        found = log_ratios(before, even, after, pose_filter, OWN, generator=generator(2), looks=looks)
        told[name] = dict(zip(TRAJECTORY_FAULTS, found.tolist(), strict=True))
    for name in ("stale", "stale, the pads at a part of it"):
        assert max(told[name], key=told[name].__getitem__) == "stale camera" and told[name]["stale camera"] > 5.0
    assert abs(told["still"]["stale camera"]) <= 1.0 and told["new"]["stale camera"] == -torch.inf


def test_an_object_that_neither_pads_nor_a_camera_find_any_more_is_gone(model):
    pose_filter = PoseTrajectoryFilter(FilterSettings(), Discrepancy(model.sdf, 0.1), model)
    before = particles()
    even = torch.zeros(len(before), **DOUBLE).log_softmax(0)
    nothing = looked(FACE[:0])
    through = seen(FACE + torch.tensor([0.03, 0.0, 0.0], **DOUBLE))
    free = through._replace(kind=torch.full_like(through.kind, int(Kind.FREE)))
    for segment, apart in ((reading(Kind.PAD_CLEAR, 0.03), 1.0), (free, 5.0)):
        after = taken_in(before, segment._replace(weight=segment.weight.double()), model)
        looks = (looked(FACE), nothing)
        found = log_ratios(before, even, after, pose_filter, OWN, generator=generator(2), looks=looks)
        told = dict(zip(TRAJECTORY_FAULTS, found.tolist(), strict=True))
        assert max(told, key=told.__getitem__) == "absent" and told["absent"] > told["dead hand"] + apart


def test_a_view_of_nothing_tells_little_where_all_else_fits(model):
    """A camera may miss the object now and then, and no single view that does is worth an alarm."""
    pose_filter = PoseTrajectoryFilter(FilterSettings(), Discrepancy(model.sdf, 0.1), model)
    before = particles()
    even = torch.zeros(len(before), **DOUBLE).log_softmax(0)
    segment = reading(Kind.PAD_CLEAR, -0.05)
    after = taken_in(before, segment._replace(weight=segment.weight.double()), model)
    looks = (looked(FACE), looked(FACE[:0]))
    found = log_ratios(before, even, after, pose_filter, OWN, generator=generator(2), looks=looks)
    assert 0.0 < float(found.max()) <= 1.0
    nothing = log_ratios(before, even, before, pose_filter, OWN, generator=generator(2), looks=looks)
    told = dict(zip(TRAJECTORY_FAULTS, nothing.tolist(), strict=True))
    assert told.pop("stuck hand") == -torch.inf and not any(told.values())


def test_a_contact_that_slides_off_the_surface_believed_is_no_false_one(model):
    own, strange = reading(Kind.FELT, -SENSED.felt_m, instants=2), reading(Kind.FELT, -0.3, instants=1)
    slid = own._replace(
        tool=torch.zeros(3, 2, 3, **DOUBLE),
        points=torch.cat((own.points, strange.points)),
        instant=torch.cat((own.instant, strange.instant + 2)),
        kind=torch.cat((own.kind, strange.kind)),
        weight=torch.cat((own.weight, strange.weight)),
    )
    assert ratios(model, slid)["false contacts"] > 5.0  # at quite another place of the hand
    carried = slid._replace(tool=slid.tool.clone())
    carried.tool[2, :, 0] = -0.3  # at the same place of a hand that went there
    assert ratios(model, carried)["false contacts"] < 0.0


def test_a_reading_that_adds_nothing_or_begins_anew_tells_nothing(model):
    before = particles()
    assert new_segments(before, before) == 0
    segment = reading(Kind.FELT, 0.0)
    longer = taken_in(taken_in(before, segment, model), segment, model)
    assert new_segments(longer, before) == 0 and new_segments(before, longer) == 2
    assert new_segments(longer, taken_in(longer, segment, model).remembered(2)) == 1


def test_a_push_that_goes_as_no_prior_has_it_is_the_push_model_and_one_that_does_is_not(model):
    pose_filter = PoseTrajectoryFilter(FilterSettings(), Discrepancy(model.sdf, 0.1), model)
    expected, odd = ({}, {})
    for turned, found in ((0.0, expected), (2.2, odd)):
        before = particles()
        even = torch.zeros(len(before), **DOUBLE).log_softmax(0)
        segment = pushed_face(turned)
        now = pose_filter.absorbed(before, even, segment, generator(3), opens=True, closes=True)
        told = log_ratios(before, even, now, pose_filter, OWN, generator=generator(2))
        found |= dict(zip(TRAJECTORY_FAULTS, told.tolist(), strict=True))
    assert expected["push model off"] <= 0.0 < 3.0 < odd["push model off"]
