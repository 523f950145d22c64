"""Points of the tool, and the discs over them."""

import math

import pytest
import torch

from rumi.robot.gripper import GripperShape
from rumi.robot.tool import Tool
from sdf import se3


@pytest.fixture(scope="module")
def free():
    return Tool(torch.tensor([[0.0, -0.4], [0.8, 0.4]], dtype=torch.float64))


@pytest.fixture(scope="module")
def flying():
    space = torch.tensor([[0.0, -0.4, 0.03], [0.8, 0.4, 0.2]], dtype=torch.float64)
    return Tool(space, body_spacing_m=0.012, info_spacing_m=0.010)


@pytest.mark.parametrize("name", ["free", "flying"])
def test_points_lie_on_the_gripper(name, request):
    tool = request.getfixturevalue(name)
    shape, body, info = tool.shape, tool.body, tool.info
    in_pads = torch.zeros(len(body), dtype=torch.bool)
    for center in shape.pad_centers:
        scaled = (body - body.new_tensor(center)) / body.new_tensor(shape.pad_m)
        in_pads |= scaled.square().sum(-1) <= 1 + 1e-9
    assert bool((shape.in_palm(body) | in_pads).all())
    # information is gathered in front of the palm alone
    assert not bool(shape.in_palm(info).any())
    # and the foremost point of both is the pads' tip
    assert float(body[:, 0].max()) == pytest.approx(shape.pad_m[0])
    assert float(info[:, 0].max()) == pytest.approx(shape.pad_m[0], abs=0.0 if name == "free" else 0.01)
    if name == "free":
        assert 300 < len(body) < 500 and 120 < len(info) < 220
    else:
        assert float(body[:, 2].max()) == pytest.approx(0.022) and float(body[:, 2].min()) == pytest.approx(-0.022)
        # any point of the gripper has one near
        assert float(torch.cdist(shape.volume(0.004), body).amin(-1).max()) < 0.012


def test_shell_lies_on_the_pads_and_covers_them():
    shape = GripperShape()
    shell = shape.pad_shell(0.0025)
    scaled = torch.stack([(shell - shell.new_tensor(c)) / shell.new_tensor(shape.pad_m) for c in shape.pad_centers])
    torch.testing.assert_close(
        scaled.square().sum(-1).sub(1).abs().amin(0), torch.zeros(len(shell), dtype=torch.float64), atol=1e-9, rtol=0
    )
    # any point of the surface has a shell point near
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator, dtype=torch.float64), dim=-1)
    surface = direction * shell.new_tensor(shape.pad_m) + shell.new_tensor(shape.pad_centers[0])
    surface = surface[~shape.in_palm(surface)]
    assert float(torch.cdist(surface, shell).amin(-1).max()) < 0.0025


def test_volume_counts_cubes():
    shape = GripperShape()
    volume = shape.volume(0.002)
    a, b, c = shape.pad_m
    palm = math.prod(shape.palm_m)
    pads = 2 * 4 / 3 * math.pi * a * b * c
    inside = len(volume) * 0.002**3
    assert palm < inside < palm + pads  # a part of the pads is sunk in the palm
    assert inside == pytest.approx(palm + 0.93 * pads, rel=0.03)
    assert bool((volume[:, 2].abs() < 0.022).all())


def test_points_follow_the_pose(free):
    q = torch.tensor([[0.3, -0.1, 0.7], [0.5, 0.2, -2.0]], dtype=torch.float64)
    pose = free.pose(q)
    assert pose.shape == (2, 4, 4)
    for points, local in ((free.points(q), free.body), (free.info_points(q), free.info)):
        for row in range(2):
            expected = local @ pose[row, :3, :3].T + pose[row, :3, 3]
            torch.testing.assert_close(points[row], expected)
    assert bool((free.points(q)[..., 2] == free.height_m).all())


@pytest.mark.parametrize("count", [1, 3, 8])
def test_discs_cover_the_body(free, count):
    centers, radius = free.covering_discs(count)
    assert centers.shape == (count, 2)
    assert float(torch.cdist(free.body[:, :2], centers).amin(-1).max()) <= radius + 1e-12
    assert radius < 0.1


def test_balls_cover_the_body(flying):
    centres, radius = flying.covering_discs(8)
    assert centres.shape == (8, 3)
    assert float(torch.cdist(flying.body, centres).amin(-1).max()) <= radius + 1e-12


def test_more_discs_are_smaller(free):
    radii = [free.covering_discs(count)[1] for count in (1, 4, 16)]
    assert radii[0] > radii[1] > radii[2]


def test_normals_of_the_pads_point_outward():
    shape = GripperShape()
    shell = shape.pad_shell(0.004)
    normals = shape.pad_normals(shell)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(shell)).double())

    def level(points):
        centres = points.new_tensor(shape.pad_centers)[:, None]
        return ((points - centres) / points.new_tensor(shape.pad_m)).square().sum(-1).amin(0)

    # the way along which the ellipsoid's level rises the fastest
    step = 1e-5
    slope = torch.stack(
        [(level(shell + step * axis) - level(shell - step * axis)) / (2 * step) for axis in torch.eye(3).double()], -1
    )
    torch.testing.assert_close(torch.nn.functional.normalize(slope, dim=-1), normals, atol=1e-6, rtol=0)


def test_points_follow_the_pose_in_space(flying):
    q = torch.tensor([[0.3, -0.1, 0.1, 0.7], [0.5, 0.2, 0.05, -2.0]], dtype=torch.float64)
    torch.testing.assert_close(flying.points(q), se3.apply(flying.pose(q), flying.body))
    torch.testing.assert_close(flying.info_points(q), se3.apply(flying.pose(q), flying.info))
    assert flying.pose(q)[:, 2, 3].tolist() == [0.1, 0.05]
