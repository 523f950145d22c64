"""Tasks that report through the images of a camera and of soft bubbles."""

import math
from dataclasses import replace

import pytest
import torch

pytest.importorskip("cv2")

from rumi.commands.run import parse
from rumi.errors import UsageError
from rumi.robot.gripper import Ellipsoid, GripperShape, gripper_links
from rumi.sim.bubble_camera import BubbleCamera
from rumi.sim.conditions import image_errors
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.settings import SimSettings
from rumi.sim.view_faults import taken_pose
from rumi.tasks.rummage.build import build_rummager, make_task
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import from_dict, preset, to_dict
from sdf import se3
from sensors.semantics import Semantics
from sensors.touch.bubble import Bubble, BubbleSettings, bubble_patch

pytestmark = pytest.mark.sim

AHEAD = torch.tensor([1.0, 0.0, 0.0])


def task_with(arm_tool, mug, sensors, name="mug-0", tool_x=0.50):
    spec = replace(SCENES[name], tool_start=(tool_x, 0.0, 0.0))
    return make_task(spec, SimSettings(sensors=sensors), tool=arm_tool, model=mug)


def distances(result, mug, kind):
    """Of what was sensed at the last instant, from the true object."""
    reading = result.reading
    chosen = reading.observation.of_class(kind) & (reading.instant == len(reading.tool_pose) - 1)
    points = se3.apply(se3.inverse(result.truth), reading.observation.points[chosen])
    return mug.exact.distance(points)


@pytest.mark.parametrize("kind", ["camera", "bubbles", "both"])
def test_noise_free_images_are_right_before_and_after_a_push(arm_tool, mug, kind):
    task = task_with(arm_tool, mug, SensorSettings(kind))
    first = task.reset(1000)
    assert float(distances(first, mug, Semantics.SURFACE).abs().max()) < 0.001  # walls are flat pieces
    assert len(distances(first, mug, Semantics.SURFACE)) > 300
    assert float(distances(first, mug, Semantics.FREE).min()) > 0
    pushed = task.step(AHEAD)
    reading = pushed.reading
    assert float((pushed.truth[:2, 3] - first.truth[:2, 3]).norm()) > 0.02
    assert bool(reading.in_contact.any()) == (kind != "camera")
    surface, free = distances(pushed, mug, Semantics.SURFACE), distances(pushed, mug, Semantics.FREE)
    assert len(surface) > 20 and float(surface.abs().max()) < 0.003
    assert len(free) > 100 and float(free.min()) > -0.001
    assert float((reading.object_motion[-1] @ first.truth - pushed.truth).abs().max()) < 1e-5


def test_the_gripper_before_the_mug_is_not_taken_for_it(arm_tool, mug):
    """It has the mug's colour and hides most of it."""
    task = task_with(arm_tool, mug, SensorSettings("camera"), tool_x=0.42)
    surface = distances(task.reset(1000), mug, Semantics.SURFACE)
    assert len(surface) > 20 and float(surface.abs().max()) < 0.001


def test_degraded_images_are_off_by_as_much_as_they_should_be(arm_tool, mug):
    off = {"camera": [], "bubbles": []}
    for kind, found in off.items():
        task = task_with(arm_tool, mug, image_errors(kind))
        for seed in (1000, 1001):
            task.reset(seed)
            found.append(distances(task.step(AHEAD), mug, Semantics.SURFACE))
        every = torch.cat(found)
        assert 0.0002 < float(every.abs().mean()) < 0.006 and float(every.abs().max()) < 0.015


def test_wrong_calibration_stays_for_a_run_and_is_as_large_as_said(arm_tool, mug):
    sensors = SensorSettings("camera", calibration_m=0.002, calibration_rad=math.radians(1.0))
    task = task_with(arm_tool, mug, sensors)
    task.reset(1000)
    first = task._off.clone()
    shift, turn = se3.distance(first, se3.identity())
    assert float(shift) < 0.0021 and float(turn) == pytest.approx(math.radians(1.0), rel=1e-3)
    task.step(AHEAD)
    assert torch.equal(task._off, first)
    task.reset(1001)
    assert not torch.equal(task._off, first)
    # about the workspace its middle is off by the shift alone; about the sensor by 12 mm more or less
    from sensors.vision.camera import look_at

    camera = task.spec.camera
    target = torch.tensor(camera.target).double()
    pose = look_at(torch.tensor(camera.position).double(), target)
    for about, low, high in (("workspace", 0.0, 0.0021), ("sensor", 0.003, 0.016)):
        task.sensors = replace(sensors, turned_about=about)
        taken = taken_pose(pose, first, task.sensors, camera.target)
        moved = se3.apply(taken @ se3.inverse(pose), target[None])[0]
        assert low <= float((moved - target).norm()) <= high


def test_late_images_are_placed_where_the_tool_has_gone_meanwhile(arm_tool, mug):
    """One mini step late: what was felt at one instant is reported at the next, as far ahead as the tool went."""
    readings = []
    for late in (0.0, 0.05):
        task = task_with(arm_tool, mug, SensorSettings("bubbles", late_s=late))
        task.reset(1000)
        readings.append(task.step(AHEAD).reading)
    on_time, late = readings
    tool, felt = on_time.tool_pose, 0
    for index in range(1, len(tool)):
        before, after = (
            r.observation.points[r.observation.of_class(Semantics.SURFACE) & (r.instant == k)]
            for r, k in ((on_time, index - 1), (late, index))
        )
        carried = se3.apply(tool[index] @ se3.inverse(tool[index - 1]), before)
        assert torch.allclose(after, carried, atol=1e-5)
        felt += len(after) > 0
    assert felt > 3


def test_all_images_lost_leave_the_robots_own_way(arm_tool, mug):
    task = task_with(arm_tool, mug, SensorSettings("both", lost=0.99999))
    assert len(task.reset(1000).reading.observation) == 0
    reading = task.step(AHEAD).reading
    assert not bool(reading.in_contact.any()) and not bool(reading.observation.of_class(Semantics.SURFACE).any())


def test_the_first_look_goes_on_until_the_object_shows(arm_tool, mug, monkeypatch):
    task = task_with(arm_tool, mug, SensorSettings("both"))
    whole = task.reset(1000).reading.observation
    late = iter([True] * 9 + [False] * 100)
    monkeypatch.setattr(task, "_lost", lambda: next(late))
    seen = task.reset(1000).reading.observation
    for kind in (Semantics.SURFACE, Semantics.FREE):
        assert int(seen.of_class(kind).sum()) == int(whole.of_class(kind).sum())


def test_a_run_does_not_know_of_the_run_before(arm_tool, mug, monkeypatch):
    """Where nothing shows, free points are not looked for where an earlier run's object was."""
    used, fresh = (task_with(arm_tool, mug, SensorSettings("both")) for _ in range(2))
    assert len(used.reset(1000).reading.observation) > 0
    found = []
    for task in (used, fresh):
        monkeypatch.setattr(task, "_lost", lambda: True)
        task.reset(1001)
        found.append(task.step(AHEAD).reading.observation.points)
    assert torch.equal(*found)


def test_same_seed_same_bytes_and_another_seed_other_noise(arm_tool, mug):
    task = task_with(arm_tool, mug, image_errors("both"))
    runs = []
    for seed in (1000, 1000, 1001):
        first = task.reset(seed).reading.observation.points
        runs.append(torch.cat((first, task.step(AHEAD).reading.observation.points)))
    assert torch.equal(runs[0], runs[1])
    assert runs[0].shape != runs[2].shape or not torch.equal(runs[0], runs[2])


def test_the_camera_in_a_bubble_sees_its_membrane():
    shape = GripperShape()
    for pad in (0, 1):
        camera = BubbleCamera(shape, pad, 0.008)
        bubble = Bubble.of(camera.rest, camera.intrinsics.float(), camera.tool_T_camera.float())
        patch = bubble_patch(bubble, camera.rest.float(), se3.identity())
        free = patch.observation.points
        assert not bool(patch.contact.any()) and len(free) > 50
        # 2 mm inside of the pad grown by 8 mm, on its own side and before the palm
        grown = Ellipsoid(tuple(half + 0.008 for half in shape.pad_m)).distance(
            free - torch.tensor(shape.pad_centers[pad])
        )
        assert float((grown + 0.002).abs().max()) < 0.0015
        assert float(free[:, 0].min()) > shape.palm_front_m
        # a wall 5 mm before the pads' tips dents the membrane by 3 mm
        wall = shape.pad_m[0] + 0.005
        _, ways = camera.ways(torch.eye(4))
        dented = camera.image((wall - shape.palm_front_m) / ways[:, 0])
        sharp = BubbleSettings(mean_px=1)
        deepest = bubble_patch(bubble, dented.float(), se3.identity(), sharp).deformation.max()
        assert 0.0025 < float(deepest) < 0.0031


def test_the_grippers_links_are_its_shape():
    shape = GripperShape()
    random = torch.Generator().manual_seed(0)
    points = 0.2 * torch.rand(20_000, 3, generator=random) - torch.tensor([0.13, 0.1, 0.1])
    inside = torch.stack([link.distance(points) for link in gripper_links(shape)]).amin(0) <= 0
    expected = shape.in_palm(points)
    for center in shape.pad_centers:
        expected |= ((points - torch.tensor(center)) / torch.tensor(shape.pad_m)).norm(dim=-1) <= 1.0
    assert torch.equal(inside, expected) and int(inside.sum()) > 200
    pad = Ellipsoid(shape.pad_m)
    surface = shape.pad_shell(0.004).float() - torch.tensor(shape.pad_centers[0])
    surface = surface[(surface / torch.tensor(shape.pad_m)).norm(dim=-1) < 1.001]
    out = surface + 0.002 * torch.nn.functional.normalize(surface / torch.tensor(shape.pad_m).square(), dim=-1)
    assert torch.allclose(pad.distance(out), torch.full((len(out),), 0.002), atol=2e-4)
    assert float(pad.distance(torch.zeros(1, 3))) == pytest.approx(-0.018)


def test_settings_and_flags():
    faulty = preset(simulator=SimSettings(sensors=image_errors("both")))
    assert from_dict(to_dict(faulty)) == faulty
    plain = parse(["mug-0", "--simulator.sensors.kind", "camera", "--simulator.sensors.lost", "0.2"])[2].settings
    assert plain.simulator.sensors == SensorSettings("camera", lost=0.2)
    assert preset().simulator.sensors.kind == "points"


def test_a_camera_alone_may_be_sure_without_a_contact(arm_tool, mug):
    for kind, contacts in (("camera", 0), ("bubbles", 1), ("points", 1)):
        settings = preset(simulator=SimSettings(sensors=SensorSettings(kind)))
        assert build_rummager(SCENES["mug-0"], settings, mug, arm_tool).stop_rule.contacts == contacts


def test_a_task_without_a_camera_is_refused(arm_tool, mug):
    with pytest.raises(UsageError, match="no camera"):
        make_task(SCENES["drill-0"], SimSettings(sensors=SensorSettings("bubbles")), tool=arm_tool, model=mug)
