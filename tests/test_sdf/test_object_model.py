import math
from dataclasses import FrozenInstanceError

import pytest
import torch

from sdf.object_model import box_model, mug_model
from sdf.primitives import Box, Mug, Sphere, Union
from sdf.surface import sample_surface


@pytest.fixture(scope="module")
def mug():
    return mug_model()


def share(mask: torch.Tensor) -> float:
    return mask.double().mean().item()


def test_surface_points_lie_on_the_surface_and_normals_stand_on_it(mug):
    assert mug.surface_points.shape == mug.surface_normals.shape == (500, 3)
    points, normals = mug.surface_points.double(), mug.surface_normals.double()
    assert mug.exact.distance(points).abs().max() < 1e-7
    assert torch.allclose(normals.norm(dim=-1), torch.ones(500, dtype=torch.float64), atol=1e-6)
    # one point or two lie so near to where parts meet that another surface is nearer
    outside, inside = (mug.exact.distance(points + side * 1e-4 * normals) for side in (1, -1))
    assert (outside > 0).all() and (inside < 0).all()
    assert share((outside - 1e-4).abs() < 1e-6) > 0.99 and share((inside + 1e-4).abs() < 1e-6) > 0.99


def test_surface_points_follow_area(mug):
    """Areas in closed form; the handle's share is small and must not be missed."""
    x, z = mug.surface_points[:, 0], mug.surface_points[:, 2]
    radius = mug.surface_points[:, :2].norm(dim=-1)
    shape = mug.exact
    # the tube, and at both ends a zone of the round tip, as far as the wall
    start = shape.tube_radius - 0.9 * shape.wall
    handle_area = 2 * math.pi * shape.tube_radius * 2 * (shape.half_angle * shape.ring_radius + start)
    joints = 2 * math.pi * (shape.tube_radius**2 - start**2)
    inner = 0.037
    areas = {
        "outer wall": 2 * math.pi * 0.041 * 0.095 - joints,
        "inner wall": 2 * math.pi * inner * 0.091,
        "bottom": math.pi * 0.041**2,
        "floor": math.pi * inner**2,
        "rim": math.pi * (0.041**2 - inner**2),
        "handle": handle_area,
    }
    on = {
        "outer wall": (radius - 0.041).abs() < 1e-6,
        "inner wall": ((radius - inner).abs() < 1e-6) & (z > 0.004),
        "bottom": z.abs() < 1e-6,
        "floor": ((z - 0.004).abs() < 1e-6) & (radius < inner),
        "rim": (z - 0.095).abs() < 1e-6,
        "handle": (radius > 0.0411) & (x > 0),
    }
    total = sum(areas.values())
    for name, area in areas.items():
        assert share(on[name]) == pytest.approx(area / total, abs=0.01), name
    assert share(on["handle"]) == pytest.approx(0.0597, abs=0.006)


def test_same_seed_same_points(mug):
    again, other = mug_model(), mug_model(seed=1)
    assert torch.equal(again.surface_points, mug.surface_points)
    assert torch.equal(again.sdf.values, mug.sdf.values)
    assert not torch.equal(other.surface_points, mug.surface_points)


def test_the_filters_table_is_not_the_metrics_shape(mug):
    points = mug.surface_points
    assert mug.exact.distance(points).abs().max() < 1e-6
    error = mug.sdf.distance(points).abs()
    assert 1e-5 < error.mean() < 1e-4


def test_sizes(mug):
    assert mug.name == "mug"
    assert mug.diagonal == pytest.approx(0.1723, abs=1e-4)
    # no corner of the mug is farther than the rim's outer edge
    assert 0.099 < mug.radius <= math.hypot(0.041, 0.095) + 1e-6
    assert mug.symmetries.trivial
    large = mug_model(points=50, spacing=0.004, mug=Mug(tube_radius=0.008, ring_radius=0.035))
    assert large.exact.bounds[1, 0].item() == pytest.approx(0.084)
    with pytest.raises(FrozenInstanceError):
        mug.name = "cup"


def test_box_symmetries_leave_the_box_as_it_is():
    box = box_model(spacing=0.005, points=200)
    assert box.symmetries.rotations.shape == (4, 3, 3)
    assert torch.equal(box.symmetries.rotations[0], torch.eye(3))
    assert torch.equal(torch.linalg.det(box.symmetries.rotations), torch.ones(4))
    points = 0.2 * torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    for rotation in box.symmetries.rotations:
        assert torch.allclose(box.exact.distance(points @ rotation.T), box.exact.distance(points))
    assert torch.equal(box.exact.bounds[1], torch.tensor([0.030, 0.079, 0.105]))
    with pytest.raises(ValueError, match="three different half_extents"):
        box_model((0.1, 0.1, 0.2))


def test_to_copies(mug):
    double = mug.to("cpu", torch.float64)
    assert double.surface_points.dtype == double.sdf.values.dtype == double.exact.bounds.dtype == torch.float64
    assert mug.surface_points.dtype == mug.sdf.values.dtype == mug.exact.bounds.dtype == torch.float32
    assert double.sdf is not mug.sdf
    assert double.symmetries.rotations.dtype == double.symmetries.center.dtype == torch.float64


def test_samples_of_a_sphere_are_uniform(generator):
    points, normals = sample_surface(Sphere(0.1), 2000, generator=generator)
    assert torch.allclose(points.norm(dim=-1), torch.full((2000,), 0.1, dtype=torch.float64), atol=1e-9)
    assert torch.allclose(normals, points / 0.1, atol=1e-6)
    # a zone's area is that of the cylinder around it (Archimedes)
    heights = points[:, 2].sort().values / 0.1
    uniform = (torch.arange(2000) + 0.5) / 1000 - 1
    assert (heights - uniform).abs().max() < 0.05


def test_no_samples_inside_a_union(generator):
    overlapping = Union((Box((0.1, 0.1, 0.1)), Sphere(0.12)))
    points, _ = sample_surface(overlapping, 300, generator=generator)
    assert overlapping.distance(points).abs().max() < 1e-7
    assert (Box((0.1, 0.1, 0.1)).distance(points) > -1e-7).all()


def test_nothing_to_sample_is_an_error(generator):
    class Nothing(Sphere):
        def distance(self, points_o):
            return 1.0 + points_o.square().sum(-1)

    with pytest.raises(ValueError, match="Expected a count of 1 or more surface points, got 0"):
        sample_surface(Sphere(0.1), 0, generator=generator)
    with pytest.raises(ValueError, match="Expected a surface within bounds"):
        sample_surface(Nothing(0.1), 10, generator=generator)
