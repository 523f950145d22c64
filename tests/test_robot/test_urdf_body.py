"""A robot's body from a URDF, at measured joints."""

from pathlib import Path

import pytest
import torch

pytest.importorskip("pytorch_kinematics")

from rumi.errors import UsageError
from rumi.robot.urdf import UrdfBody
from scripts.bench.mug_mesh import write_obj
from sdf import se3
from tests.fixtures.meshes import box

ROBOT = """
<robot name="two">
  <link name="base"><collision><geometry><cylinder radius="0.05" length="0.2"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1" rpy="0 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <link name="upper"><collision><origin xyz="0.2 0 0" rpy="0 0 0.5"/><geometry><box size="0.4 0.06 0.04"/></geometry>
    </collision><collision><origin xyz="0.4 0 0"/><geometry><sphere radius="0.04"/></geometry></collision></link>
  <joint name="slide" type="prismatic"><parent link="upper"/><child link="tip"/><origin xyz="0.4 0 0" rpy="0 1.5708 0"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <link name="tip">%s</link>
</robot>"""
MESH = '<collision><geometry><mesh filename="tip.obj" scale="0.001 0.001 0.001"/></geometry></collision>'
JOINTS = {"turn": 0.7, "slide": 0.1, "of another robot": 3.0}


@pytest.fixture
def robot(tmp_path):
    """A tip of 20 x 30 x 40 mm from -10, -15, 0 on, as a file in millimetres."""
    write_obj(box((10, 15, 20), (0, 0, 20)), tmp_path / "tip.obj")
    (tmp_path / "robot.urdf").write_text(ROBOT % MESH)
    return UrdfBody.load(tmp_path / "robot.urdf")


def test_points_on_each_part_are_found_where_the_joints_put_it(robot):
    assert robot.owners == ("base", "upper", "upper", "tip") and robot.joints == ("turn", "slide")
    world_T_base = se3.from_planar(torch.tensor([1.0, 2.0, -0.3]))
    poses = robot.poses(JOINTS, world_T_base)
    # by hand: the upper link turns about z, the tip lies 0.1 m farther out, its z along the upper link's x
    upper = (
        world_T_base
        @ se3.make(torch.eye(3), torch.tensor([0.0, 0.0, 0.1]))
        @ se3.from_planar(torch.tensor([0, 0, 0.7]))
    )
    bar = upper @ se3.from_planar(torch.tensor([0.2, 0.0, 0.5]))
    on = torch.cat(
        (
            se3.apply(world_T_base, torch.tensor([[0.049, 0.0, 0.0], [0.0, 0.0, -0.099]])),
            se3.apply(bar, torch.tensor([[0.199, 0.0, 0.0], [-0.1, 0.029, 0.019]])),
            se3.apply(upper, torch.tensor([[0.4, 0.039, 0.0], [0.5, 0.014, 0.009], [0.539, 0.0, 0.0]])),
        )
    )
    off = torch.cat(
        (
            se3.apply(world_T_base, torch.tensor([[0.061, 0.0, 0.0], [0.0, 0.0, -0.111]])),
            se3.apply(bar, torch.tensor([[0.211, 0.02, 0.0], [-0.1, 0.041, 0.0]])),
            se3.apply(
                upper, torch.tensor([[0.4, 0.052, 0.0], [0.5, 0.026, 0.0], [0.551, 0.0, 0.0], [0.53, 0.0, 0.022]])
            ),
        )
    )
    assert robot.body.near(on, poses, 0.0).all()
    assert not robot.body.near(off, poses, 0.0).any()
    assert robot.body.near(off, poses, 0.0125).all()
    assert not robot.body.near(on[4:], robot.poses({"turn": -1.0, "slide": 0.1}, world_T_base), 0.01).any()


def test_what_a_urdf_lacks_is_said(robot, tmp_path):
    with pytest.raises(UsageError, match="slide"):
        robot.poses({"turn": 0.0})
    with pytest.raises(UsageError, match="collision shapes"):
        UrdfBody.load('<robot name="bare"><link name="base"/></robot>')
    with pytest.raises(UsageError, match="could not read"):
        UrdfBody.load("<robot")
    capsule = '<collision><geometry><capsule radius="1"/></geometry></collision>'
    with pytest.raises(UsageError, match="'capsule'"):
        UrdfBody.load(ROBOT % capsule)
    with pytest.raises(UsageError, match="package 'arm'"):
        UrdfBody.load(ROBOT % MESH.replace("tip.obj", "package://arm/tip.obj"))
    inside = UrdfBody.load(ROBOT % MESH.replace("tip.obj", "package://arm/tip.obj"), packages={"arm": Path(tmp_path)})
    assert torch.allclose(inside.body.links[3].bounds, robot.body.links[3].bounds)
    assert float(inside.body.links[3].distance(torch.tensor([[0.0, 0.0, 0.02]]))) == pytest.approx(-0.01, abs=1e-5)
    stretched = tmp_path / "stretched.urdf"
    stretched.write_text(ROBOT % MESH.replace("0.001 0.001 0.001", "0.001 0.001 0.002"))
    with pytest.raises(UsageError, match="one scale"):
        UrdfBody.load(stretched)


@pytest.mark.parametrize("name", ["none.obj", "tip.dae"])
def test_meshes_that_cannot_be_read_are_refused(name):
    with pytest.raises(UsageError, match=name):
        UrdfBody.load(ROBOT % MESH.replace("tip.obj", name))


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ("<sphere/>", "radius above 0 for each sphere"),
        ('<sphere radius="wide"/>', "radius above 0 for each sphere"),
        ('<cylinder radius="0.1"/>', "length above 0 for each cylinder"),
    ],
)
def test_shapes_without_a_size_are_refused(shape, said):
    with pytest.raises(UsageError, match=said):
        UrdfBody.load(ROBOT % f"<collision><geometry>{shape}</geometry></collision>")


@pytest.mark.parametrize(
    "damage",
    [('"0.2 0 0" rpy="0 0 0.5"', '"0.2 0" rpy="0 0 0.5"'), ("0.4 0.06 0.04", "0.4 0.06"), ("0 0 0.5", "0 nan 0.5")],
)
def test_origins_and_sizes_are_of_three_numbers(damage):
    text = ROBOT.strip() % '<collision><geometry><sphere radius="0.04"/></geometry></collision>'
    assert damage[0] in text
    with pytest.raises(UsageError, match="three numbers"):
        UrdfBody.load(text.replace(*damage))


@pytest.mark.parametrize(
    "damage",
    [
        ('<child link="upper"/>', ""),
        ('xyz="0 0 1"/><limit', 'xyz="0 0"/><limit'),
        ('parent link="base"', 'parent link="x"'),
    ],
)
def test_links_that_do_not_hang_together_are_refused(damage):
    text = ROBOT.strip() % '<collision><geometry><sphere radius="0.04"/></geometry></collision>'
    assert UrdfBody.load(text).joints == ("turn", "slide")
    assert damage[0] in text
    with pytest.raises(UsageError, match="hang together"):
        UrdfBody.load(text.replace(*damage))
