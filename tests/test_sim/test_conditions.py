"""Conditions: their numbers, and that each error is as large and as frequent as it says."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.sim.conditions import GROUPS, MEMBERS, bundle, departures, put_back, under, value_of, words
from rumi.sim.error_settings import BuildSpread, PadErrors, ViewErrors
from rumi.sim.object_build import Build
from rumi.sim.pad_faults import PadFaults
from rumi.sim.reshaped import worn
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.settings import PhysicsSettings, SimSettings
from rumi.sim.tool_offset import ToolOffset
from rumi.sim.view_faults import ViewFaults, grown
from rumi.sim.world import World
from rumi.tasks.rummage.build import make_task
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.scenes import SCENES, large_handled_mug, make_tool
from sdf import se3
from sdf.drill import Drill
from sdf.primitives import Box, Sphere
from sensors.semantics import Semantics

sim = pytest.mark.sim
PADS = GripperShape().pad_shell(0.0025).float()
AHEAD = torch.tensor([1.0, 0.0, 0.1])
SPEC = replace(SCENES["mug-0"], start=(0.40, 0.0, 0.3))


def most_by_chance(rate, count, alpha=1e-6):
    """Least number of events that so many trials of a rate exceed with a chance of at most alpha: an exact bound."""
    log_p, log_q = math.log(rate), math.log1p(-rate)
    k = np.arange(count + 1)
    lgamma = np.vectorize(math.lgamma)
    log_pmf = math.lgamma(count + 1) - lgamma(k + 1) - lgamma(count - k + 1) + k * log_p + (count - k) * log_q
    tail = np.cumsum(np.exp(log_pmf)[::-1])[::-1]  # of at least k
    return int(k[np.argmax(tail <= alpha)])


def least_by_chance(rate, count, alpha=1e-6):
    return count - most_by_chance(1.0 - rate, count, alpha)


# ---- the bundles


def test_ideal_is_what_the_simulator_starts_from():
    usual = SimSettings()
    assert bundle("ideal") == {member.name: value_of(usual, member.name) for member in MEMBERS}
    assert under(usual, "ideal") == usual and departures(usual, "ideal") == {}


@pytest.mark.parametrize("conditions", ["lab", "harsh"])
def test_a_bundle_sets_all_its_members_and_each_group_goes_back_alone(conditions):
    found = under(SimSettings(free_spacing_m=0.007), conditions)
    assert departures(found, conditions) == {} and found.free_spacing_m == 0.007
    back = found
    for group in GROUPS:
        one = put_back(found, group)
        own = {member.name for member in MEMBERS if member.group == group}
        assert departures(one, "ideal").keys().isdisjoint(own) and departures(one, conditions).keys() <= own
        back = put_back(back, group)
    assert back == SimSettings(free_spacing_m=0.007)


def test_harsh_is_nowhere_milder_than_lab():
    for member in MEMBERS:
        if not isinstance(member.lab, bool | str):
            assert member.ideal <= member.lab <= member.harsh
        assert member.lab == member.harsh or not isinstance(member.lab, bool | str)


def test_words_say_what_differs():
    lab = under(SimSettings(), "lab")
    assert words(lab, "lab") == "lab"
    assert words(replace(lab, measures_motion=True), "lab") == "lab, but measures_motion True"
    with pytest.raises(UsageError, match="ideal, lab, harsh"):
        bundle("outdoors")


# ---- pads


def test_a_dead_zone_is_as_large_as_said_and_never_feels():
    errors = PadErrors(dead=0.1, false=0.2)
    pads = PadFaults(errors, PADS, seed=3)
    assert int(pads.dead.sum()) == round(0.1 * len(PADS))
    every = torch.ones(500, len(PADS), dtype=torch.bool)
    for touched in (every, ~every):
        assert not bool(pads.felt(touched, pads.drawn(500))[:, pads.dead].any())
    honest = PadFaults(replace(errors, false=0.0), PADS, seed=3)
    assert bool(honest.felt(every, honest.drawn(500))[:, ~pads.dead].all())
    assert not torch.equal(pads.dead, PadFaults(errors, PADS, seed=4).dead)


def test_misses_and_false_touches_come_at_their_rates():
    count, errors = 20000, PadErrors(missed=0.05, false=0.02)
    first = PADS[:, 1] > 0
    pads = PadFaults(errors, PADS, seed=0)
    felt = pads.felt(torch.zeros(count, len(PADS), dtype=torch.bool), pads.drawn(count))
    false = int(felt[:, first].any(-1).sum() + felt[:, ~first].any(-1).sum())
    assert least_by_chance(0.02, 2 * count) <= false <= most_by_chance(0.02, 2 * count)
    sizes = felt.sum(-1)
    assert 0 < int(sizes.max()) <= 24
    touched = torch.zeros(count, len(PADS), dtype=torch.bool)
    touched[:, first] = True
    silent = PadFaults(replace(errors, false=0.0), PADS, seed=1)
    silent = ~silent.felt(touched, silent.drawn(count)).any(-1)
    assert least_by_chance(0.05, count) <= int(silent.sum()) <= most_by_chance(0.05, count)


# ---- the view


def test_a_mask_is_eroded_and_grown_by_whole_pixels():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[5:15, 8:20] = True
    smaller, larger = grown(mask, -2), grown(mask, 2)
    assert smaller.nonzero().amin(0).tolist() == [7, 10] and smaller.nonzero().amax(0).tolist() == [12, 17]
    assert larger.nonzero().amin(0).tolist() == [3, 6] and larger.nonzero().amax(0).tolist() == [16, 21]
    assert int(smaller.sum()) == 6 * 8 and int(larger.sum()) == 14 * 16 and grown(mask, 0) is mask
    assert bool(grown(torch.ones(9, 9, dtype=torch.bool), -3).all())  # what lies beyond the image is not known


def test_holes_noise_and_calibration_are_as_large_as_said():
    sensors = SensorSettings(depth_noise_m=0.002, calibration_m=0.003, calibration_rad=0.02)
    faults = ViewFaults.drawn(ViewErrors(eye_m=0.05, holes=0.1, mask_px=2), sensors, seed=0)
    depth = faults.noisy(torch.ones(200, 300))
    holes = int((depth == 0).sum())
    assert least_by_chance(0.1, 60000) <= holes <= most_by_chance(0.1, 60000)
    assert float(depth[depth > 0].std()) == pytest.approx(0.002, rel=0.02)
    shift, turn = faults.off[:3, 3].norm(), se3.distance(faults.off, se3.identity())[1]
    assert float(shift) == pytest.approx(0.003, rel=0.02) and float(turn) == pytest.approx(0.02, rel=1e-3)
    assert 0.0 < float(faults.eye_m.abs().max()) <= 0.05
    mask = torch.zeros(50, 50, dtype=torch.bool)
    mask[20:30, 20:30] = True
    assert {int(faults.masked(mask).sum()) for _ in range(60)} == {36, 64, 100, 144, 196}


# ---- tool and object


@pytest.mark.parametrize("spatial", [False, True])
def test_a_tools_offset_is_constant_in_its_frame_and_undone(spatial):
    offset = ToolOffset.drawn(0.002, 0.01, spatial=spatial, seed=5)
    tool = make_tool(SCENES["box-0" if spatial else "mug-0"], free_flying=True)
    q = torch.rand(40, 4 if spatial else 3, generator=torch.Generator().manual_seed(0)).double()
    taken = offset.taken(q)
    torch.testing.assert_close(offset.true(taken), q, rtol=0, atol=1e-12)
    own = se3.inverse(tool.pose(q)) @ tool.pose(taken)
    shift, turn = se3.distance(own, se3.identity().double())
    assert float((shift - 0.002).abs().max()) < 1e-6 and float((turn - 0.01).abs().max()) < 1e-6
    assert float((own - own[:1]).abs().max()) < 1e-6
    none = ToolOffset.drawn(0.0, 0.0, spatial=spatial, seed=5)
    assert none.none and none.taken(q) is q and none.true(q) is q


@pytest.mark.parametrize(
    ("shape", "lowered"), [(Box([0.03, 0.08, 0.1]), 0.0), (large_handled_mug().exact, 0.001), (Drill(), 0.001)]
)
def test_wear_moves_the_surface_by_the_stated_amount(shape, lowered):
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0))
    low, high = shape.bounds
    points = low - 0.01 + points * (high - low + 0.02)
    points = points[shape.distance(points).abs() < 0.004]
    moved = worn(shape, 0.001).distance(points - torch.tensor([0.0, 0.0, lowered])) - shape.distance(points)
    assert len(points) > 200 and float((moved > 0.0009).float().mean()) > 0.95
    assert float(moved.min()) > -1e-6 and float(moved.max()) < 0.0021
    assert float(moved.median()) == pytest.approx(0.001, abs=2e-5)


def test_a_build_stays_within_its_spread_and_is_the_seeds_own():
    spread = BuildSpread(mass=0.2, friction=0.3, com_m=0.005, scale=0.01, worn_m=0.001)
    builds = [Build.drawn(spread, seed) for seed in range(300)]
    for name, width in (("mass", 0.2), ("friction", 0.3), ("scale", 0.01)):
        values = [getattr(one, name) - 1.0 for one in builds]
        assert -width <= min(values) < -0.9 * width and 0.9 * width < max(values) <= width
    assert min(one.worn_m for one in builds) >= 0.0 and 0.0009 < max(one.worn_m for one in builds) <= 0.001
    assert 0.0045 < max(float(one.com_m.norm()) for one in builds) <= 0.005
    assert Build.drawn(spread, 3).mass == builds[3].mass
    ideal = Build.drawn(BuildSpread(), 0)
    shape = large_handled_mug().exact
    assert ideal.shape(shape) is shape and ideal.mass == ideal.friction == ideal.scale == 1.0
    with pytest.raises(UsageError, match="worn"):
        Build.thinnest(spread).shape(Box([0.03, 0.0005, 0.1]))
    with pytest.raises(UsageError, match="a box, a mug"):
        Build.thinnest(spread).shape(Sphere(0.1))


# ---- the simulated task


def task_of(arm_tool, mug, **changes):
    return make_task(SPEC, replace(SimSettings(), **changes), tool=arm_tool, model=mug)


def pushed(task):
    """The reading of an action at whose end the mug is touched."""
    for _ in range(4):
        reading = task.step(AHEAD).reading
        if bool(reading.in_contact[-1]):
            return reading
    raise AssertionError("the mug was not touched")


@sim
def test_the_object_that_is_there_is_the_one_that_was_drawn(arm_tool, mug):
    task = task_of(arm_tool, mug, build=BuildSpread(0.2, 0.2, 0.005, 0.01, 0.001))
    mass = float(task.world.model.body("object").mass[0])
    task.reset(7)
    build, body = Build.drawn(task.settings.build, 7), task.world.model.body("object")
    assert float(body.mass[0]) == pytest.approx(mass * build.mass)
    assert task.world.physics.friction == pytest.approx(SPEC.physics.friction * build.friction)
    reading = pushed(task)
    felt = reading.observation.of_class(Semantics.SURFACE)
    poses = se3.inverse(task.world.world_T_object()).float()[None].expand(int(felt.sum()), 4, 4)
    last = reading.instant[felt] == 19
    points = se3.apply(poses[0], reading.observation.points[felt][last])
    assert int(last.sum()) > 3 and float(build.shape(mug.exact).distance(points).abs().max()) < 0.0032


@sim
@pytest.mark.parametrize(
    "shape", [Box([0.03, 0.08, 0.1]), large_handled_mug().exact, Drill()], ids=["box", "mug", "drill"]
)
def test_a_centre_of_mass_off_its_place_leaves_mass_and_inertia(shape):
    plain, off = (
        World(shape, GripperShape(), 0.045, 0.004, PhysicsSettings(com_m=com)).model.body("object")
        for com in ((0.0, 0.0, 0.0), (0.004, -0.002, 0.001))
    )
    np.testing.assert_allclose(off.ipos - plain.ipos, (0.004, -0.002, 0.001), atol=1e-12)
    np.testing.assert_allclose(off.iquat, plain.iquat, atol=1e-12)
    np.testing.assert_allclose(off.inertia, plain.inertia, rtol=1e-12)
    assert float(off.mass[0]) == float(plain.mass[0])


@sim
def test_a_late_stop_goes_on_at_the_actions_speed(arm_tool, mug):
    """0.1 s of an action of 1 s: a tenth of its way more, which is not told as refused."""
    away = torch.tensor([0.0, -0.5, 0.0])
    ends = []
    for late in (0.0, 0.1):
        task = task_of(arm_tool, mug, stops_late_s=late)
        before = task.reset(0).reading.configuration
        reading = task.step(away).reading
        assert float(reading.clipped) < 1e-6
        ends.append(float((reading.configuration - before)[1]))
    assert ends[0] == pytest.approx(-0.04, abs=1e-4) and ends[1] == pytest.approx(-0.044, abs=1e-4)


@sim
def test_a_wrong_tool_pose_moves_all_that_the_tool_reports(arm_tool, mug):
    task = task_of(arm_tool, mug, tool_off_m=0.004, tool_off_rad=0.02)
    task.reset(1)
    reading = pushed(task)
    true = task.tool.pose(task.world.configuration().float())
    shift, turn = se3.distance(reading.tool_pose[-1], true)
    assert float(shift) == pytest.approx(0.004, abs=1e-5) and float(turn) == pytest.approx(0.02, abs=1e-5)
    torch.testing.assert_close(task.tool.pose(reading.configuration), reading.tool_pose[-1])
    surface = reading.observation.of_class(Semantics.SURFACE)
    own = se3.apply(se3.inverse(reading.tool_pose[-1]), reading.observation.points[surface & (reading.instant == 19)])
    assert len(own) > 3 and float(torch.cdist(own, task._felt_at).amin(-1).max()) < 1e-4


@sim
def test_free_points_by_a_margin_take_nothing_from_the_truth(arm_tool, mug, monkeypatch):
    task = task_of(arm_tool, mug, cleared_by="margin")
    task.reset(0)
    monkeypatch.setattr("rumi.tasks.rummage.simulated.outside", None)  # which asks the truth
    reading = pushed(task)
    free = reading.observation.of_class(Semantics.FREE)
    own = se3.inverse(reading.tool_pose)[reading.instant[free]]
    own = se3.apply(own, reading.observation.points[free][:, None])[:, 0]
    deep = torch.stack([link.distance(own) for link in task._links.links]).amin(0)
    assert int(free.sum()) > 100 and float(deep.max()) < -0.003 + 1e-5


@sim
def test_what_a_wrong_mask_shows_of_the_floor_is_not_the_object(arm_tool, mug):
    """A mask that spills over shows floor all about the mug; the mug's own points stay as they are."""
    task = task_of(arm_tool, mug, view=ViewErrors(mask_px=2))
    plain = task_of(arm_tool, mug).reset(0)
    whole = int(plain.reading.observation.of_class(Semantics.SURFACE).sum())
    sizes = set()
    for seed in range(6):
        result = task.reset(seed)
        seen = result.reading.observation.points[result.reading.observation.of_class(Semantics.SURFACE)]
        distance = mug.exact.distance(se3.apply(se3.inverse(result.truth), seen))
        assert float(distance.max()) < 0.001
        sizes.add(round(len(seen) / whole, 1))
    assert len(sizes) > 1 and min(sizes) > 0.6


@sim
def test_a_drawn_scenes_camera_stands_where_the_seed_has_it_and_is_known(arm_tool, mug):
    task = make_task(DRAWN["mug"], SimSettings(view=ViewErrors(eye_m=0.05)), tool=arm_tool, model=mug)
    eyes = []
    for seed in (3, 4, 3):
        result = task.reset(seed)
        eyes.append(torch.tensor(task._camera.place.position) - torch.tensor(task.spec.camera.position))
        seen = result.reading.observation.points[result.reading.observation.of_class(Semantics.SURFACE)]
        assert float(mug.exact.distance(se3.apply(se3.inverse(result.truth), seen)).abs().max()) < 0.001
    assert torch.equal(eyes[0], eyes[2]) and not torch.equal(eyes[0], eyes[1])
    assert 0.0 < float(torch.stack(eyes).abs().max()) <= 0.05
    assert DRAWN["mug"].drawn(3).start == task._scene.start
