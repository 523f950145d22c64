"""The nearest triangle and the winding number: closed forms, and the versions against each other."""

import math

import pytest
import torch

from sdf import backend
from sdf.mesh.tree import build_tree, split_long
from sdf.mesh.triangles import Triangles, area_vectors, nearest, solid_angle, winding_number
from sdf.primitives import Box

# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def spread(count, generator, size=0.08):
    return size * (2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1)


def test_distance_to_a_box(shapes, generator):
    points = spread(3000, generator)
    found = nearest(points, Triangles(shapes.box().corners))
    exact = Box((0.03, 0.04, 0.05)).double().distance(points).abs()
    torch.testing.assert_close((points - found.point).norm(dim=-1), exact, atol=1e-9, rtol=0)


def test_the_point_lies_on_the_triangle_that_is_named(shapes, generator):
    triangles = Triangles(shapes.sphere(rings=8).corners)
    found = nearest(spread(500, generator), triangles)
    a, b, c = triangles.corners[found.face].unbind(-2)
    parts = [area_vectors(torch.stack((p, q, found.point), -2)).norm(dim=-1) for p, q in ((a, b), (b, c), (c, a))]
    torch.testing.assert_close(sum(parts), area_vectors(torch.stack((a, b, c), -2)).norm(dim=-1), atol=1e-12, rtol=0)


def test_winding_number_of_a_box_is_whole(shapes, generator):
    points = spread(3000, generator)
    inside = (Box((0.03, 0.04, 0.05)).double().distance(points) < 0).double()
    around = winding_number(points, Triangles(shapes.box().corners), accuracy=math.inf)
    torch.testing.assert_close(around, inside, atol=1e-9, rtol=0)


def test_solid_angle_of_an_octant():
    corners = torch.eye(3, dtype=torch.float64)[None]
    assert float(solid_angle(torch.zeros(1, 3, dtype=torch.float64), corners)[0]) == pytest.approx(4 * math.pi / 8)
    around = winding_number(torch.zeros(1, 3, dtype=torch.float64), Triangles(corners), accuracy=math.inf)
    assert float(around[0]) == pytest.approx(1 / 8)


def test_overlapping_parts_wind_twice_and_an_open_one_in_part(shapes):
    middle = torch.zeros(1, 3, dtype=torch.float64)
    twice = shapes.together(shapes.box(), shapes.sphere())
    assert float(winding_number(middle, Triangles(twice.corners), accuracy=math.inf)[0]) == pytest.approx(2)
    # a cube without one side, seen from its middle, lacks a sixth
    open_cube = shapes.without(shapes.box((0.04,) * 3), 0, 1)
    assert float(winding_number(middle, Triangles(open_cube.corners), accuracy=math.inf)[0]) == pytest.approx(5 / 6)


def test_groups_as_dipoles_err_little(shapes, generator):
    points = spread(400, generator, 0.12)
    triangles = Triangles(shapes.sphere(rings=24).corners)
    error = winding_number(points, triangles) - winding_number(points, triangles, accuracy=math.inf)
    assert float(error.abs().max()) < 0.05
    closer = winding_number(points, triangles, accuracy=6.0) - winding_number(points, triangles, accuracy=math.inf)
    assert float(closer.abs().max()) < 0.01


def random_triangles(count, generator):
    return 0.02 * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 2, 9, 200])
def test_versions_agree(generator, version, dtype, count):
    corners = random_triangles(count, generator)
    if count > 2:  # degenerate ones: a point, a line, one twice
        corners[0] = corners[0, :1]
        corners[1, 2] = 0.5 * (corners[1, 0] + corners[1, 1])
        corners[2] = corners[3 % count]
    triangles, points = Triangles(corners), spread(400, generator).to(dtype)
    gap = (points - nearest(points, triangles).point).norm(dim=-1)
    around = winding_number(points, triangles, accuracy=math.inf)
    assert gap.dtype == around.dtype == dtype
    with backend.force("torch"):
        expected = (points.double() - nearest(points.double(), triangles).point).norm(dim=-1)
        whole = winding_number(points.double(), triangles)
    exact = 1e-5 if dtype == torch.float32 else 1e-10
    torch.testing.assert_close(gap.double(), expected, atol=exact, rtol=0)
    torch.testing.assert_close(around.double(), whole, atol=100 * exact, rtol=0)


def test_any_batch_of_points_and_none(shapes):
    triangles = Triangles(shapes.box().corners)
    points = torch.zeros(2, 3, 4, 3, dtype=torch.float64)
    assert nearest(points, triangles).point.shape == (2, 3, 4, 3)
    assert nearest(points, triangles).face.shape == winding_number(points, triangles).shape == (2, 3, 4)
    assert winding_number(points[:0], triangles).shape == (0, 3, 4)
    assert nearest(points[:0], triangles).face.shape == (0, 3, 4)


def test_on_a_corner_nothing_breaks(shapes):
    mesh = shapes.box()
    found = nearest(mesh.vertices, Triangles(mesh.corners))
    torch.testing.assert_close(found.point, mesh.vertices)
    assert bool(torch.isfinite(winding_number(mesh.vertices, Triangles(mesh.corners))).all())


def test_bad_arguments(shapes, no_shape_check):
    triangles = Triangles(shapes.box().corners)
    with pytest.raises(ValueError, match="points"):
        nearest(torch.zeros(3, 2), triangles)
    with pytest.raises(ValueError, match="accuracy"):
        winding_number(torch.zeros(1, 3), triangles, accuracy=0.5)
    with pytest.raises(ValueError, match="one triangle"):
        Triangles(torch.zeros(0, 3, 3))


def test_gradients(shapes, generator, version):
    if version != "torch":
        pytest.skip("the plain version is what differentiates")
    triangles = Triangles(shapes.tetrahedron().corners)
    points = spread(6, generator).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: winding_number(x, triangles), points)
    assert torch.autograd.gradcheck(lambda x: (x - nearest(x, triangles).point).norm(dim=-1), points)


def test_tensors_with_a_graph_run_plain(shapes, generator):
    triangles = Triangles(shapes.tetrahedron().corners)
    points = spread(6, generator)
    backend_names = backend.versions("winding_number")
    assert backend_names == backend.versions("nearest_triangle") == ["torch", "numba"]
    with pytest.raises(ValueError, match="supports"), backend.force("numba"):
        winding_number(points.requires_grad_(), triangles)


def test_the_tree_holds_what_it_says(generator):
    corners = random_triangles(101, generator).numpy()
    corners[5] *= 30.0
    tree = build_tree(corners)
    leaves = len(tree.boxes) // 2
    pieces = tree.corners.reshape(leaves, -1, 3, 3)
    for node in range(1, 2 * leaves):
        level = node.bit_length() - 1
        held = pieces.reshape(1 << level, -1, 3)[node - (1 << level)]
        assert (tree.boxes[node, :3] == held.min(0)).all() and (tree.boxes[node, 3:] == held.max(0)).all()
        away = ((held - tree.dipoles[node, :3]) ** 2).sum(-1).max() ** 0.5
        assert tree.dipoles[node, 6] == pytest.approx(away)
    every = area_vectors(torch.from_numpy(corners)).sum(0)
    torch.testing.assert_close(torch.from_numpy(tree.dipoles[1, 3:6]), every)


def test_long_triangles_are_split_and_cover_the_same(generator):
    corners = random_triangles(20, generator).numpy()
    pieces, owner = split_long(corners, 0.01)
    sides = torch.from_numpy(pieces)
    assert float((sides.roll(-1, 1) - sides).norm(dim=-1).max()) <= 0.01
    total = torch.zeros(20, 3, dtype=torch.float64).index_add_(0, torch.from_numpy(owner), area_vectors(sides))
    torch.testing.assert_close(total, area_vectors(torch.from_numpy(corners)))
