"""A robot's body is left out of what a bag's camera saw, by its joints then."""

import math

import pytest
import torch

from rumi.errors import UsageError
from rumi.rosbag.bag import import_bag
from rumi.rosbag.mapping_file import mapping_of
from sensors.log.reader import Log
from sensors.semantics import Semantics
from sensors.vision.camera import look_at, pinhole, pixel_rays

pytestmark = pytest.mark.sim

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


def test_the_robot_is_left_out_of_what_the_camera_saw(slider_seen, bags, tmp_path):
    bag, urdf, center = slider_seen
    text = VIEW.replace("ROBOT", str(urdf))
    surfaces = []
    for one in (text, text.replace("remove = true", "remove = false")):
        seen = bags.readings_of(bag, one, tmp_path / "log.h5").taken[0].reading.observation
        surfaces.append(seen.points[seen.of_class(Semantics.SURFACE)])
    ball, block = surfaces
    # without the model the largest patch is the robot's
    assert float(((ball - center).norm(dim=-1) - 0.06).abs().max()) < 0.002 and len(ball) > 100
    assert float((block[:, 1]).abs().median()) < 0.05


def test_a_picture_without_joints_is_left_out(slider_seen, bags, tmp_path):
    bag, urdf, _ = slider_seen
    text = VIEW.replace("ROBOT", str(urdf)).replace('tool = "gripper"', 'tool = "gripper"\nlongest_gap_s = 0.01')
    made = bags.readings_of(bag, text.replace('tool = "gripper"', 'tool = "base"'), tmp_path / "log.h5")
    assert any("where the robot was" in problem for problem in made.problems)
    model = tmp_path / "arm.xml"
    model.write_text("<mujoco/>")
    with pytest.raises(UsageError, match=r"Expected robot\.file to be a URDF for robot\.remove"):
        bags.readings_of(bag, VIEW.replace("ROBOT", str(model)), tmp_path / "log.h5")


def test_joints_are_interpolated(bags, tmp_path):
    from rumi.rosbag.torques import JointTrack

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
