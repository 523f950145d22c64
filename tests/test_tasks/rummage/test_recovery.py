"""What a run goes on by after an alarm: the belief of a rival, a filter of a wider prior, or nothing new."""

from dataclasses import replace

import pytest
import torch

from rumi.belief import island_rivals, rival_filters
from rumi.belief.island_filter import IslandFilter, islands_of
from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import PoseTrajectoryBelief, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.prior import PosePrior
from rumi.belief.pushed_object import PushedObject
from rumi.belief.remarks import Remark
from rumi.belief.rival_filters import Rival
from rumi.belief.trajectory_history import History
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from rumi.tasks.rummage import lost, recovery
from rumi.tasks.rummage.fault_state import Watch
from rumi.tasks.rummage.recovery import searched_again
from sdf.grid_sdf import GridSDF
from sdf.object_model import box_model
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from tests.fixtures.box_in_space import begin, follow
from tests.fixtures.made_up_run import make_up

DOUBLE = {"dtype": torch.float64}


@pytest.fixture(scope="module")
def pose_filter() -> PoseTrajectoryFilter:
    block = GridSDF.from_sdf(Box([0.04, 0.06, 0.03]), 0.003)
    model = PushedObject.of(block, GripperShape(), height_m=0.03, resting_m=0.03, spacing_m=0.006, pad_spacing_m=0.006)
    return PoseTrajectoryFilter(FilterSettings(motion="trajectory"), Discrepancy(block, 0.1), model)


def belief_at(pose_filter: PoseTrajectoryFilter, x: float, count: int = 20) -> PoseTrajectoryBelief:
    now = Trajectories.drawn(torch.tensor([[x, 0.0, 0.0]], **DOUBLE).repeat(count, 1), History.empty(), generator(1))
    even = torch.zeros(count, **DOUBLE).log_softmax(-1)
    return pose_filter.belief_of(now, even, torch.eye(4), even.float())


def rival(pose_filter: PoseTrajectoryFilter, name: str, x: float, log_view: float) -> Rival:
    now = Trajectories.drawn(torch.tensor([[x, 0.0, 0.0]], **DOUBLE).repeat(7, 1), History.empty(), generator(2))
    own = replace(pose_filter.own, particles=7)
    return Rival(name, 0.0, pose_filter.supposing(own=own), now, torch.zeros(7, **DOUBLE).log_softmax(-1), log_view)


@pytest.mark.parametrize("name", ["another size", "camera off"])
def test_the_likeliest_rival_of_the_fault_is_gone_on_by(pose_filter, name):
    rivals = (rival(pose_filter, name, 0.1, 1.0), rival(pose_filter, name, 0.2, 2.0), rival(pose_filter, "x", 0.3, 9.0))
    now = lost._going_on(Watch(named=name, rivals=rivals), pose_filter)
    assert now.adopted == (rivals[1],) and (now.following is None) == (name == "camera off")
    if now.following is not None:
        assert now.following.own == pose_filter.own
    record = replace(make_up(2, particles=2).steps[1], belief=belief_at(pose_filter, 0.0))
    none, before = Observation.empty(), generator(3)
    belief, memory = searched_again(
        (record, record), none, pose_filter, MisfitSettings(), now, before=none, generator=before
    )
    assert memory is none and isinstance(belief, PoseTrajectoryBelief) and belief.trajectories is not None
    assert len(belief.log_weights) == len(belief.trajectories) == 20
    torch.testing.assert_close(belief.trajectories.pose[:, 0], torch.full((20,), 0.2, **DOUBLE))


def test_what_is_felt_no_more_is_sought_from_before_by_all_readings_since(pose_filter, monkeypatch):
    steps = [
        replace(step, belief=belief_at(pose_filter, float(number))) for number, step in enumerate(make_up(5).steps)
    ]
    steps[3] = replace(steps[3], remarks=(Remark("false touch", 3, "left out"),))
    asked = []
    monkeypatch.setattr(recovery, "sought", lambda *given, generator: asked.append(given) or given[1::2][:2])
    now, none = Watch(named="absent", lost=True, unfelt_since=2), Observation.empty()
    searched_again(steps, none, pose_filter, MisfitSettings(), now, before=none, generator=generator(3))
    [(_, begun, readings, memory, _)] = asked
    assert begun is steps[1].belief and memory is none
    assert all(one is step.reading for one, step in zip(readings, [steps[2], *steps[4:]], strict=True))


def test_after_odd_pushes_the_prior_of_motion_is_wide_and_stays_so(pose_filter):
    old = rival(pose_filter, "another size", 0.1, 1.0)  # of an alarm before
    now = lost._going_on(Watch(named="push model off", adopted=(old,)), pose_filter)
    assert now.following is not None and now.following.own == pose_filter.own.doubted() != pose_filter.own
    assert now.following.own.across > pose_filter.own.across and now.adopted == ()


def test_in_space_a_run_goes_on_by_all_populations_of_the_likeliest_size():
    box = box_model(spacing=0.004)
    prior = PosePrior.of((0.0, 0.0), 0.02, box.exact.bounds, ("x", "z"))
    islands = follow(box, prior, IslandFilter, unseen_particles=90, islands=3)
    usual, (other, *rest) = begin(islands, prior)[0], island_rivals.begun(islands, generator(1))
    alike = tuple(other._replace(log_view=9.0 - number) for number in range(3))
    luckier = rest[0]._replace(log_view=20.0)  # alone, and so by its draws
    now = lost._going_on(Watch(named="another size", rivals=(luckier, *rest[1:], *alike)), islands)
    assert now.adopted == alike and now.rivals is None and now.following is not None
    assert now.following.model is other.pose_filter.model
    record = replace(make_up(2, particles=2).steps[1], belief=usual)
    none = Observation.empty()
    settings, random = MisfitSettings(), generator(3)
    belief, memory = searched_again((record, record), none, islands, settings, now, before=none, generator=random)
    assert memory is none and [len(island.every) for island in islands_of(belief)] == [30, 30, 30]
    heights = torch.stack([prior.ways[way][2, 3] for way in (0, 1)]) * rival_filters.SIZES[0]
    off = (belief.world_T_object[:, 2, 3, None] - heights).abs().amin(-1)
    assert float(off.max()) < 2e-3
