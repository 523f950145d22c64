"""The robot's own body among the points that its sensors see."""

import pytest
import torch

from sdf import se3
from sdf.primitives import Box, Capsule, Sphere
from sensors.vision.robot_body import RobotBody


def test_points_near_any_link_are_found_as_by_distance_alone():
    random = torch.Generator().manual_seed(0)
    links = [Sphere(0.1), Box((0.05, 0.1, 0.2)), Capsule((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 0.03)]
    tangents = torch.randn(3, 6, generator=random) * torch.tensor([0.1] * 3 + [1.0] * 3)
    poses = se3.exp(tangents)
    points = 2.0 * torch.randn(4000, 3, generator=random)
    points[:2000] *= 0.2
    expected = torch.zeros(4000, dtype=torch.bool)
    for link, pose in zip(links, poses, strict=True):
        expected |= link.distance(se3.apply(se3.inverse(pose), points)) <= 0.02
    found = RobotBody(links).near(points, poses, 0.02)
    assert torch.equal(found, expected) and 20 < int(found.sum()) < 2000


def test_a_wider_margin_takes_more_and_no_links_nothing():
    points = torch.tensor([[0.105, 0.0, 0.0], [0.15, 0.0, 0.0]])
    body = RobotBody([Sphere(0.1)])
    assert body.near(points, torch.eye(4)[None], 0.01).tolist() == [True, False]
    assert body.near(points, torch.eye(4)[None], 0.06).tolist() == [True, True]
    assert not bool(RobotBody([]).near(points, torch.zeros(0, 4, 4)).any())


def test_a_pose_a_link(no_shape_check):
    with pytest.raises(ValueError, match="world_T_links"):
        RobotBody([Sphere(0.1)]).near(torch.zeros(1, 3), torch.eye(4).repeat(2, 1, 1))
    with pytest.raises(ValueError, match="finite"):
        RobotBody([Sphere(0.1)]).near(torch.zeros(1, 3), torch.full((1, 4, 4), float("nan")))
