"""A tool that moves in space: its points, and where commands take it."""

import math

import pytest
import torch

from rumi.robot.gripper import GripperShape
from rumi.robot.reach import SpatialReach
from rumi.robot.reach_table import ReachSettings, ReachTable, table_shape
from rumi.robot.tool import Tool
from sdf import se3

BOUNDS = torch.tensor([[0.0, -0.4, 0.03], [0.8, 0.4, 0.2]], dtype=torch.float64)


@pytest.fixture(scope="module")
def tool():
    """Its tip must stay within 1.05 m of the base on the floor, 10 cm less at a height of 20 cm."""
    settings = ReachSettings(radius_step_m=0.01, yaw_steps=20)
    rows, columns = table_shape(settings)
    radius = torch.arange(rows, dtype=torch.float64)[:, None].expand(rows, columns) * settings.radius_step_m
    tables = [
        ReachTable((radius - most).clamp_min(0.0), torch.zeros(rows, columns).double()) for most in (1.05, 1.0, 0.95)
    ]
    reach = SpatialReach(tables, (0.03, 0.115, 0.2), settings, (-0.45, 0.0, 0.0)).double()
    return Tool(BOUNDS, reach, body_spacing_m=0.012, info_spacing_m=0.010)


def test_points_fill_the_gripper(tool):
    shape = GripperShape()
    body, info = tool.body, tool.info
    in_pads = torch.zeros(len(body), dtype=torch.bool)
    for center in shape.pad_centers:
        in_pads |= ((body - body.new_tensor(center)) / body.new_tensor(shape.pad_m)).square().sum(-1) <= 1 + 1e-9
    assert bool((shape.in_palm(body) | in_pads).all())
    assert not bool(shape.in_palm(info).any())
    assert float(body[:, 2].max()) == pytest.approx(0.022) and float(body[:, 2].min()) == pytest.approx(-0.022)
    assert float(body[:, 0].max()) == pytest.approx(shape.pad_m[0])
    # any point of the gripper has one near
    volume = shape.volume(0.004)
    assert float(torch.cdist(volume, body).amin(-1).max()) < 0.012


def test_balls_cover_the_body(tool):
    centres, radius = tool.covering_discs(8)
    assert centres.shape == (8, 3)
    assert float(torch.cdist(tool.body, centres).amin(-1).max()) <= radius + 1e-12


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


def test_points_follow_the_pose(tool):
    q = torch.tensor([[0.3, -0.1, 0.1, 0.7], [0.5, 0.2, 0.05, -2.0]], dtype=torch.float64)
    torch.testing.assert_close(tool.points(q), se3.apply(tool.pose(q), tool.body))
    torch.testing.assert_close(tool.info_points(q), se3.apply(tool.pose(q), tool.info))
    assert tool.pose(q)[:, 2, 3].tolist() == [0.1, 0.05]


def test_free_motion_and_bounds(tool):
    q = torch.tensor([0.3, 0.0, 0.06, 0.4], dtype=torch.float64)
    reached, refused = tool.free_step(q, torch.tensor([0.5, -1.0, 0.5, 1.0], dtype=torch.float64), 0.5)
    torch.testing.assert_close(reached, q + torch.tensor([0.02, -0.04, 0.02, 0.25], dtype=torch.float64))
    assert float(refused) == 0.0
    down, refused = tool.free_step(q, torch.tensor([0.0, 0.0, -1.0, 0.0], dtype=torch.float64))
    assert float(down[2]) == pytest.approx(0.03) and float(refused) == pytest.approx(0.05)


def test_never_leaves_reach_or_bounds_and_is_repeated_steps(tool, generator):
    start = torch.tensor([0.45, 0.0, 0.1, 0.0], dtype=torch.float64)
    controls = torch.rand(40, 6, 4, generator=generator, dtype=torch.float64) * 2 - 0.8
    path = tool.free_path(start, controls, 4)
    assert bool((tool.reach.residual(path) <= tool.reach.settings.tolerance_m + 1e-5).all())
    assert bool(((path[..., :3] >= BOUNDS[0]) & (path[..., :3] <= BOUNDS[1])).all())
    now = start.expand(40, 4)
    for index in range(24):
        now, _ = tool.free_step(now, controls[:, index // 4], 0.25)
        torch.testing.assert_close(path[:, index], now, atol=1e-9, rtol=0)
    free = start + (controls * tool.scale).cumsum(1)
    assert int((~tool._inside(free).all(-1)).sum()) > 5


def test_slides_along_the_limit_and_rises_no_farther_than_it_reaches(tool):
    now = torch.tensor([0.59, 0.0, 0.03, 0.0], dtype=torch.float64)
    for _ in range(4):
        before = now
        now, _ = tool.free_step(now, torch.tensor([1.0, 0.5, 0.0, 0.0], dtype=torch.float64))
        assert float(now[1] - before[1]) > 0.02
    # the reach shrinks upward: straight up from the limit is refused, up and back is not
    radius = math.hypot(float(now[0]) + 0.45, float(now[1]))
    up, _ = tool.free_step(now, torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64))
    assert float(up[2] - now[2]) < 0.02 and radius > 1.04
    back, _ = tool.free_step(now, torch.tensor([-1.0, 0.0, 1.0, 0.0], dtype=torch.float64))
    assert float(back[2] - now[2]) == pytest.approx(0.08)
