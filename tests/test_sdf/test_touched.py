"""Which triangle a touch came from."""

import pytest
import torch

from sdf import backend, compiled
from sdf.mesh.touched import touched_face
from sdf.mesh.triangles import Triangles, closest_point, nearest


def triangles(count=60, dtype=torch.float64):
    return Triangles(0.1 * torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0), dtype=dtype))


def touches(shape, dtype=torch.float64):
    generator = torch.Generator().manual_seed(1)
    points = 0.15 * torch.randn(*shape, 3, generator=generator, dtype=dtype)
    normals = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=generator, dtype=dtype), dim=-1)
    return points, normals


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


@pytest.mark.parametrize("reach", [0.01, 0.05, 1.0])
def test_both_parts_count_for_one_triangle(reach):
    faces = triangles()
    points, normals = touches((5, 40))
    found = touched_face(points, normals, faces, reach)
    places = closest_point(points[..., None, :], faces.corners)
    cost = (points[..., None, :] - places).square().sum(-1)
    cost = cost + reach**2 * (normals[..., None, :] - faces.normals).square().sum(-1)
    own = cost.gather(-1, found.face[..., None])[..., 0]
    assert torch.allclose(own, cost.amin(-1), atol=1e-14)
    assert torch.allclose(closest_point(points, faces.corners[found.face]), found.point, atol=1e-12)


def test_without_reach_it_is_the_nearest():
    faces = triangles()
    points, normals = touches((50,))
    assert torch.equal(touched_face(points, normals, faces, 0.0).face, nearest(points, faces).face)


def test_a_thin_plate_is_touched_on_the_side_that_the_normal_says():
    square = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0.001], [0, 1, 0.001], [1, 0, 0.001]]])
    square = square.double()
    faces = Triangles(square.flip(0))  # 0: at 1 mm, facing down; 1: at 0, facing up
    points = torch.tensor([[0.2, 0.2, 0.0006]] * 2, dtype=torch.float64)
    normals = torch.tensor([[0.0, 0, 1], [0, 0, -1]], dtype=torch.float64)
    assert touched_face(points, normals, faces, 0.05).face.tolist() == [1, 0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(200,), (3, 7), (0,)])
@pytest.mark.parametrize("count", [1, 60])
def test_versions_agree(dtype, shape, count):
    if not compiled.available():
        pytest.skip("without numba")
    faces, (points, normals) = triangles(count, dtype), touches(shape, dtype)
    with backend.force("torch"):
        one = touched_face(points, normals, faces, 0.03)
    with backend.force("numba"):
        two = touched_face(points, normals, faces, 0.03)
    assert one.point.dtype == two.point.dtype == dtype and one.face.shape == two.face.shape == shape
    rough = 1e-5 if dtype == torch.float32 else 1e-12
    assert torch.allclose(one.point, two.point, atol=rough)


def test_a_triangle_without_area():
    flat = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 0, 1.0], [1, 0, 1], [0, 1, 1]]]).double()
    points = torch.tensor([[0.5, 0.1, 0.0]], dtype=torch.float64)
    found = touched_face(points, torch.tensor([[0.0, 0.0, 1.0]]).double(), Triangles(flat), 0.01)
    assert found.face.tolist() == [0] and torch.allclose(found.point, torch.tensor([[0.5, 0.0, 0.0]]).double())


def test_gradient_reaches_the_points():
    faces = triangles()
    points, normals = touches((4,))
    with backend.force("torch"):
        free = points.clone().requires_grad_()
        gap = (free - touched_face(free, normals, faces, 0.03).point).square().sum()
        (slope,) = torch.autograd.grad(gap, free)
    assert torch.allclose(slope, 2.0 * (points - touched_face(points, normals, faces, 0.03).point), atol=1e-9)


def test_what_cannot_be(no_shape_check):
    points, normals = touches((4,))
    with pytest.raises(ValueError, match="a normal for every point"):
        touched_face(points, normals[:2], triangles(), 0.1)
    with pytest.raises(ValueError, match="reach of 0 or more"):
        touched_face(points, normals, triangles(), -0.1)
