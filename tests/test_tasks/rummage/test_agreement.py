"""Copies of a belief that is sure: where they have its best pose wrong, the run does not stop."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief import rival_filters
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import PoseTrajectoryBelief, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.remarks import Remark
from rumi.belief.rival_filters import NO_FAULT, Rival
from rumi.belief.trajectory_history import History
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from rumi.tasks.rummage.agreement import asked
from rumi.tasks.rummage.fault_state import Watch
from rumi.tasks.rummage.settings import from_dict
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sdf.symmetry import Symmetries
from sensors.discrepancy import Discrepancy
from tests.fixtures.made_up_run import make_up

DOUBLE = {"dtype": torch.float64}
RECORDS = make_up(3, particles=2).steps


@pytest.fixture(scope="module")
def pose_filter() -> PoseTrajectoryFilter:
    block = GridSDF.from_sdf(Box([0.04, 0.06, 0.03]), 0.003)
    model = PushedObject.of(block, GripperShape(), height_m=0.03, resting_m=0.03, spacing_m=0.006, pad_spacing_m=0.006)
    return PoseTrajectoryFilter(FilterSettings(motion="trajectory"), Discrepancy(block, 0.1), model)


def particles(x: float, count: int = 8) -> Trajectories:
    return Trajectories.drawn(torch.tensor([[x, 0.0, 0.0]], **DOUBLE).repeat(count, 1), History.empty(), generator(1))


def belief_at(pose_filter: PoseTrajectoryFilter, x: float) -> PoseTrajectoryBelief:
    even = torch.zeros(8, **DOUBLE).log_softmax(-1)
    return pose_filter.belief_of(particles(x), even, torch.eye(4), even.float())


def history_of(pose_filter: PoseTrajectoryFilter, converged: bool):
    belief = belief_at(pose_filter, 0.1)
    return tuple(replace(record, belief=belief, converged=converged, remarks=()) for record in RECORDS[:3])


def ask(pose_filter, now=None, *, history=None, copies=3):
    return asked(
        now or Watch(),
        history or history_of(pose_filter, converged=True),
        pose_filter,
        Symmetries.none(),
        copies=copies,
        within_m=0.005,
        within_rad=0.17,
        generator=generator(5),
    )


@pytest.fixture
def elsewhere(pose_filter, monkeypatch):
    """Puts copies where they are asked to be, and notes the readings that they take in."""
    taken = []

    def put(*places):
        even = torch.zeros(8, **DOUBLE).log_softmax(-1)
        some = tuple(Rival(NO_FAULT, 0.0, pose_filter, particles(x), even, 0.0) for x in places)
        monkeypatch.setattr(rival_filters, "copied", lambda *_: some)
        monkeypatch.setattr(rival_filters, "followed", lambda rivals, reading, _: (taken.append(reading), rivals)[1])
        return taken

    return put


@pytest.mark.parametrize(
    ("places", "agreed", "stops"), [((0.1, 0.101, 0.1), 1.0, True), ((0.1, 0.12, 0.1), 0.75, False)]
)
def test_a_sure_belief_that_its_copies_do_not_share_is_no_time_to_stop(pose_filter, elsewhere, places, agreed, stops):
    taken = elsewhere(*places)
    now = ask(pose_filter)
    assert now.agreed == pytest.approx(agreed) and (now.doubt() is None) == stops
    assert stops or "probability 0.75 alone" in (now.doubt() or "")
    assert now.copies is not None and len(now.copies) == 3
    assert taken == [record.reading for record in RECORDS[1:3]]


def test_copies_are_asked_of_once_it_is_sure_and_follow_from_then_on(pose_filter, elsewhere):
    taken = elsewhere(0.1, 0.12, 0.12)
    unsure = history_of(pose_filter, converged=False)
    now = ask(pose_filter, history=unsure)
    assert now.copies is None and now.agreed == 1.0 and not taken
    now = ask(pose_filter, history=history_of(pose_filter, converged=True)[:2])
    again = ask(pose_filter, now, history=unsure)  # by the last reading alone
    assert again.copies is now.copies and again.agreed == pytest.approx(0.5)
    assert taken == [record.reading for record in RECORDS[1:3]]


def test_a_belief_that_was_begun_anew_has_copies_of_its_own_and_takes_in_no_false_touch(pose_filter, elsewhere):
    taken = elsewhere(0.12, 0.12, 0.12)
    old = ask(pose_filter)
    elsewhere(0.1, 0.1, 0.1)
    now = ask(pose_filter, replace(old, begun=1))
    assert now.copies is not old.copies and now.copied == 1 and now.agreed == 1.0
    assert len(taken) == 2 + 1
    first, second, last = history_of(pose_filter, converged=True)
    ask(pose_filter, history=(first, replace(second, remarks=(Remark("false touch", 1, ""),)), last))
    assert len(taken) == 2 + 1 + 1


def test_none_are_asked_where_there_are_none_or_the_run_is_lost(pose_filter, elsewhere):
    elsewhere(0.2, 0.2, 0.2)
    assert ask(pose_filter, copies=0).agreed == ask(pose_filter, Watch(lost=True)).agreed == 1.0
    assert ask(pose_filter).agreed == 0.25


def test_copies_begin_at_a_belief_s_particles_by_draws_of_their_own(pose_filter):
    start = torch.stack((torch.arange(9.0), torch.zeros(9), torch.zeros(9)), -1).double()
    now = Trajectories.drawn(start, History.empty(), generator(1))
    some = rival_filters.copied(pose_filter, now, 3, generator(2))
    assert len(some) == 3 and all(len(rival.now) == pose_filter.own.particles for rival in some)
    assert all(set(rival.now.pose[:, 0].tolist()) <= set(range(9)) for rival in some)
    assert not some[0].now.pose.equal(some[1].now.pose) and some[0].log_evidence == 0.0
    assert all(math.isclose(float(rival.log_weights.exp().sum()), 1.0) for rival in some)


def test_runs_on_record_that_do_not_say_otherwise_asked_none():
    assert from_dict({"made_with": {}, "filter": {}}).stop.copies == 0
    assert from_dict({"filter": {}}).stop.copies == 3
