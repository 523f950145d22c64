"""Compiled pushes pass over points of the tool that cannot be nearest, and find what a look at every point finds."""

import pytest
import torch

from rumi.dynamics.along_path import Pusher, push_along_path
from rumi.dynamics.outline import GridOutline, RectangleOutline
from rumi.dynamics.sliding import Sliding
from rumi.robot.gripper import GripperShape
from sdf import backend
from sdf.primitives import Mug

MUG = GridOutline.of_slice(Mug().double(), 0.05)


@pytest.mark.parametrize("outline", [RectangleOutline((0.03, 0.08)), MUG], ids=["rectangle", "mug"])
def test_points_passed_over_are_not_nearer(outline: GridOutline | RectangleOutline, generator: torch.Generator) -> None:
    scale = torch.tensor([0.08, 0.08, 2.0], dtype=torch.float64)
    poses = scale * torch.randn(200, 3, generator=generator, dtype=torch.float64)
    path = torch.tensor([[-0.08, 0.01, 0.3], [-0.06, 0.0, 0.4], [-0.04, 0.0, 0.2]], dtype=torch.float64)
    slides = Sliding(poses.new_zeros(2), poses.new_tensor(0.04), poses.new_tensor(0.3))
    pusher = Pusher(GripperShape().outline(0.005).double())
    found = []
    for version in ("torch", "numba"):
        with backend.force(version):
            found.append(push_along_path(poses, path[None], pusher, outline, slides))
    torch.testing.assert_close(found[1].track, found[0].track, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(found[1].distance, found[0].distance, rtol=0.0, atol=1e-9)
    moved = (found[0].track[:, -1] != poses).any(-1)
    assert bool(moved.any())
    assert not bool(moved.all())
