"""What touching says of space, against slow loops."""

import math

import pytest
import torch

from sdf import backend, se3
from sensors.semantics import Semantics
from sensors.touch.tactile import InstantPoints, points_in_box, swept_points, tactile_observation, touched_points

REGION = torch.tensor([[0.0, -0.1, 0.0], [0.2, 0.1, 0.08]], dtype=torch.float64)


def poses(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randn(count, 6, generator=generator, dtype=torch.float64) * torch.tensor(
        [0.01, 0.01, 0.0, 0.0, 0.0, 0.2], dtype=torch.float64
    )
    start = torch.tensor([0.1, 0.0, 0.04, 0.0, 0.0, 0.3], dtype=torch.float64)
    return se3.exp(start + steps.cumsum(0))


def body(count=60, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5) * 0.06


def test_touched_points_against_a_loop():
    world_T_tool, pads = poses(4), body()
    touched = torch.rand(4, len(pads), generator=torch.Generator().manual_seed(2)) < 0.2
    found = touched_points(world_T_tool, pads, touched)
    expected = [
        (k, (world_T_tool[k] @ torch.cat((pads[i], torch.ones(1).double())))[:3])
        for k in range(4)
        for i in range(len(pads))
        if touched[k, i]
    ]
    assert found.instant.tolist() == [k for k, _ in expected]
    torch.testing.assert_close(found.points, torch.stack([p for _, p in expected]))


def test_nothing_touched():
    found = touched_points(poses(3), body(), torch.zeros(3, 60, dtype=torch.bool))
    assert found.points.shape == (0, 3) and found.instant.shape == (0,)


@pytest.mark.parametrize("version", backend.versions("first_in_cells"))
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("grouped", [False, True])
def test_swept_points_against_a_loop(moving, grouped, version):
    world_T_tool, points = poses(6), body()
    attached_T_world = se3.inverse(poses(6, seed=3)) @ poses(1, seed=3)[0] if moving else None
    group = torch.tensor([0, 0, 1, 2, 2, 2]) if grouped else None
    with backend.force(version):
        found, index = swept_points(
            world_T_tool, points, 0.01, attached_T_world=attached_T_world, group=group, region=REGION
        )
    seen, expected = set(), []
    for k in range(6):
        for i, point in enumerate(points):
            world = world_T_tool[k][:3, :3] @ point + world_T_tool[k][:3, 3]
            place = world
            if attached_T_world is not None:
                place = attached_T_world[k][:3, :3] @ world + attached_T_world[k][:3, 3]
            cell = tuple(math.floor(c / 0.01) for c in place.tolist())
            low = [math.floor(float(c) / 0.01) for c in REGION[0]]
            high = [math.ceil(float(c) / 0.01) for c in REGION[1]]
            if any(not a <= c < b for a, c, b in zip(low, cell, high, strict=True)):
                continue
            key = (cell, int(group[k]) if group is not None else 0)
            if key not in seen:
                seen.add(key)
                expected.append((k, i, world))
    assert [(k, i) for k, i, _ in expected] == list(zip(found.instant.tolist(), index.tolist(), strict=True))
    torch.testing.assert_close(found.points, torch.stack([w for _, _, w in expected]))
    assert len(expected) > 20


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_swept_points_of_both_versions_are_equal_also_on_the_borders_of_cells(dtype):
    """Points on the lattice fall to the side to which a division in their own precision rounds them."""
    world_T_tool, points = se3.identity((2,), dtype=dtype), (body(400) / 0.005).round().to(dtype) * 0.005
    points[0] = math.nan
    region = torch.tensor([[-0.02, -0.02, -0.02], [0.02, 0.02, 0.02]], dtype=dtype)
    found = []
    for version in backend.versions("first_in_cells"):
        with backend.force(version):
            found.append(swept_points(world_T_tool, points, 0.005, region=region)[1])
    assert len(found[0]) > 50
    torch.testing.assert_close(found[1], found[0], rtol=0, atol=0)


@pytest.mark.parametrize("version", backend.versions("points_in_box"))
@pytest.mark.parametrize("count", [1, 5])
def test_points_in_a_box_are_those_of_a_loop(count, version):
    transforms, points = poses(count), body(200)
    box = torch.tensor([[0.09, -0.02, 0.0], [0.13, 0.02, 0.05]], dtype=torch.float64)
    with backend.force(version):
        found, index = points_in_box(transforms, points, box)
    expected = []
    for k in range(count):
        for i, point in enumerate(points):
            place = transforms[k][:3, :3] @ point + transforms[k][:3, 3]
            if bool(((place >= box[0]) & (place <= box[1])).all()):
                expected.append((k, i, place))
    assert [(k, i) for k, i, _ in expected] == list(zip(found.instant.tolist(), index.tolist(), strict=True))
    torch.testing.assert_close(found.points, torch.stack([place for _, _, place in expected]))
    assert 10 < len(expected) < 100 * count


def test_standing_still_adds_nothing():
    """Swept from the same place again and again, cells are reported once."""
    still = poses(1).expand(5, 4, 4)
    once, _ = swept_points(still[:1], body(), 0.005, region=REGION)
    again, _ = swept_points(still, body(), 0.005, region=REGION)
    assert len(once.points) == len(again.points)
    assert not bool(again.instant.any())


def test_riding_along_adds_nothing():
    """A tool that moves with the object sweeps nothing new in the object's frame."""
    world_T_tool = poses(5)
    attached_T_world = world_T_tool[0] @ se3.inverse(world_T_tool)
    found, _ = swept_points(world_T_tool, body() + 0.001, 0.01, attached_T_world=attached_T_world, region=REGION)
    first, _ = swept_points(world_T_tool[:1], body() + 0.001, 0.01, region=REGION)
    # rounding may carry a point over a cell's border
    assert len(found.points) - len(first.points) <= 2
    assert float((found.instant == 0).double().mean()) > 0.95


def test_region_far_away_is_empty():
    found, index = swept_points(poses(2), body(), 0.01, region=REGION + 5.0)
    assert len(found.points) == 0 and len(index) == 0


def test_observation_has_both_classes_and_instants():
    touched = InstantPoints(torch.zeros(2, 3), torch.tensor([0, 3]))
    free = InstantPoints(torch.ones(3, 3), torch.tensor([1, 1, 2]))
    observation, instant = tactile_observation(touched, free)
    assert observation.semantics.tolist() == [Semantics.SURFACE] * 2 + [Semantics.FREE] * 3
    assert instant.tolist() == [0, 3, 1, 1, 2]
    assert bool(observation.attached.all()) and bool(observation.valid.all())


def test_bad_mask(no_shape_check):
    with pytest.raises(ValueError, match=r"touched.*got \(60, 2\)"):
        touched_points(poses(2), body(), torch.zeros(60, 2, dtype=torch.bool))


@pytest.mark.parametrize("version", ["torch", "numba"], indirect=True)
def test_poses_and_points_of_another_shape_are_refused(no_shape_check, version):
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    for bad_poses, bad_points in ((torch.zeros(2, 3, 3), torch.zeros(5, 3)), (torch.eye(4)[None], torch.zeros(5, 2))):
        with pytest.raises(ValueError, match="to have shape"):
            points_in_box(bad_poses, bad_points, box)
        with pytest.raises(ValueError, match="to have shape"):
            swept_points(bad_poses, bad_points, 0.01, region=box)
