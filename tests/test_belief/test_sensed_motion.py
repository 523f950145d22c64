"""A sensed motion as evidence of a trajectory: by hand, in every history operation, in the replay, in the filter."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.bootstrap_filter import BootstrapFilter
from rumi.belief.pose_trajectories import NOISE
from rumi.belief.sensed_motion import log_likelihood_of_motions, motion_of, way_sensed
from rumi.belief.trajectory_history import History, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from sdf import backend, se3
from tests.fixtures.box_in_space import begin as begin_in_space
from tests.fixtures.box_in_space import follow
from tests.fixtures.pushed_square import square, two_at_rest
from tests.fixtures.readings import make_reading

DOUBLE = {"dtype": torch.float64}
OWN = PoseTrajectorySettings(moved_m=0.001, moved_rad=0.02)


def planar(*poses) -> torch.Tensor:
    return se3.from_planar(torch.tensor(poses, **DOUBLE), 0.03)


def segment(motion=None) -> Segment:
    """A tool that goes 10 mm along x, in two instants."""
    place = torch.tensor([-0.065, 0.0, 0.0], **DOUBLE) + torch.tensor([[0.0], [0.005], [0.01]], **DOUBLE) * (
        torch.tensor([1.0, 0.0, 0.0], **DOUBLE)
    )
    none, flat = torch.zeros(0, dtype=torch.long), torch.zeros(0, **DOUBLE)
    path = torch.stack((place[:-1], place[1:]), 1)
    return Segment(path, True, flat.view(0, 3), none, none, flat, None, motion)


def near(metres: float, radians: float) -> float:
    return -3.5 * math.log1p(((metres / OWN.moved_m) ** 2 + (radians / OWN.moved_rad) ** 2) / 4.0)


@pytest.mark.parametrize("name", ["moved_m", "moved_rad"])
def test_a_sensor_that_never_errs_is_refused(name):
    with pytest.raises(ValueError, match=f"Expected {name} above 0 and finite, got 0.0"):
        PoseTrajectorySettings(**{name: 0.0})


def test_how_far_a_particle_went_otherwise_than_sensed_counts():
    """Exactly so, 1 mm beside, turned by .03, and not at all, of an object that was turned about the world's origin."""
    motion = planar([0.0, 0.0, 0.5])
    motion[:, 2, 3] = 0.0
    start = planar([0.3, 0.1, 0.2])
    there = motion @ start
    beside, turned = there.clone(), there.clone()
    beside[0, 1, 3] += 0.001
    turned[0, :3, :3] = se3.from_planar(torch.tensor([[0.0, 0.0, 0.73]], **DOUBLE))[0, :3, :3]
    ends = torch.cat((there, beside, turned, start))
    poses = torch.stack((start.expand(4, 4, 4), ends), 1)
    found = log_likelihood_of_motions(poses, motion, torch.ones(1, **DOUBLE), OWN)[:, 0]
    far = float(se3.distance(there, start)[0])
    expected = [near(0.0, 0.0), near(0.001, 0.0), near(0.0, 0.03), near(far, 0.5)]
    torch.testing.assert_close(found, torch.tensor(expected, **DOUBLE), atol=1e-6, rtol=0)
    assert not bool(log_likelihood_of_motions(poses, motion, torch.zeros(1, **DOUBLE), OWN).any())


def test_the_motion_of_some_instants_is_from_the_one_before_them():
    sensed = planar([0.0, 0.0, 0.0], [0.01, 0.0, 0.1], [0.02, 0.01, 0.3]).float()
    reading = make_reading(motion=sensed)
    torch.testing.assert_close(motion_of(reading, torch.arange(3)), sensed[2].double())
    later = motion_of(reading, torch.tensor([1, 2]))
    torch.testing.assert_close(later @ sensed[0].double(), sensed[2].double())
    last = motion_of(reading, torch.tensor([2]))
    torch.testing.assert_close(last @ sensed[1].double(), sensed[2].double())


def test_no_motion_tells_nothing():
    reading = make_reading()
    assert motion_of(reading, torch.arange(1)) is None
    assert way_sensed(reading, planar([0.3, 0.1, 0.2])) == 0.0


def test_how_far_the_object_went_is_that_of_the_object_not_of_the_world_s_origin():
    turn = planar([0.0, 0.0, 0.5])
    turn[:, 2, 3] = 0.0
    reading = make_reading(motion=turn)
    assert way_sensed(reading, planar([0.0, 0.0, 0.2])) == pytest.approx(0.0, abs=1e-9)
    assert way_sensed(reading, planar([1.0, 0.0, 0.2])) == pytest.approx(2.0 * math.sin(0.25), abs=1e-9)


def test_a_history_keeps_tempers_and_counts_motions():
    one, two = planar([0.01, 0.0, 0.1])[0], planar([0.0, 0.02, 0.0])[0]
    assert not bool(History.empty().appended(segment()).motion_power.any())
    history = History.empty().appended(segment()).appended(segment(one)).appended(segment(two)).appended(segment())
    torch.testing.assert_close(history.motion[1:3], torch.stack((one, two)))
    torch.testing.assert_close(history.motion_power, torch.tensor([0.0, 1.0, 1.0, 0.0], **DOUBLE))
    torch.testing.assert_close(history.since(2).motion_power, torch.tensor([1.0, 0.0], **DOUBLE))
    assert not bool(history.worth().any()) and not bool(history.unsensed().motion_power.any())
    assert history.segment(0).motion is None and history.segment(3).motion is None
    torch.testing.assert_close(history.segment(2).motion, two)
    short = History.empty().appended(segment(one)).tempered(0.25)
    torch.testing.assert_close(short.motion_power, torch.tensor([0.25], **DOUBLE))
    torch.testing.assert_close(short.last().motion, one[None])


def test_a_replay_adds_motions_from_its_first_segment_on_once():
    history = History.empty().appended(segment()).appended(segment(planar([0.002, 0.001, 0.03])[0]))
    block, given = square(), two_at_rest(history)
    from_start = torch.zeros(2, dtype=torch.long)
    with backend.force("torch"):
        whole = given.replayed(block, OWN, history, from_start)
        again = whole.replayed(block, OWN, history, torch.tensor([1, 2]))
        untold = given.replayed(block, OWN, history.unsensed(), from_start)
    told = log_likelihood_of_motions(block.world_T_object(whole.poses), history.motion, history.motion_power, OWN)
    torch.testing.assert_close(whole.log_likelihood, untold.log_likelihood + told)
    assert bool((told[:, 1] < 0).all()) and not bool(told[:, 0].any())
    torch.testing.assert_close(again.log_likelihood, whole.log_likelihood)


def test_a_jump_before_a_segment_is_part_of_its_motion(box, prior):
    """One particle went 50 mm by a jump, one by the push, and one not at all."""
    followed = follow(box, prior, BootstrapFilter, unseen_particles=3, islands=1, moved_m=0.001)
    belief, _ = begin_in_space(followed, prior)
    now = belief.every
    first, went = now.pose.clone(), torch.tensor([0.05, 0.05, 0.0], **DOUBLE)
    motion = torch.eye(4, **DOUBLE)
    motion[0, 3] = 0.05
    still = Segment(torch.zeros(1, 2, 4, **DOUBLE), True, first[:0, :3], *(torch.zeros(0).long(),) * 2, first[:0, 0])
    told = still._replace(motion=motion)
    last = first.clone()
    last[:, 0] += went
    jumped = first.clone()
    jumped[0, 0] += 0.05
    after = replace(
        now.lengthened(torch.zeros(3, 1, NOISE, **DOUBLE), now.history.appended(told)),
        poses=torch.stack((jumped, last), 1),
    )
    poses = torch.stack([followed.model.world_T_object(part) for part in (jumped, last)], 1)
    sensed = motion[None], torch.ones(1, **DOUBLE), followed.own
    scored = replace(after, log_likelihood=log_likelihood_of_motions(poses, *sensed))
    found = scored.moved_from(first, followed.model, followed.own).log_likelihood[:, -1]
    assert float(scored.log_likelihood[0, -1]) < -10.0
    torch.testing.assert_close(found[:2], torch.zeros(2, **DOUBLE), atol=1e-6, rtol=0)
    assert float(found[2]) < -10.0
    none = scored.moved_from(jumped, followed.model, followed.own)
    assert torch.equal(none.log_likelihood, scored.log_likelihood)  # of none that jumped
