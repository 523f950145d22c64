"""Worlds far from their origin: refused where single precision cannot hold them."""

import re

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.fields.workspace import Workspace
from rumi.registration.from_contacts import LocalizeSettings, localize
from rumi.registration.register import RegisterSettings, register
from rumi.registration.touch_surface import TouchSurface
from sdf import se3
from sdf.check import ROUNDING_M, check_near
from sdf.grid_sdf import GridSDF
from sdf.mesh.mesh import TriangleMesh
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics
from sensors.vision.camera import depth_observation, pinhole
from sensors.vision.cloud import cloud_observation
from sensors.vision.view import Image, ViewSettings, view_observation

F64 = torch.float64
MAP = torch.tensor([412_345.678, 5_812_345.25, 37.5], dtype=F64)
"""As the coordinates of a map are."""
TABLE = GridSDF.from_sdf(Box((0.03, 0.05, 0.08)), 0.005)
REFUSED = r"within 83.9 m of the origin for torch.float32, got .* mm apart: subtract the middle"


def scene(generator, origin=MAP):
    """Poses of a box about a place, and points of the world about it, float64."""
    twist = torch.randn(20, 6, generator=generator, dtype=F64) * 0.05
    poses = se3.exp(twist)
    points = 0.2 * torch.randn(50, 3, generator=generator, dtype=F64)
    poses[:, :3, 3] += origin
    return poses, points + origin


def test_the_rule():
    limit = ROUNDING_M / torch.finfo(torch.float32).eps
    check_near("x", torch.tensor([0.999 * limit, -0.999 * limit]))
    for far in (1.001 * limit, -1e4):
        with pytest.raises(ValueError, match=f"Expected x {REFUSED}"):
            check_near("x", torch.tensor([0.0, far]))
    check_near("x", torch.tensor([1e7, -1e9], dtype=F64))
    with pytest.raises(ValueError, match=REFUSED):
        check_near("x", torch.tensor([1e4], dtype=F64), torch.float32)
    check_near("x", torch.zeros(0, 3))
    # for others to refuse
    check_near("x", torch.tensor([torch.nan, 1e5]))
    check_near("x", torch.tensor([torch.inf]))


def test_a_workspace(generator):
    bounds = torch.stack((MAP, MAP + 0.5))
    with pytest.raises(ValueError, match=REFUSED):
        Workspace.from_bounds(bounds.float(), 0.01)
    assert Workspace.from_bounds(bounds, 0.1).shape == (6, 6, 6)
    assert Workspace.from_bounds((bounds - MAP).float(), 0.1).shape == (6, 6, 6)


def test_a_camera():
    depth, pose = torch.full((6, 6), 0.4), se3.identity(dtype=F64)
    pose[:3, 3] = MAP
    intrinsics, mask = pinhole(6, 6, 1.0), torch.ones(6, 6, dtype=torch.bool)
    with pytest.raises(ValueError, match=REFUSED):
        depth_observation(depth, intrinsics, pose, mask)
    settings = ViewSettings(segmentation="mask", edges=None, cluster=False)
    with pytest.raises(ValueError, match=REFUSED):
        view_observation(Image(depth, intrinsics, mask=mask), pose, settings)
    with pytest.raises(ValueError, match=REFUSED):
        cloud_observation(torch.rand(90, 3), pose, settings, mask=torch.ones(90, dtype=torch.bool))
    seen = depth_observation(depth.double(), intrinsics.double(), pose, mask)
    assert float((seen.points - MAP).norm(dim=-1).max()) < 1.0


def test_registration(generator):
    module = Discrepancy(TABLE, 0.1, free_scale=20.0)
    points = torch.rand(30, 3, generator=generator, dtype=F64) * 0.1 + MAP
    few = RegisterSettings(starts=20, polished=5)
    seen = Observation.of(points.float(), Semantics.SURFACE)
    with pytest.raises(ValueError, match="surface points " + REFUSED):
        register(module, seen, 20.0, few, generator=generator)
    near = Observation.of(torch.rand(30, 3, generator=generator) * 0.1, Semantics.SURFACE)
    starts = torch.eye(4).repeat(5, 1, 1)
    starts[:, :3, 3] = 500.0
    with pytest.raises(ValueError, match="starts " + REFUSED):
        register(module, near, 20.0, few, starts=starts, generator=generator)
    # free space that is seen far away tells nothing, and does no harm
    far = torch.tensor([[4000.0, 0.0, 0.0]])
    both = Observation(
        torch.cat((near.points, far)),
        torch.cat((near.semantics, torch.tensor([int(Semantics.FREE)]))),
        torch.ones(31, dtype=torch.bool),
        torch.ones(31, dtype=torch.bool),
    )
    assert len(register(module, both, 20.0, few, generator=generator).frame_T_object) > 0


def test_a_belief(generator):
    poses, points = scene(generator)
    follower = PoseFilter(FilterSettings(motion="measured"), [Discrepancy(TABLE, 0.1, free_scale=20.0)], "SE(3)")

    def step(poses, points):
        reading = Reading(
            Observation.of(points, Semantics.FREE),
            torch.zeros(len(points), dtype=torch.long),
            se3.identity((1,)),
            torch.tensor([False]),
            se3.identity((1,)),
            torch.zeros(3),
            torch.zeros(()),
        )
        return follower(PoseBelief.uniform(poses), Observation.empty(), reading, generator=generator)

    with pytest.raises(ValueError, match="the belief's poses " + REFUSED):
        step(poses.float(), points.float())
    poses[:, :3, 3] -= MAP
    after, _, _ = step(poses.float(), (points - MAP).float())
    assert float(after.world_T_object[:, :3, 3].norm(dim=-1).max()) < 1.0


def test_touches_of_a_far_object_are_found_as_those_of_a_near_one(generator):
    pytest.importorskip("scipy")
    corners = [[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.02, 0.1, 0.0], [0.03, 0.02, 0.07]]
    mesh = TriangleMesh(torch.tensor(corners, dtype=F64), torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    surface = TouchSurface.of(mesh)
    share = torch.rand(20, 3, generator=generator, dtype=F64)
    share = share / share.sum(-1, keepdim=True)
    points = (share[..., None] * mesh.corners[torch.arange(20) % 4]).sum(1)
    settings = LocalizeSettings(starts=300)
    here, there = (
        localize(surface, at, settings=settings, generator=torch.Generator().manual_seed(0))
        for at in (points, points + MAP)
    )
    assert len(here.world_T_object) == len(there.world_T_object)
    torch.testing.assert_close(there.world_T_object[0, :3, 3] - MAP, here.world_T_object[0, :3, 3], atol=1e-6, rtol=0)
    torch.testing.assert_close(there.world_T_object[0, :3, :3], here.world_T_object[0, :3, :3], atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match=re.escape("Expected points within 83.9 m of the origin")):
        localize(surface, (points + MAP).float(), settings=settings)
