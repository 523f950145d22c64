"""Bubbles' images, joint torques and a robot's body in a bag: what they tell is what the live robot was told."""

import math

import numpy as np
import pytest
import torch

from rumi.bags.bag import import_bag
from rumi.bags.mapping import mapping_of
from rumi.bags.readings import make_readings
from rumi.errors import UsageError
from sensors.bubble import bubble_patch
from sensors.camera import look_at, pinhole, pixel_rays
from sensors.log.reader import Log
from sensors.semantics import Semantics

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

    import rumi.sim.sensed_task as module
    from rumi.sim.sensor_settings import SensorSettings
    from rumi.sim.settings import SimSettings
    from rumi.sim.tasks import TASKS, large_handled_mug, make_task, make_tool

    taken = []
    read = module.bubble_patch

    def kept(bubble, depth, world_T_tool):
        taken.append((bubble, depth, world_T_tool))
        return read(bubble, depth, world_T_tool)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "bubble_patch", kept)
        spec = replace(TASKS["mug-0"], start=(0.45, 0.03, 0.6))
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


def readings_of(bag, text, path):
    mapping = mapping_of(text)
    path.unlink(missing_ok=True)
    done = import_bag(bag, mapping, path)
    assert done.problems == [] and done.lost == {}
    with Log(path) as log:
        return make_readings(log, mapping)


@pytest.fixture(scope="module")
def felt_again(felt_run, tmp_path_factory):
    """Readings of the bag."""
    return readings_of(felt_run[0], BUBBLES, tmp_path_factory.mktemp("again") / "log.h5")


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


def test_late_pictures_are_of_before(felt_run, felt_again, tmp_path):
    bag, _, _ = felt_run
    late = readings_of(bag, BUBBLES + "[bubble]\nlate_s = 0.055\n", tmp_path / "log.h5")
    first = [one.taken[3].reading.in_contact.tolist().index(True) for one in (felt_again, late)]
    assert first[1] == first[0] - 1


def test_what_bubbles_lack_is_named(felt_run, bags, tmp_path):
    bag, _, _ = felt_run
    with pytest.raises(UsageError, match=r"intrinsics of left/depth: name its CameraInfo topic"):
        readings_of(bag, BUBBLES.replace('"/left/info" = "camera"\n', ""), tmp_path / "log.h5")
    with pytest.raises(UsageError, match=r"bubble: Expected mean_px to be odd"):
        mapping_of(BUBBLES + "[bubble]\nmean_px = 4\n")
    maker = bags.Maker(tmp_path / "bag")
    for name in ("left", "right"):
        maker.camera_info(f"/{name}/info", bags.START, name, torch.eye(3), (4, 4))
        maker.image(f"/{name}/depth", bags.START + bags.SECOND, name, np.ones((4, 4), np.float32), "32FC1")
    with pytest.raises(UsageError, match=r"at rest in the first view, the first 0\.2 s, got none"):
        readings_of(maker.close(), BUBBLES, tmp_path / "log.h5")


TORQUES = """
schema = 1
[topics]
"/joint_states" = "torques"
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "box"
within = [[-1, -1, -1], [1, 1, 1]]
prior_mean_m = [0.5, 0.0]
[robot]
file = "ROBOT"
[torques]
threshold_nm = 1.0
rest_s = 0.3
[actions]
view_s = 0.3
every_s = 0.4
instants = 4
"""


@pytest.fixture(scope="module")
def pushed_arm(bags, tmp_path_factory):
    """An arm that holds itself under gravity while its hand is pushed from 0.7 s to 0.9 s; its bag and its model."""
    import mujoco

    from rumi.sim.arm_scene import ARM_JOINTS, ArmPhysics, arm_xml

    folder = tmp_path_factory.mktemp("arm")
    model = mujoco.MjModel.from_xml_string(arm_xml(ArmPhysics()))
    (folder / "arm.xml").write_text(arm_xml(ArmPhysics()))
    data = mujoco.MjData(model)
    place = [model.joint(name).qposadr[0] for name in ARM_JOINTS]
    dof = [model.joint(name).dofadr[0] for name in ARM_JOINTS]
    data.qpos[place] = target = np.array([0.1, 0.5, 0.0, -1.2, 0.0, 1.0, 0.0])
    hand = model.body("tool").id
    maker = bags.Maker(folder / "bag")
    for step in range(1500):
        mujoco.mj_forward(model, data)
        wave = 0.1 * math.sin(2.0 * step / 1000) * np.ones(7)
        data.ctrl[:7] = 400 * (target + wave - data.qpos[place]) - 40 * data.qvel[dof] + data.qfrc_bias[dof]
        data.xfrc_applied[hand, :3] = (0.0, 15.0, 0.0) if 700 <= step < 900 else 0.0
        stamp = bags.START + step * bags.SECOND // 1000
        if step % 2 == 0:
            # in another order, with a joint that the arm does not have
            maker.joints(
                "/joint_states",
                stamp,
                ["gripper", *reversed(ARM_JOINTS)],
                [0.0, *data.qpos[place][::-1]],
                effort=[0.0, *data.ctrl[:7][::-1]],
                velocity=[0.0, *data.qvel[dof][::-1]],
            )
        if step % 100 == 0 or step == 1499:
            maker.tf(stamp, "base", "gripper", torch.eye(4))
        mujoco.mj_step(model, data)
    return maker.close(), folder / "arm.xml"


def told(pushed_arm, **changes):
    from rumi.sim.arm_scene import ARM_JOINTS

    _, model = pushed_arm
    joints = ", ".join(f'"{name}"' for name in ARM_JOINTS)
    text = TORQUES.replace("ROBOT", str(model)).replace("rest_s = 0.3", f"rest_s = 0.3\njoints = [{joints}]")
    for old, new in changes.items():
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="module")
def torques(pushed_arm, tmp_path_factory):
    """Readings of its bag."""
    return readings_of(pushed_arm[0], told(pushed_arm), tmp_path_factory.mktemp("torques") / "log.h5")


def test_joint_torques_of_a_bag_tell_when_the_hand_was_pushed(torques):
    made = torques
    assert made.problems == []
    assert "samples beyond 1 N m" in made.notes[0]
    touched = torch.cat([one.reading.in_contact for one in made.taken[1:]])
    ends = 0.3 + 0.1 * torch.arange(1, len(touched) + 1)
    # a residual of gain 25 goes on for a while after the push
    assert touched[(ends > 0.75) & (ends < 0.95)].all()
    assert not touched[(ends < 0.7) | (ends > 1.15)].any()


def test_a_touch_that_nobody_knows_the_place_of_leaves_no_free_space(torques):
    made = torques
    for one in made.taken[1:]:
        reading = one.reading
        for k in reading.in_contact.nonzero()[:, 0].tolist():
            assert not (reading.instant == k).any()
    assert sum(int(one.reading.observation.of_class(Semantics.FREE).sum()) for one in made.taken) > 0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"joint_1", ', '"shoulder", ', "Expected the joint 'shoulder' in joint_states, which has gripper, joint_7"),
        ("arm.xml", "none.xml", "Cannot read robot.file .*none.xml"),
        ("[torques]\nthreshold_nm = 1.0", "[settings]", r"Expected tables \[torques\] and \[robot\]"),
        ("threshold_nm = 1.0", "threshold_nm = -1.0", "expected threshold_nm above 0"),
    ],
)
def test_what_torques_lack_is_named(pushed_arm, tmp_path, old, new, message):
    text = told(pushed_arm).replace(old, new)
    if new == "[settings]":
        text = text.split("[settings]")[0] + "[actions]" + text.split("[actions]")[1]
    with pytest.raises(UsageError, match=message):
        readings_of(pushed_arm[0], text, tmp_path / "log.h5")


SLIDER = """<robot name="slider">
  <link name="rail"/>
  <link name="block"><collision><origin xyz="0 0 0.1"/><geometry><box size="0.1 0.1 0.2"/></geometry></collision></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="block"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""

VIEW = """
schema = 1
[topics]
"/depth" = { role = "depth", camera = "/info" }
"/info" = "camera"
"/joint_states" = "joints"
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "box"
within = [[-0.5, -0.5, 0.0], [0.5, 0.5, 0.4]]
[robot]
file = "ROBOT"
remove = true
[actions]
view_s = 0.2
every_s = 0.4
[view]
segmentation = "plane"
"""


@pytest.fixture
def slider_seen(bags, tmp_path):
    """A camera that sees a ball and a block of the robot's, which its one joint has moved; the bag."""
    pytest.importorskip("pytorch_kinematics")
    (tmp_path / "slider.urdf").write_text(SLIDER)
    maker = bags.Maker(tmp_path / "bag")
    intrinsics = pinhole(120, 160, math.radians(50.0))
    pose = look_at(torch.tensor([-0.6, 0.0, 0.7]).double(), torch.tensor([0.0, 0.0, 0.05]).double()).float()
    rays = pixel_rays(120, 160, intrinsics) @ pose[:3, :3].mT
    origin = pose[:3, 3]
    depth = -origin[2] / rays[..., 2]
    # a ball of 60 mm at y = -0.15, a block of 100 x 100 x 200 mm at x = 0.1, y = 0
    center = torch.tensor([0.0, -0.15, 0.06])
    a, b = rays.square().sum(-1), (rays * (origin - center)).sum(-1)
    root = b.square() - a * ((origin - center).square().sum() - 0.06**2)
    depth = torch.where(root > 0, torch.minimum(depth, (-b - root.clamp_min(0).sqrt()) / a), depth)
    low, high = torch.tensor([0.05, -0.05, 0.0]), torch.tensor([0.15, 0.05, 0.2])
    enter, leave = ((side - origin) / rays for side in (low, high))
    near, far = torch.minimum(enter, leave).amax(-1), torch.maximum(enter, leave).amin(-1)
    depth = torch.where((near < far) & (near > 0), torch.minimum(depth, near), depth)
    maker.tf(bags.START, "base", "camera", pose, topic="/tf_static")
    maker.camera_info("/info", bags.START, "camera", intrinsics, (120, 160))
    for step in range(11):
        stamp = bags.START + step * bags.SECOND // 20
        maker.tf(stamp, "base", "gripper", torch.eye(4))
        # it slides by; at the picture's time it is at 0.1 between the samples about it
        maker.joints("/joint_states", stamp, ["slide"], [0.1 + 0.4 * (step - 2.5) / 20])
    maker.image("/depth", bags.START + bags.SECOND // 8, "camera", depth.numpy(), "32FC1")
    return maker.close(), tmp_path / "slider.urdf", center


def test_the_robot_is_left_out_of_what_the_camera_saw(slider_seen, tmp_path):
    bag, urdf, center = slider_seen
    text = VIEW.replace("ROBOT", str(urdf))
    surfaces = []
    for one in (text, text.replace("remove = true", "remove = false")):
        seen = readings_of(bag, one, tmp_path / "log.h5").taken[0].reading.observation
        surfaces.append(seen.points[seen.of_class(Semantics.SURFACE)])
    ball, block = surfaces
    # without the model the largest patch is the robot's
    assert float(((ball - center).norm(dim=-1) - 0.06).abs().max()) < 0.002 and len(ball) > 100
    assert float((block[:, 1]).abs().median()) < 0.05


def test_a_picture_without_joints_is_left_out(slider_seen, tmp_path):
    bag, urdf, _ = slider_seen
    text = VIEW.replace("ROBOT", str(urdf)).replace('tool = "gripper"', 'tool = "gripper"\nlongest_gap_s = 0.01')
    made = readings_of(bag, text.replace('tool = "gripper"', 'tool = "base"'), tmp_path / "log.h5")
    assert any("where the robot was" in problem for problem in made.problems)
    model = tmp_path / "arm.xml"
    model.write_text("<mujoco/>")
    with pytest.raises(UsageError, match=r"Expected robot\.file to be a URDF for robot\.remove"):
        readings_of(bag, VIEW.replace("ROBOT", str(model)), tmp_path / "log.h5")


def test_joints_are_interpolated(bags, tmp_path):
    from rumi.bags.torques import JointTrack

    maker = bags.Maker(tmp_path / "bag")
    for step in range(3):
        maker.joints("/joint_states", bags.START + step * bags.SECOND, ["a", "b"], [1.0 * step, 2.0 * step * step])
    mapping = mapping_of(VIEW)
    import_bag(maker.close(), mapping, tmp_path / "log.h5")
    with Log(tmp_path / "log.h5") as log:
        track = JointTrack(log.stream("joint_states"))
    found, near = track.position(bags.START + bags.SECOND * 3 // 2, bags.SECOND)
    assert found == pytest.approx({"a": 1.5, "b": 5.0}) and bool(near)
    found, near = track.position(bags.START + bags.SECOND, bags.SECOND // 4)
    assert found == {"a": 1.0, "b": 2.0} and bool(near)
    _, near = track.position(bags.START + bags.SECOND * 3 // 2, bags.SECOND // 4)
    assert not bool(near)
    _, near = track.position(bags.START + 9 * bags.SECOND, bags.SECOND)
    assert not bool(near)
