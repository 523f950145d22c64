"""Bubbles' images in a bag: what they tell is what the live robot felt."""

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.rosbag.mapping_file import mapping_of
from sensors.semantics import Semantics
from sensors.touch.bubble import bubble_patch

pytestmark = pytest.mark.sim

BUBBLES = """
schema = 1
[topics]
"/left/depth" = { role = "bubble", camera = "/left/info" }
"/left/info" = "camera"
"/right/depth" = { role = "bubble", camera = "/right/info" }
"/right/info" = "camera"
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "mug"
within = [[0.40, -0.15, 0.0], [0.80, 0.20, 0.15]]
prior_mean_m = [0.55, 0.0]
[actions]
view_s = 0.2
every_s = 1.1
instants = 20
"""


@pytest.fixture(scope="module")
def felt_run(bags, tmp_path_factory):
    """A bag of what the bubbles' cameras of a simulated robot took, and the readings that the live robot had."""
    from dataclasses import replace

    import rumi.tasks.rummage.sensed as module
    from rumi.sim.sensor_settings import SensorSettings
    from rumi.sim.settings import SimSettings
    from rumi.tasks.rummage.build import make_task
    from rumi.tasks.rummage.scenes import SCENES, large_handled_mug, make_tool

    taken = []
    read = module.bubble_patch

    def kept(bubble, depth, world_T_tool):
        taken.append((bubble, depth, world_T_tool))
        return read(bubble, depth, world_T_tool)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "bubble_patch", kept)
        spec = replace(SCENES["mug-0"], start=(0.45, 0.03, 0.6))
        task = make_task(
            spec,
            SimSettings(sensors=SensorSettings("bubbles")),
            tool=make_tool(spec, free_flying=True),
            model=large_handled_mug(),
        )
        first = task.reset(0)
        results = [task.step(torch.tensor(control)) for control in ([1.0, 0.3, 0.0], [1.0, 0.1, 0.0], [0.9, 0.0, 0.0])]
    maker = bags.Maker(tmp_path_factory.mktemp("bubbles") / "bag")
    names = ("left", "right")
    for name, camera in zip(names, task._bubbles, strict=True):
        maker.tf(bags.START, "gripper", name, camera.tool_T_camera, topic="/tf_static")
        maker.camera_info(f"/{name}/info", bags.START, name, camera.intrinsics, camera.rest.shape)
    for at in (0, bags.SECOND // 10, bags.SECOND // 5):
        maker.tf(bags.START + at, "base", "gripper", first.reading.tool_pose[0])
        for name, camera in zip(names, task._bubbles, strict=True):
            maker.image(f"/{name}/depth", bags.START + at, name, camera.rest.float().numpy(), "32FC1")
    begin, images = bags.START + bags.SECOND // 5, iter(taken)
    for result in results:
        poses = result.reading.tool_pose
        for k in range(len(poses)):
            stamp = begin + 11 * bags.SECOND // 10 * (k + 1) // len(poses)
            maker.tf(stamp, "base", "gripper", poses[k])
            for name in names:
                _, depth, pose = next(images)
                assert torch.equal(pose, poses[k])
                maker.image(f"/{name}/depth", stamp, name, depth.numpy(), "32FC1")
        begin = stamp
    assert next(images, None) is None
    return maker.close(), [first.reading, *(result.reading for result in results)], taken


def apart(a, b):
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


@pytest.fixture(scope="module")
def felt_again(felt_run, bags, tmp_path_factory):
    """Readings of the bag."""
    return bags.readings_of(felt_run[0], BUBBLES, tmp_path_factory.mktemp("again") / "log.h5")


def test_bubbles_of_a_bag_feel_what_the_live_ones_felt(felt_run, felt_again):
    made, live = felt_again, felt_run[1]
    assert made.problems == [] and len(made.taken) == len(live)
    assert [note.split(":")[0] for note in made.notes] == ["bubble left/depth", "bubble right/depth"]
    touched = 0
    for ours, theirs in zip(made.taken[1:], live[1:], strict=True):
        reading = ours.reading
        torch.testing.assert_close(reading.tool_pose, theirs.tool_pose, atol=1e-5, rtol=0)
        assert torch.equal(reading.in_contact, theirs.in_contact)
        mine, them = (one.observation.of_class(Semantics.SURFACE) for one in (reading, theirs))
        for k in theirs.instant[them].unique().tolist():
            # the bubbles one after the other there, and by their stamps here
            a = reading.observation.points[mine & (reading.instant == k)]
            b = theirs.observation.points[them & (theirs.instant == k)]
            assert len(a) == len(b)
            assert float(apart(a, b).amin(-1).max()) < 1e-5
        touched += int(them.sum())
    assert touched > 100


def test_the_membrane_at_rest_is_free(felt_run, felt_again):
    taken = felt_run[2]
    reading, k = felt_again.taken[3].reading, 2
    low, high = torch.tensor(mapping_of(BUBBLES).scene.within)
    expected = []
    for bubble, depth, pose in taken[2 * (2 * 20 + k) :][:2]:
        seen = bubble_patch(bubble, depth, pose).observation
        expected.append(seen.points[seen.of_class(Semantics.FREE)])
    membrane = torch.cat(expected)
    membrane = membrane[((membrane >= low) & (membrane <= high)).all(-1)]
    assert len(membrane) > 10
    free = reading.observation.points[reading.observation.of_class(Semantics.FREE) & (reading.instant == k)]
    assert float(apart(membrane, free).amin(-1).max()) < 1e-5


def test_late_pictures_are_of_before(felt_run, felt_again, bags, tmp_path):
    bag, _, _ = felt_run
    late = bags.readings_of(bag, BUBBLES + "[bubble]\nlate_s = 0.055\n", tmp_path / "log.h5")
    first = [one.taken[3].reading.in_contact.tolist().index(True) for one in (felt_again, late)]
    assert first[1] == first[0] - 1


def test_what_bubbles_lack_is_named(felt_run, bags, tmp_path):
    bag, _, _ = felt_run
    with pytest.raises(UsageError, match=r"intrinsics of left/depth: name its CameraInfo topic"):
        bags.readings_of(bag, BUBBLES.replace('"/left/info" = "camera"\n', ""), tmp_path / "log.h5")
    with pytest.raises(UsageError, match=r"bubble: Expected mean_px to be odd"):
        mapping_of(BUBBLES + "[bubble]\nmean_px = 4\n")
    maker = bags.Maker(tmp_path / "bag")
    for name in ("left", "right"):
        maker.camera_info(f"/{name}/info", bags.START, name, torch.eye(3), (4, 4))
        maker.image(f"/{name}/depth", bags.START + bags.SECOND, name, np.ones((4, 4), np.float32), "32FC1")
    with pytest.raises(UsageError, match=r"at rest in the first view, the first 0\.2 s, got none"):
        bags.readings_of(maker.close(), BUBBLES, tmp_path / "log.h5")
