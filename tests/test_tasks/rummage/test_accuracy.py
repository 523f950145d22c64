"""Widths and systematic errors of trajectories, by what robot and object are stated to be off by."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.systematic_errors import NUMBERS, SystematicErrors
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.errors import UsageError
from rumi.planning.next_touch import NextTouchPolicy
from rumi.planning.rummaging import RummagingPolicy
from rumi.runs.json_settings import changed
from rumi.seeding import generator
from rumi.sim.error_settings import PadErrors
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.settings import SimSettings
from rumi.sim.view_faults import miscalibration, taken_pose
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.entry import ENTRIES
from rumi.tasks.rummage.motions import planned, with_eye
from rumi.tasks.rummage.scene_spec import CameraSpec
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import from_dict, preset, to_dict
from rumi.tasks.rummage.stated_errors import as_accurate, as_inexact
from sdf import se3

OWN = PoseTrajectorySettings()
BOUNDS = torch.tensor([[-0.05, -0.03, 0.0], [0.05, 0.03, 0.1]])


def test_an_exact_robot_changes_no_width():
    assert as_accurate(OWN, SimSettings()) == replace(OWN, height_off=(0.0, 0.0))
    assert as_inexact(OWN, SimSettings(), BOUNDS) == OWN and not OWN.systematic


def test_widths_add_in_quadrature():
    simulator = SimSettings(tool_off_m=0.002)
    simulator = replace(simulator, build=replace(simulator.build, worn_m=0.003, scale=0.02))
    simulator = replace(simulator, sensors=replace(simulator.sensors, calibration_m=0.006))
    found = as_accurate(OWN, simulator)
    camera, tool = math.sqrt(0.006**2 / 3.0 + 3.0e-6), math.sqrt(0.002**2 / 2.0 + 3.0e-6)
    assert found.seen_sd_m == pytest.approx(math.hypot(OWN.seen_sd_m, camera))
    assert found.free_sd_m == pytest.approx(math.hypot(OWN.free_sd_m, camera))
    assert found.felt_sd_m == pytest.approx(math.hypot(OWN.felt_sd_m, tool))
    # a logistic border of width s has a variance of (pi s)^2 / 3
    variance = (math.pi * OWN.pad_slope_m) ** 2 / 3.0 + tool**2
    assert (math.pi * found.pad_slope_m) ** 2 / 3.0 == pytest.approx(variance)
    assert found.height_off == (math.sqrt(3.0e-6), 0.02 / math.sqrt(3.0))
    assert replace(found, **{name: getattr(OWN, name) for name in WIDTHS}) == OWN
    assert as_accurate(replace(OWN, height_off=(0.0, 0.0)), simulator).height_off == (0.0, 0.0)


WIDTHS = ("seen_sd_m", "free_sd_m", "felt_sd_m", "pad_slope_m", "height_off")


def test_systematic_errors_have_the_deviations_of_what_is_drawn():
    """An offset in a random direction of the plane, wear from none to the most, a size about the model's."""
    simulator = SimSettings(tool_off_m=0.002, tool_off_rad=0.01)
    simulator = replace(simulator, build=replace(simulator.build, worn_m=0.003, scale=0.02, com_m=0.01))
    found = as_inexact(OWN, simulator, BOUNDS)
    assert found.systematic and found.tool_off_rad == 0.01
    assert found.tool_off_m == pytest.approx(0.002 * math.sqrt(0.5))
    assert found.worn[0] == pytest.approx(0.0015)
    assert found.worn[1] == pytest.approx(0.003 / math.sqrt(12.0))
    assert found.size_off == pytest.approx(math.hypot(0.02, 0.003 / 0.06) / math.sqrt(3.0))
    assert found.centre_m == pytest.approx(math.hypot(OWN.centre_m, 0.01 / math.sqrt(5.0)))
    assert found.view_off_m == 0.0 and found.seen_sd_m == OWN.seen_sd_m
    assert found.across > OWN.across and found.least_m > OWN.least_m


@pytest.mark.parametrize("about", ["workspace", "sensor"])
def test_a_view_is_off_as_a_miscalibrated_camera_has_it(about):
    """Covariance of where cameras of many runs have an object, wherever it stands."""
    camera, height_m = CameraSpec(), 0.1
    sensors = SensorSettings(calibration_m=0.002, calibration_rad=math.radians(1.0), turned_about=about)
    simulator = replace(SimSettings(), sensors=sensors)
    own = as_inexact(replace(OWN, eye_m=camera.position), simulator, BOUNDS, camera)
    eye, random = se3.make(torch.eye(3).double(), torch.tensor(camera.position).double()), generator(3)
    errors = SystematicErrors.of(own, torch.randn(20000, NUMBERS, generator=random, dtype=torch.float64))
    offs = torch.stack([miscalibration(sensors, random) for _ in range(4000)]).double()
    for place in ((0.45, 0.3), (0.3, -0.1), (0.46, 0.0)):
        taken = torch.stack([taken_pose(eye, off, sensors, camera.target) for off in offs])
        true = torch.tensor((*place, 0.5 * height_m), dtype=torch.float64)
        seen = se3.apply(taken @ se3.inverse(eye), true[None, None])[:, 0, :2]
        pose = torch.tensor((*place, 0.0), dtype=torch.float64).expand(20000, 3)
        found, expected = torch.cov(errors.seen(pose)[:, :2].T), torch.cov(seen.T)
        assert found[0, 1].item() == pytest.approx(expected[0, 1].item(), abs=0.06 * float(expected.trace()))
        torch.testing.assert_close(found.diag(), expected.diag(), rtol=0.1, atol=1e-8)
    assert as_inexact(OWN, simulator, BOUNDS).view_off_m == 0.0  # nothing is seen
    unknown = as_inexact(OWN, simulator, BOUNDS, camera)
    off_m = math.hypot(0.002, 0.17 * math.radians(1.0)) / math.sqrt(3.0)
    assert unknown.view_off_rad == 0.0 and unknown.view_off_m == pytest.approx(off_m)
    told = as_inexact(replace(OWN, view_about_m=(1.0, 0.2)), simulator, BOUNDS, camera)
    assert told.view_about_m == (1.0, 0.2) and told.view_off_rad == own.view_off_rad
    with pytest.raises(UsageError, match="about which point"):
        as_inexact(replace(OWN, view_off_rad=0.01), simulator, BOUNDS, camera)
    with pytest.raises(ValueError, match="two finite numbers"):
        replace(OWN, view_about_m=(math.nan, 0.0))


def test_pads_that_miss_and_feel_falsely_are_believed_to():
    simulator = SimSettings(pads=PadErrors(dead=0.1, missed=0.05, false=0.001))
    found = as_inexact(OWN, simulator, BOUNDS)
    assert (found.dead, found.missed, found.false) == (0.1, 0.05, 0.001)


@pytest.mark.usefixtures("at_home")
def test_the_filter_of_a_run_knows_how_far_it_may_be_off(cache):
    settings = preset(task="mug", conditions="lab")
    with build(settings, cache_dir=cache) as (_, agent):
        camera = find_task("mug").camera
        assert camera is not None
        mugs = OWN.for_mugs()
        own = replace(mugs, eye_m=camera.position)
        found = as_inexact(own, settings.simulator, agent.model.sdf.bounds, camera)
        assert agent.filter.settings.trajectories == found and found.systematic
        noise_m = settings.simulator.sensors.depth_noise_m
        assert found.seen_sd_m == pytest.approx(math.hypot(OWN.seen_sd_m, noise_m)) and noise_m > 0
        # nobody knows where the camera is
        nearer = as_inexact(mugs, settings.simulator, agent.model.sdf.bounds, camera)
        assert nearer.seen_sd_m == OWN.seen_sd_m and nearer.view_off_m > found.view_off_m
        assert found.moved_m == pytest.approx(math.hypot(OWN.moved_m, settings.simulator.sensors.motion_noise_m))
        assert found.moved_m > OWN.moved_m and found.moved_rad > OWN.moved_rad
    settings = replace(settings, filter=replace(settings.filter, stated_errors="noise"))
    with build(settings, cache_dir=cache) as (_, agent):
        assert agent.filter.settings.trajectories == as_accurate(own, settings.simulator) != own


@pytest.mark.usefixtures("at_home")
@pytest.mark.parametrize("eye_m", [None, (0.1, -0.2, 0.5)])
def test_a_replay_knows_the_camera_that_its_run_knew(cache, eye_m):
    camera = find_task("mug").camera
    assert camera is not None
    settings = changed(preset(task="mug", conditions="lab"), {"filter.trajectories.eye_m": eye_m})
    with build(settings, cache_dir=cache) as (_, agent):
        known = agent.filter.settings.trajectories
    assert known.eye_m == (camera.position if eye_m is None else eye_m)
    assert ENTRIES["mug"].agent(settings, cache_dir=cache).filter.settings.trajectories == known


def test_no_camera_no_eye():
    for task in ("drill", "drawn-shelf-box"):  # no camera sees them, and they are followed in space
        settings = preset(task=task).filter
        assert with_eye(find_task(task), settings) == settings


@pytest.mark.usefixtures("at_home")
def test_actions_are_guarded_where_each_particle_has_its_own_motion(all_in_reach):
    for task, conditions, motion in itertools.product(("mug", "box"), ("lab", "ideal"), ("auto", "measured")):
        settings = preset(task=task, conditions=conditions, **{"filter.motion": motion})
        own = conditions == "lab" or (task == "box" and motion == "auto")  # else it is measured
        with build(settings, cache_dir=all_in_reach) as (world, agent):
            assert world.settings.guarded == ("always" if own else "never")
            known = task == "box" and own  # plans know of it in space
            planner = planned(find_task(task), settings)
            assert isinstance(agent.policy, NextTouchPolicy if known else RummagingPolicy)
            assert planner.push.guarded == known and bool(planner.sensed_here) == known
            assert (planner.push_scale, planner.reachability_scale) == ((1.0, 0.5) if known else (None, None))
            assert planner.information.sharpness == (300.0 if known else None)
            assert agent.stop_rule.most_nll == (agent.nll_threshold if known else None)
            assert agent.filter.settings.trajectories.fresh_m == (0.003 if known else None)
    asked = replace(settings, simulator=replace(settings.simulator, guarded="always"))
    with build(asked, cache_dir=all_in_reach) as (world, _):
        assert world.settings.guarded == "always"


@pytest.mark.usefixtures("at_home")
def test_what_is_asked_of_plans_is_kept_where_actions_are_guarded(all_in_reach):
    settings = preset(task="drill", **{"planner.push_scale": 0.0, "planner.reachability_scale": 2.0})
    settings = changed(settings, {"planner.next_touch": False})
    settings = changed(settings, {"planner.sensed_here": False, "filter.trajectories.fresh_m": 0.0})
    settings = from_dict(to_dict(changed(settings, {"planner.information.sharpness": 100.0})) | {"made_with": {}})
    with build(settings, cache_dir=all_in_reach) as (_, agent):
        planner = agent.policy.settings
        assert (planner.push_scale, planner.reachability_scale, planner.sensed_here) == (0.0, 2.0, False)
        assert planner.information.sharpness == 100.0
        assert planner.push.guarded and agent.filter.settings.trajectories.fresh_m == 0.0
    with build(changed(settings, {"simulator.guarded": "never"}), cache_dir=all_in_reach) as (_, agent):
        assert not agent.policy.settings.push.guarded


def test_guarded_moves_need_pads_that_feel_points(cache):
    settings = preset(task="mug")
    own = replace(settings.simulator, guarded="always", sensors=replace(settings.simulator.sensors, kind="camera"))
    with pytest.raises(UsageError, match="guarded always: pads that feel points"):
        build(replace(settings, simulator=own), cache_dir=cache)


def test_runs_on_record_keep_what_their_errors_counted_as():
    made = to_dict(preset(task="mug"))
    del made["filter"]["stated_errors"], made["filter"]["motion"]
    for name in ("exchanged", "evidence_power", "height_off"):
        del made["filter"]["trajectories"][name]
    before = from_dict(made | {"made_with": {}}).filter
    assert before.stated_errors == "noise" and before.motion == "measured"
    assert before.trajectories.exchanged == 0.0 and before.trajectories.evidence_power == 0.0
    assert before.trajectories.height_off == (0.0, 0.0)
    assert from_dict(made).filter.stated_errors == "auto"
    made["filter"]["trajectories"]["exchanged"] = None  # said, but not how islands are weighed
    assert from_dict(made | {"made_with": {}}).filter.trajectories.evidence_power == 0.0
    for task, exchanged in (("mug", 0.0), ("box", 0.0), ("drill", 0.05), ("drill-1", 0.05)):
        assert from_dict(made | {"made_with": {}, "task": task}).filter.trajectories.exchanged == exchanged


def test_runs_on_record_keep_how_mugs_were_pushed():
    made = to_dict(preset(task="mug"))
    for name in ("rim", "push_m"):
        del made["filter"]["trajectories"][name]
    own = from_dict(made | {"made_with": {}}).filter.trajectories
    assert own.for_mugs() == own and (own.rim, own.push_m) == (False, 0.0)
    assert from_dict(made).filter.trajectories.for_mugs() != own


@pytest.mark.parametrize(("task", "worth"), [("mug", 25.0), ("drawn-shelf-mug", 8.0)])
def test_runs_on_record_keep_what_their_views_counted_as(task, worth):
    made = to_dict(preset(task=task))
    for name in ("free_points", "free_most", "looks_again"):
        del made["filter"]["trajectories"][name]
    own = from_dict(made | {"made_with": {}}).filter.trajectories
    assert (own.seen_points, own.free_points, own.free_most) == (worth, worth, 250)
    assert from_dict(made).filter.trajectories == preset(task=task).filter.trajectories


def test_runs_on_record_keep_one_motion_where_a_camera_looked_again():
    for task, motion in (("shelf-mug", "corrected"), ("drawn-shelf-mug", "corrected"), ("mug", None)):
        made = to_dict(preset(task=task))
        del made["filter"]["trajectories"]["seen_again_points"]
        assert from_dict(made | {"made_with": {}}).filter.unmeasured == motion
        assert from_dict(made).filter.unmeasured is None
    asked = to_dict(preset(task="shelf-mug", **{"filter.unmeasured": "estimated"}))
    del asked["filter"]["trajectories"]["seen_again_points"]
    assert from_dict(asked | {"made_with": {}}).filter.unmeasured == "estimated"


@pytest.mark.usefixtures("at_home")
@pytest.mark.parametrize(
    "errors", [{"stated_errors": "systematic"}, {"trajectories": replace(OWN, tool_off_m=0.001)}], ids=["all", "one"]
)
@pytest.mark.parametrize("task", ["box", "drawn-shelf-mug"])
def test_systematic_errors_are_refused_where_no_particle_has_its_own(cache, errors, task):
    settings = preset(task=task, conditions="lab")
    settings = replace(settings, filter=replace(settings.filter, unmeasured="corrected", **errors))
    with pytest.raises(UsageError, match="no other particles have errors of their own"):
        build(settings, cache_dir=cache)
