"""Tasks with actions in space that no camera sees: physics, readings, and that a run of them works."""

import math
from dataclasses import replace

import pytest
import torch

from rumi import loop
from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.sim.settings import PhysicsSettings, SimSettings
from rumi.sim.world import World
from rumi.tasks.rummage.build import build_rummager, make_task
from rumi.tasks.rummage.scenes import SCENES, find_task, make_tool
from rumi.tasks.rummage.settings import preset
from sdf import se3
from sdf.drill import Drill, drill_model
from sdf.object_model import box_model
from sdf.primitives import Box
from sensors.semantics import Semantics

pytestmark = pytest.mark.sim

HALF = (0.030, 0.079, 0.105)
UNSEEN = [name for name, spec in SCENES.items() if spec.prior is not None and spec.spatial]
SOFT = PhysicsSettings(mass_kg=0.41, max_force_n=25.0, max_lift_n=15.0, max_torque_nm=4.0, lead_m=0.006)


@pytest.fixture(scope="module")
def models():
    return {"drill": drill_model(), "box": box_model()}


def task_of(name, models, **changes):
    """A task whose tool flies freely, since solving the arm's reach at three heights takes long."""
    spec = replace(find_task(name), **changes)
    kind = "drill" if name.startswith("drill") else "box"
    return make_task(spec, tool=make_tool(spec, free_flying=True), model=models[kind])


def drive(world, start, end, parts=20):
    start, end = (torch.tensor(q, dtype=torch.float64) for q in (start, end))
    share = torch.arange(1, parts + 1, dtype=torch.float64)[:, None] / parts
    return world.move(start + share * (end - start), 1.0, 0.1)


def standing_box(x=0.4):
    pose = se3.identity((), dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, 0.0, HALF[2]])
    return pose


def tilt(pose):
    return math.degrees(math.acos(min(1.0, float(pose[2, 2]))))


def test_tool_goes_where_it_is_told():
    world = World(Box(HALF), GripperShape(), None, 0.004, SOFT)
    start, end = (0.1, 0.0, 0.1, 0.0), (0.15, -0.05, 0.18, 0.5)
    world.reset(torch.tensor(start), standing_box())
    track = drive(world, start, end)
    assert track.configuration.shape == (20, 4)
    torch.testing.assert_close(track.configuration[-1], torch.tensor(end, dtype=torch.float64), atol=1e-3, rtol=0)
    assert tilt(track.world_T_object[-1]) < 0.1


def test_box_slides_when_pushed_low_and_tips_when_pushed_high():
    world = World(Box(HALF), GripperShape(), None, 0.004, SOFT)
    for height, tips in ((0.04, False), (0.19, True)):
        start = (0.4 - HALF[0] - 0.045, 0.0, height, 0.0)
        world.reset(torch.tensor(start), standing_box())
        track = drive(world, start, (start[0] + 0.08, 0.0, height, 0.0))
        pose = track.world_T_object[-1]
        assert (tilt(pose) > 20) == tips
        if not tips:
            assert tilt(pose) < 2 and 0.05 < float(pose[0, 3]) - 0.4 < 0.09


def test_pressing_down_presses_no_harder_than_the_drive():
    """A flat box under the tool: it stays on the floor, and the tool on the box."""
    world = World(Box(HALF), GripperShape(), None, 0.004, SOFT)
    pose = se3.identity((), dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    pose[:3, 3] = torch.tensor([0.4, 0.0, HALF[0]])
    start = (0.4, 0.0, 0.1, 0.0)
    world.reset(torch.tensor(start), pose)
    track = drive(world, start, (0.4, 0.0, 0.03, 0.0))
    assert float(track.configuration[-1, 2]) == pytest.approx(2 * HALF[0] + 0.022, abs=0.003)
    assert float(track.world_T_object[-1, 2, 3]) == pytest.approx(HALF[0], abs=0.002)
    # and it lets go again
    track = drive(world, (0.4, 0.0, 0.08, 0.0), (0.4, 0.0, 0.15, 0.0))
    assert float(track.configuration[-1, 2]) == pytest.approx(0.15, abs=0.002)


def test_drill_stands_by_itself_and_can_be_pushed():
    world = World(Drill(), GripperShape(), None, 0.004, replace(SOFT, mass_kg=0.9))
    world.reset(torch.tensor([0.2, 0.0, 0.04, 0.0]), torch.tensor([0.4, 0.0, 0.3]))
    assert tilt(world.world_T_object()) < 0.5
    start = (0.4 - 0.09, 0.0, 0.035, 0.0)
    world.reset(torch.tensor(start), torch.tensor([0.4, 0.0, 0.0]))
    track = drive(world, start, (start[0] + 0.08, 0.0, 0.035, 0.0))
    assert 0.02 < float(track.world_T_object[-1, 0, 3]) - 0.4 < 0.08


@pytest.mark.parametrize("name", UNSEEN)
def test_starts_as_the_task_says(name, models):
    task = task_of(name, models)
    result = task.reset(0)
    spec = task.spec
    up = result.truth[2, :3].abs()
    assert "xyz"[int(up.argmax())] == spec.start_up and float(up.max()) > 0.9999
    torch.testing.assert_close(result.truth[:2, 3], torch.tensor(spec.start[:2]), atol=1e-3, rtol=0)
    lowest = se3.apply(result.truth, task.model.surface_points)[:, 2].min()
    assert abs(float(lowest)) < 2e-3
    # within what the prior says
    assert math.dist(spec.start[:2], spec.prior.mean_m) < 2 * spec.prior.spread_m
    assert len(result.reading.configuration) == 4 and not bool(result.reading.in_contact.any())
    # nothing is seen of the object; where all poses are searched, the floor is known
    seen = result.reading.observation
    assert not bool(seen.of_class(Semantics.SURFACE).any()) and not bool(seen.attached.any())
    assert (len(seen) > 500) == (spec.search == "SE(3)")
    if len(seen):
        local = se3.apply(se3.inverse(result.truth), seen.points)
        assert float(task.model.exact.distance(local).min()) > -2e-3


def test_seeds_change_the_measured_motion_alone(models):
    control = torch.tensor([1.0, 0.2, -0.3, 0.0])
    readings = {}
    for seed in (0, 1):
        task = task_of("box-0", models, start=(0.36, 0.0, 0.2))
        task.reset(seed)
        readings[seed] = [task.step(control) for _ in range(2)]
    last = {seed: steps[-1] for seed, steps in readings.items()}
    assert torch.equal(last[0].truth, last[1].truth)
    assert bool(last[0].reading.in_contact.any())
    moved = last[0].reading.object_motion[-1], last[1].reading.object_motion[-1]
    shift, turn = se3.distance(*moved)
    assert 1e-4 < float(turn) < 0.2 and float(shift) < 0.1
    # free points are those of the object's frame as it is measured
    assert int(last[0].reading.observation.of_class(Semantics.FREE).sum()) > 500


def test_control_has_four_numbers(models):
    task = task_of("drill-0", models)
    task.reset(0)
    with pytest.raises(UsageError, match=r"4 finite numbers \(dx, dy, dz, dyaw\)"):
        task.step(torch.zeros(3))
    with pytest.raises(UsageError, match="camera"):
        task.depth_image()


@pytest.mark.parametrize("name", ["drill-1", "box-2"])
@pytest.mark.parametrize("kind", ["default", "paper"])
def test_a_run_works_and_is_repeatable(name, kind, models):
    settings = preset(kind, task=name)
    mppi = replace(settings.planner.mppi, samples=30, warmup_iterations=1)
    settings = replace(settings, planner=replace(settings.planner, mppi=mppi))
    records = []
    for _ in range(2):
        task = task_of(name, models)
        task.settings = replace(settings.simulator, mini_steps=SimSettings().mini_steps)
        rummager = build_rummager(task.spec, settings, task.model, task.tool)
        steps = []
        loop.run(task, rummager, seed=3, steps=4, on_step=steps.append)
        records.append(steps)
    for a, b in zip(*records, strict=True):
        assert torch.equal(a.belief.attached_T_object, b.belief.attached_T_object)
        assert torch.equal(a.reading.configuration, b.reading.configuration)
    first, last = records[0][0], records[0][-1]
    assert first.nll > task.spec.nll_threshold and len(records[0]) == 5
    assert last.plan.path.shape[-1] == 4 and last.control.shape == (4,)
    assert float(last.belief.weights.sum()) == pytest.approx(1.0, abs=1e-5)


@pytest.fixture(scope="module")
def shelf_mug():
    spec = find_task("shelf-mug")
    return make_task(spec, tool=make_tool(spec, free_flying=True))


def test_shelf_tasks_are_those_of_the_paper():
    for name in ("shelf-mug", "shelf-box"):
        spec = find_task(name)
        assert spec.bounds == ((0.55, -0.33), (1.10, 0.33)) and spec.steps == 15 and spec.apc_ratio == 0.05
        assert (spec.action_m, spec.action_rad) == (0.05, 0.4)
        # the tool works 0.305 m above the base
        assert spec.height_m + spec.base_below_m == pytest.approx(0.305)
        tool = make_tool(spec, free_flying=True)
        assert tool.scale[0] == pytest.approx(0.05) and tool.scale[-1] == pytest.approx(0.4)
    assert find_task("shelf-mug").nll_threshold == 35 and find_task("shelf-box").nll_threshold == 250


def test_shelf_mug_is_looked_at_again_and_its_motion_is_not_measured(shelf_mug):
    first = shelf_mug.reset(0)
    assert first.reading.object_motion is None
    assert int(first.reading.observation.of_class(Semantics.SURFACE).sum()) > 500
    for _ in range(3):
        result = shelf_mug.step(torch.tensor([1.0, 0.2, 0.0]))
    reading = result.reading
    assert reading.object_motion is None
    last = reading.instant == len(reading.tool_pose) - 1
    seen = reading.observation.of_class(Semantics.SURFACE) & last
    assert int(seen.sum()) > 300
    local = se3.apply(se3.inverse(result.truth), reading.observation.points[seen])
    # depth noise of half a millimetre, and what the pads felt within 3 mm
    assert float(shelf_mug.model.exact.distance(local).abs().median()) < 0.001


def test_unmeasured_motion_is_estimated(shelf_mug):
    settings = preset("default", task="shelf-mug")
    rummager = build_rummager(shelf_mug.spec, settings, shelf_mug.model, shelf_mug.tool)
    assert rummager.filter.settings.motion == "trajectory" and rummager.stop_rule.apc_ratio == 0.05
    printed = build_rummager(shelf_mug.spec, preset("paper", task="shelf-mug"), shelf_mug.model, shelf_mug.tool)
    assert printed.filter.settings.motion == "estimated"
    still = build_rummager(find_task("mug-0"), settings, shelf_mug.model, shelf_mug.tool)
    assert still.filter.settings.motion == "measured" and still.stop_rule == settings.stop
