"""Swept space: points of one place are told once while nothing is felt, and ride with an object that is followed."""

import torch

from rumi.tasks.rummage.swept_space import SweptSpace
from sdf import se3

BOUNDS = ((-1.0, -1.0), (1.0, 1.0))
REGION = torch.tensor([[-0.2, -0.2, 0.0], [0.2, 0.2, 0.3]])
BODY = torch.tensor([[0.0, 0.0, 0.1]])
SILENT = torch.zeros(3, dtype=torch.bool)


def poses(*x: float) -> torch.Tensor:
    made = torch.eye(4).repeat(len(x), 1, 1)
    made[:, 0, 3] = torch.tensor(x)
    return made


def test_a_place_is_told_once_until_something_is_felt():
    there_and_back = poses(0.502, 0.522, 0.502)
    points, index = SweptSpace(BOUNDS, 0.005).swept(there_and_back, BODY, None, SILENT, REGION)
    assert sorted(points.instant.tolist()) == [0, 1] and index.tolist() == [
        0,
        0,
    ]  # out of the region, which does not count
    felt = torch.tensor([False, True, True])
    points, _ = SweptSpace(BOUNDS, 0.005).swept(there_and_back, BODY, None, felt, REGION)
    assert sorted(points.instant.tolist()) == [0, 1, 2]


def test_what_is_followed_carries_its_region_and_its_cells_along_from_action_to_action():
    space = SweptSpace(BOUNDS, 0.005)
    moved = torch.stack((se3.identity(), *poses(0.1, 0.2)))
    back = space.ridden(moved)
    torch.testing.assert_close(back, se3.inverse(moved))
    torch.testing.assert_close(space.ridden(se3.identity((1,))), se3.inverse(poses(0.2)))
    # the tool goes with it: one cell of its own frame, which lies in its region
    still = se3.identity((3,))
    points, _ = space.swept(poses(0.302, 0.302, 0.302), BODY, still, SILENT, REGION)
    assert points.instant.tolist() == [0]
    # what lies beyond the region that rides is not told
    points, _ = space.swept(poses(-0.102, -0.102, -0.102), BODY, still, SILENT, REGION)
    assert points.instant.tolist() == []
