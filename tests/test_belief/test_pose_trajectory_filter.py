"""Filter whose particles are trajectories: it takes in anything, follows what nothing measures, and forgets."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.filter_settings import FilterSettings
from rumi.belief.knocked_trajectories import begun_again, sought
from rumi.belief.misfit import MisfitSettings
from rumi.belief.particles import PoseBelief, subsample
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.segments import besides, cut, felt_pads, standing
from rumi.belief.trajectory_history import History, Kind
from rumi.belief.trajectory_moves import Moves
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.along_path import Pusher, push_along_path
from rumi.dynamics.sliding import Sliding
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import se3
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics

DOUBLE = {"dtype": torch.float64}
OWN = PoseTrajectorySettings(particles=60, branches=3, rounds=1)
SHAPE, HEIGHT = GripperShape(), 0.03

pytestmark = pytest.mark.usefixtures("by_numba")


def felt_by(pose: torch.Tensor, tool: torch.Tensor, model: PushedObject) -> Reading:
    """What the pads feel of a block at a pose, and free points where they are not."""
    pads = SHAPE.pad_shell(0.006).double()
    at = se3.from_planar(tool, HEIGHT)
    there = se3.apply(at, pads)
    local = se3.apply(se3.inverse(se3.from_planar(pose, 0.03)), there)
    felt = model.sdf.distance(local.float()).abs() <= 0.003
    instant, index = felt.nonzero(as_tuple=True)
    free = there[:, ::8].reshape(-1, 3)
    points = concatenate(
        [Observation.of(there[instant, index].float(), Semantics.SURFACE), Observation.of(free.float(), Semantics.FREE)]
    )
    when = torch.cat((instant, torch.arange(len(tool)).repeat_interleave(len(free) // len(tool))))
    return Reading(points, when, at.float(), felt.any(-1), None, tool[-1].float(), torch.zeros(()))


def follow(model, dtype=torch.float32, **changes):
    settings = replace(FilterSettings(motion="trajectory"), trajectories=replace(OWN, pad_spacing_m=0.006, **changes))
    sdf = copy.deepcopy(model.sdf).to(dtype)
    discrepancy = Discrepancy(sdf, 0.08, free_scale=80.0, tolerance=0.001).to(dtype)
    return PoseTrajectoryFilter(settings, discrepancy, replace(model, sdf=sdf))


def begin(followed, dtype=torch.float32, seed=0):
    around = torch.tensor([[0.0, 0.0, 0.0], [0.004, 0.0, 0.05], [0.0, -0.004, -0.05]], dtype=dtype)
    wall = torch.linspace(-0.05, 0.05, 12, dtype=dtype)
    view = Observation.of(torch.stack((0 * wall - 0.04, wall, 0 * wall + 0.03), -1), Semantics.SURFACE)
    poses = PoseBelief.uniform(se3.from_planar(around, 0.03))
    return followed.begin(poses, view, generator=generator(seed)), view


PUSH = torch.stack((torch.linspace(-0.10, -0.06, 8), torch.full((8,), 0.012), torch.zeros(8)), -1).double()
AWAY = PUSH - torch.tensor([0.1, 0.0, 0.0], **DOUBLE)


@pytest.mark.parametrize("starts", [True, False])
def test_a_first_touch_is_met_by_more_particles_where_starts_are_known(model, starts):
    """Nothing is left open where a motion has begun anew from particles alone: those that there are meet it."""
    followed = follow(model, first_particles=200, tool_off_m=0.001)
    belief, memory = begin(followed)
    now = belief.trajectories
    if not starts:
        fresh = Trajectories.drawn(now.pose.clone(), History.empty(), generator(2), systematic=now.systematic)
        belief = replace(belief, trajectories=fresh)
    after, _, info = followed(belief, memory, felt_by(0 * PUSH, PUSH, model), generator=generator(1))
    assert bool(info.moved) and len(after.trajectories) == OWN.particles
    assert bool(torch.isfinite(after.world_T_object).all())


@pytest.mark.parametrize("looks", [False, True])
@pytest.mark.parametrize("first_particles", [0, 200])
def test_particles_move_from_their_start_once_an_action_when_all_was_sensed(model, monkeypatch, first_particles, looks):
    """After the view, where a camera looks after the touch; a first touch's many particles wait for it."""
    followed = follow(model, first_particles=first_particles, tool_off_m=0.001, view_off_m=0.001)
    belief, memory = begin(followed)
    reading, wall = felt_by(0 * PUSH, PUSH, model), torch.linspace(-0.05, 0.05, 12)
    if looks:
        seen = Observation.of(torch.stack((0.04 + 0 * wall, wall, 0 * wall + 0.03), -1), Semantics.SURFACE)
        when = torch.cat((reading.instant, torch.full((len(seen),), len(PUSH) - 1)))
        reading = replace(reading, observation=concatenate([reading.observation, seen]), instant=when)
    sweep, whole = Moves.sweep, []

    def noted(self, given, history, **options):
        if options["whole"]:
            whole.append((len(given), int(history.kind[-1]) == Kind.SEEN))
        return sweep(self, given, history, **options)

    monkeypatch.setattr(Moves, "sweep", noted)
    after, _, info = followed(belief, memory, reading, generator=generator(1))
    assert whole == [(OWN.particles, looks)] and bool(info.resampled)
    assert len(after.trajectories) == OWN.particles and math.isfinite(after.trajectories.log_evidence)


def test_what_is_seen_of_what_rests_weighs_particles_and_moves_none(model):
    """Where their weights stay even enough; an action that it closes moves them, and keeps these weights."""
    followed = follow(model, view_off_m=0.001)
    belief, _ = begin(followed)
    now, even = followed.particles_of(belief)
    view = now.history.segment(0)
    view = view._replace(weight=0.05 * view.weight)
    rested, weights, resampled = followed._weighed(now, even, view, generator(1))
    closed, kept, again = followed._weighed(now, even, view, generator(1), closes=True)
    assert not resampled and not again and float(weights.std()) > 0
    assert torch.equal(rested.poses[:, 0], now.poses[:, 0]) and not torch.equal(closed.poses[:, 0], now.poses[:, 0])
    torch.testing.assert_close(kept, weights, atol=0, rtol=0)
    assert rested.log_evidence == closed.log_evidence


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_filter_follows_a_push_that_nothing_measures(model, dtype):
    followed = follow(model, dtype)
    belief, memory = begin(followed, dtype)
    # away from the object nothing is learnt, and the very same belief comes back
    same, memory, info = followed(
        belief, memory, felt_by(0 * PUSH[0], AWAY, model).to(dtype=dtype), generator=generator(1)
    )
    assert same is belief and not bool(info.moved)
    true = push_along_path(
        torch.zeros(1, 3, **DOUBLE),
        torch.cat((PUSH[:1], PUSH))[None],
        Pusher(model.tool),
        model.outline,
        Sliding(model.centre, torch.tensor(1.2 * model.spread_m, **DOUBLE), torch.tensor(0.4, **DOUBLE)),
    ).track[0]
    reading = felt_by(true, PUSH, model).to(dtype=dtype)
    assert bool(reading.in_contact.any()) and float(true[-1, 0]) > 0.01
    runs = [followed(same, memory, reading, generator=generator(2)) for _ in range(2)]
    assert torch.equal(runs[0][0].world_T_object, runs[1][0].world_T_object)  # the same seed, the same bits
    belief, memory, info = runs[0]
    assert bool(info.moved) and bool(info.resampled) and belief.world_T_object.dtype == dtype
    apart, turned = se3.distance(belief.mode(), se3.from_planar(true[-1], 0.03).to(dtype))
    assert float(apart) < 0.006 and float(turned) < 0.1
    # what was taken in bit by bit is what a replay of the whole history gives
    now = belief.trajectories
    whole = now.replayed(followed.model, followed.own, now.history, torch.zeros(len(now), dtype=torch.long))
    torch.testing.assert_close(whole.poses, now.poses, atol=1e-12, rtol=0)
    torch.testing.assert_close(whole.log_likelihood, now.log_likelihood, atol=1e-9, rtol=0)
    few = subsample(belief, 10)
    assert type(few) is PoseBelief and few.world_T_object.shape == (10, 4, 4)


def test_a_sensed_motion_tells_what_is_not_felt(model):
    """The block slips along the face that the pads feel."""
    true = torch.zeros(8, 3, **DOUBLE)
    true[4:, 0] = torch.linspace(0.002, 0.012, 4)
    true[4:, 1] = torch.linspace(0.001, 0.006, 4)
    unsensed = felt_by(true, PUSH, model)
    motion = se3.from_planar(true, 0.03) @ se3.inverse(se3.from_planar(torch.zeros(1, 3, **DOUBLE), 0.03))
    slips, off = [], []
    for reading in (unsensed, replace(unsensed, object_motion=motion.float())):
        followed = follow(model, across=0.6, moved_m=0.0005, moved_rad=0.005)
        start, memory = begin(followed)
        belief, _, _ = followed(start, memory, reading, generator=generator(2))
        slip = (belief.trajectories.pose - belief.trajectories.poses[:, 0])[:, 1]
        slips.append(float(slip.mean()))
        off.append(float((slip - 0.006).square().mean().sqrt()))
    assert off[1] < 0.5 * off[0] and abs(slips[1] - 0.006) < 0.002


def test_what_moves_unfelt_is_followed_where_that_is_sensed(model):
    belief, memory = begin(follow(model))
    reading = felt_by(0 * PUSH[0], AWAY, model)
    motion = se3.identity((len(AWAY),))
    for went, moved in ((0.0, False), (0.02, True)):
        motion[-1, 0, 3] = went
        told = replace(reading, object_motion=motion.clone())
        _, _, info = follow(model)(belief, memory, told, generator=generator(1))
        assert bool(info.moved) is moved


def test_what_goes_while_the_tool_is_lifted_leaves_the_belief_as_it_was(model):
    belief, memory = begin(follow(model))
    reading = felt_by(0 * PUSH[0], AWAY, model)
    high, motion = reading.tool_pose.clone(), se3.identity((len(AWAY),))
    high[:, 2, 3] += 0.3
    motion[-1, 0, 3] = 0.02
    told = replace(reading, tool_pose=high, object_motion=motion)
    after, _, info = follow(model)(belief, memory, told, generator=generator(1))
    assert not bool(info.moved) and torch.equal(after.log_weights, belief.log_weights)


def test_after_a_knock_the_object_is_found_by_one_action_about_where_it_was(model):
    """The block was moved by 30 mm; what the action felt leaves open how far along the face it is."""
    followed = follow(model, felt_weight=5.0, outliers=1e-4)
    belief, memory = begin(followed)
    moved = torch.tensor([-0.03, 0.0, 0.0], **DOUBLE)
    near = PUSH.clone()
    near[:, 0] -= 0.046  # up to the face, which is not pushed on
    reading = felt_by(moved, near, model)
    assert bool(reading.in_contact.any())
    after, _, _ = followed(belief, memory, reading, generator=generator(2))
    found = begun_again(followed, belief, after, MisfitSettings(), generator=generator(3))
    off, was = (abs(float(poses[:, 0, 3].mean()) + 0.03) for poses in (found.world_T_object, belief.world_T_object))
    assert off < 0.010 < was
    assert len(found.trajectories) == len(belief.trajectories) and found.trajectories.pose.isfinite().all()
    followed(found, memory, reading, generator=generator(4))  # and goes on from there
    assert begun_again(followed, belief, belief, MisfitSettings(), generator=generator(3)) is None


def test_an_object_that_is_felt_no_more_is_sought_about_where_it_was(model):
    """Two pushes go through where the block was; a third finds it where a knock may have moved it."""
    followed, gone = follow(model), torch.tensor([0.05, 0.02, 0.0], **DOUBLE)
    belief, memory = begin(followed)
    unfelt = [felt_by(gone, path, model) for path in (PUSH, PUSH + torch.tensor([0.015, 0.0, 0.0], **DOUBLE))]
    assert not any(bool(reading.in_contact.any()) for reading in unfelt)
    found, kept = sought(followed, belief, unfelt, memory, MisfitSettings(), generator=generator(4))
    away = found.world_T_object[:, :2, 3].norm(dim=-1)
    assert 0.015 < float(away.median()) < 0.1 and bool(found.log_weights.isfinite().all())
    assert not bool(kept.of_class(Semantics.SURFACE).any())  # what was seen before the knock
    # evidence stays that of all readings: rivals keep theirs
    likelier = replace(belief, trajectories=replace(belief.trajectories, log_evidence=7.5))
    again, _ = sought(followed, likelier, unfelt, memory, MisfitSettings(), generator=generator(4))
    more = again.trajectories.log_evidence - found.trajectories.log_evidence
    assert more == pytest.approx(7.5 - belief.trajectories.log_evidence)
    met = felt_by(gone, PUSH + torch.tensor([0.034, 0.0, 0.0], **DOUBLE), model)  # up to its face
    assert bool(met.in_contact.any())
    found, _, _ = followed(found, kept, met, generator=generator(5))
    assert abs(float(found.world_T_object[:, 0, 3].median()) - 0.05) < 0.01


def test_moves_go_on_once_readings_count_in_full_and_not_before(model, monkeypatch):
    followed, swept, seen = follow(model, rounds=3, felt_weight=20.0, outliers=1e-6), Moves.sweep, []

    def noted(self, given, history, *, whole, rounds=1):
        seen.append((rounds, history is given.history))
        return swept(self, given, history, whole=whole, rounds=rounds)

    belief, memory = begin(followed)
    monkeypatch.setattr(Moves, "sweep", noted)
    followed(belief, memory, felt_by(0 * PUSH[0], PUSH, model), generator=generator(3))
    assert set(seen) == {(1, False), (3, True)}


@pytest.mark.parametrize("particles", [1, 60])
def test_odd_beliefs_and_readings_give_no_nan(model, particles):
    followed = follow(model, particles=particles)
    belief, memory = begin(followed)
    only = torch.full((particles,), -torch.inf).index_fill(0, torch.tensor(0), 0.0)
    belief = replace(belief, log_weights=only)
    nothing = felt_by(0 * PUSH[0], AWAY, model)
    nothing = replace(nothing, observation=Observation.empty(), instant=torch.zeros(0, dtype=torch.long))
    for reading in (nothing, felt_by(0 * PUSH[0], PUSH, model), nothing, felt_by(0 * PUSH[0], PUSH[-1:], model)):
        belief, memory, _ = followed(belief, memory, reading, generator=generator(3))
        assert bool(torch.isfinite(belief.world_T_object).all())
        assert float(belief.log_weights.exp().sum()) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("readings", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_long_history_is_forgotten_bit_by_bit(model, readings):
    followed = follow(model, particles=8, memory=10)
    belief, memory = begin(followed)
    both = [felt_by(0 * PUSH[0], path, model) for path in (PUSH[-3:], AWAY)]
    for index in range(readings):
        belief, memory, _ = followed(belief, memory, both[index % 2], generator=generator(index))
    now = belief.trajectories
    assert len(now.history) <= 10 + 2 and now.noise.shape[1] == len(now.history) == now.poses.shape[1] - 1
    assert not len(now.starts) and bool(torch.isfinite(belief.world_T_object).all())
    whole = now.replayed(followed.model, followed.own, now.history, torch.zeros(len(now), dtype=torch.long))
    torch.testing.assert_close(whole.poses, now.poses, atol=1e-12, rtol=0)
    torch.testing.assert_close(whole.log_likelihood, now.log_likelihood, atol=1e-9, rtol=0)


def test_what_is_felt_is_told_from_the_points(model):
    reading, own = felt_by(0 * PUSH[0], PUSH, model), replace(OWN, pad_spacing_m=0.006)
    felt = felt_pads(reading, model, own)
    assert torch.equal(felt.any(-1), reading.in_contact)
    assert int(felt.sum()) == int(reading.observation.of_class(Semantics.SURFACE).sum())
    assert torch.equal(torch.cat(cut(reading, own)), torch.arange(len(PUSH)))
    none = replace(reading, in_contact=torch.zeros_like(reading.in_contact))
    assert [len(part) for part in cut(none, own)] == [len(PUSH)]


@pytest.mark.parametrize("count", [40, 400])
def test_each_cell_that_a_view_sees_through_counts_however_many_there_are(model, count):
    free = torch.tensor([-0.045, 0.0, 0.03]) + 0.004 * torch.rand(count, 3, generator=generator(2))
    surface = torch.tensor([[-0.04, 0.0, 0.03]])
    view = Observation.of(free, Semantics.FREE), Observation.of(surface, Semantics.SURFACE)
    poses, both = torch.zeros(2, 3, **DOUBLE), concatenate(list(view))
    taken = History.empty().appended(standing(view[1], poses, model, OWN))

    def worth(observation, own, taken=None):
        found = standing(observation, poses, model, own, taken)
        return [float(found.weight[found.kind == kind].sum()) for kind in (Kind.SEEN, Kind.FREE)]

    each = count * OWN.free_weight
    assert worth(both, OWN) == pytest.approx([OWN.seen_points, each])
    assert worth(both, OWN.seen_again()) == pytest.approx([OWN.seen_points, each])
    less = OWN.seen_again_points / OWN.seen_points
    assert worth(both, OWN.seen_again(), taken) == pytest.approx([less * OWN.seen_points, less * each])
    assert worth(both, replace(OWN, free_points=10.0, free_most=7)) == pytest.approx([OWN.seen_points, min(each, 10.0)])
    # what the tool went through is off by the same everywhere
    assert worth(view[0], OWN) == pytest.approx([0.0, min(each, OWN.seen_points)])


def test_of_a_later_view_as_many_points_are_kept_as_it_is_worth_of_a_first(model):
    free = torch.tensor([-0.045, 0.0, 0.03]) + 0.004 * torch.rand(900, 3, generator=generator(2))
    surface = torch.tensor([-0.04, 0.0, 0.03]) + 0.001 * torch.rand(300, 3, generator=generator(3))
    view = concatenate([Observation.of(surface, Semantics.SURFACE), Observation.of(free, Semantics.FREE)])
    own = replace(OWN.seen_again(), most=(200, 250, 60, 120), free_most=600)
    poses = torch.zeros(2, 3, **DOUBLE)
    taken = History.empty().appended(standing(view[torch.tensor([0])], poses, model, own))
    first, later = standing(view, poses, model, own), standing(view, poses, model, own, taken)
    less = own.seen_again_points / own.seen_points
    for kind, count in ((Kind.SEEN, 200), (Kind.FREE, 600)):
        assert int((first.kind == kind).sum()) == count
        assert int((later.kind == kind).sum()) == math.ceil(less * count)
        worth = [float(part.weight[part.kind == kind].sum()) for part in (first, later)]
        assert worth[1] == pytest.approx(less * worth[0])


def test_free_cells_count_once(model):
    far = Observation.of(torch.tensor([[0.5, 0.5, 0.03]]), Semantics.FREE)
    near = Observation.of(torch.tensor([[-0.045, 0.0, 0.03]]), Semantics.FREE)
    poses = torch.zeros(2, 3, **DOUBLE)
    assert standing(far, poses, model, OWN) is None
    first = standing(near, poses, model, OWN)
    assert len(first.points) == 1
    assert standing(near, poses, model, OWN, History.empty().appended(first)) is None


@pytest.mark.parametrize("count", [0, 1, 400])
def test_points_besides_the_pads_are_those_that_none_of_them_is_near(model, count):
    """Far ones and near ones of a tool that is turned, by the distance to each point of the pads."""
    own, tool = replace(OWN, pad_spacing_m=0.006), se3.from_planar(torch.tensor([0.2, -0.1, 0.7]), HEIGHT)
    random = generator(4)
    spread = torch.where(torch.rand(count, 1, generator=random) < 0.5, 0.002, 0.2)
    pads = model.reported[torch.randint(len(model.reported), (count,), generator=random)]
    there = pads + spread * torch.randn(count, 3, generator=random)
    points = Observation.of(se3.apply(tool.double(), there).float(), Semantics.SURFACE)
    back = se3.apply(se3.inverse(tool.double()), points.points.double())
    apart = (back[:, None] - model.reported).norm(dim=-1).amin(-1) >= 0.6 * 0.006
    assert count < 2 or 0.2 < float(apart.double().mean()) < 0.95
    torch.testing.assert_close(besides(points, tool, model, own).points, points.points[apart], atol=0, rtol=0)
