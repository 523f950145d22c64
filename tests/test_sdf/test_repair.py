"""Meshes put right: against boxes and balls in closed form."""

import numpy as np
import pytest
import torch

from sdf.mesh.mesh import MeshError, TriangleMesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.mesh.openings import close_openings, open_rings
from sdf.mesh.repair import enclosed_volume, repaired
from sdf.primitives import Box

pytest.importorskip("scipy")

HALF = (0.03, 0.04, 0.05)
VOLUME = 8 * 0.03 * 0.04 * 0.05


def spread(count, generator, size=0.08):
    return size * (2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1)


def assert_is_the_box(mesh, generator, atol=1e-9):
    points = spread(2000, generator)
    torch.testing.assert_close(MeshSDF(mesh).distance(points), Box(HALF).double().distance(points), atol=atol, rtol=0)


def test_a_good_mesh_stays_as_it_is(shapes, generator):
    box = shapes.box()
    found = repaired(box)
    assert torch.equal(found.solid.faces, box.faces) and found.closed and not found.openings
    assert (found.duplicates, found.degenerate, found.hidden_share, found.detail) == (0, 0, 0.0, 0.0)
    assert found.orientation.parts == 1
    assert found.volume == pytest.approx(VOLUME)
    assert_is_the_box(box, generator)


def test_inside_out(shapes, generator):
    found = repaired(shapes.turned(shapes.box()))
    assert (found.orientation.turned_parts, found.orientation.turned_faces) == (1, 0)
    assert found.volume == pytest.approx(VOLUME)
    assert_is_the_box(shapes.turned(shapes.box()), generator)


def test_some_faces_turned(shapes, generator):
    mesh = shapes.turned(shapes.box(), [0, 3, 7])
    found = repaired(mesh)
    assert (found.orientation.turned_parts, found.orientation.turned_faces) == (0, 3)
    assert_is_the_box(mesh, generator)


def test_faces_twice_either_way_round(shapes, generator):
    box = shapes.box()
    double = TriangleMesh(box.vertices, torch.cat((box.faces, box.faces.flip(-1), box.faces[:3].roll(1, -1))))
    found = repaired(double)
    assert found.duplicates == 15
    assert_is_the_box(double, generator)


def test_faces_without_area(shapes, generator):
    box = shapes.box()
    a, b = box.faces[0, :2]
    bad = torch.stack((torch.stack((a, a, b)), torch.stack((a, b, b))))
    mesh = TriangleMesh(box.vertices, torch.cat((box.faces, bad)))
    assert repaired(mesh).degenerate == 2
    assert_is_the_box(mesh, generator)


def test_a_side_cut_by_a_vertex_on_an_edge(shapes, generator):
    """The edge's other side does not have that vertex: an opening of no width."""
    box = shapes.box()
    a, b, c = box.faces[0].tolist()
    middle = 0.5 * (box.vertices[a] + box.vertices[b])
    faces = torch.cat((box.faces[1:], torch.tensor([[a, 8, c], [8, b, c]])))
    mesh = TriangleMesh(torch.cat((box.vertices, middle[None])), faces)
    found = repaired(mesh)
    assert len(found.openings) == 1
    assert found.volume == pytest.approx(VOLUME)
    assert_is_the_box(mesh, generator)


@pytest.mark.parametrize("missing", [(0,), (0, 1), (2, 3), (0, 5, 9)])
def test_openings_are_closed(shapes, generator, missing):
    mesh = shapes.without(shapes.box(), *missing)
    found = repaired(mesh)
    assert found.closed and all(opening.closed for opening in found.openings)
    if missing != (0, 5, 9):  # whose rings turn round corners, so that flat fans cut these off
        assert found.volume == pytest.approx(VOLUME)
        assert_is_the_box(mesh, generator)
    assert len(open_rings(found.solid.faces.numpy())) == 0


def test_rings_that_touch_are_taken_apart():
    """A square's ring of four triangles about its middle, two opposite ones missing: rings that meet in the middle."""
    faces = np.array([[0, 1, 4], [2, 3, 4]])
    rings = open_rings(faces)
    assert sorted(sorted(ring.tolist()) for ring in rings) == [[0, 1, 4], [2, 3, 4]]
    for ring in rings:
        edges = {(a, b) for a, b in zip(ring.tolist(), np.roll(ring, -1).tolist(), strict=True)}
        assert edges <= {(0, 1), (1, 4), (4, 0), (2, 3), (3, 4), (4, 2)}


def test_a_ring_of_any_form_is_closed(shapes, generator):
    """Whatever is cut out of a ball, each edge is left with faces on both sides that agree."""
    ball = shapes.sphere(rings=10)
    keep = torch.rand(len(ball.faces), generator=generator) > 0.3
    closed = close_openings(ball.vertices.numpy(), ball.faces[keep].numpy())
    assert closed.openings
    if closed.closed:
        assert open_rings(closed.faces) == []
    open_share = sum(not opening.closed for opening in closed.openings) / len(closed.openings)
    assert open_share < 0.2


def test_sides_that_are_not_joined_have_an_inside_still(shapes, generator):
    """Six loose squares: their fans would lie upon them, so that all depends on the winding number."""
    box = shapes.box()
    sides = [shapes.without(box, *(k for k in range(12) if k // 2 != side)) for side in range(6)]
    loose = shapes.together(*sides)
    found = repaired(loose)
    assert not found.closed and not any(opening.closed for opening in found.openings)
    assert found.orientation.parts == 6
    assert_is_the_box(loose, generator)


def test_a_hollow_stays_hollow(shapes):
    inner = shapes.turned(shapes.box((0.02, 0.02, 0.02)))
    for mesh in (shapes.together(shapes.box(), inner), shapes.turned(shapes.together(shapes.box(), inner))):
        found = repaired(mesh)
        assert found.orientation.cavities == 1
        distance = MeshSDF(mesh).distance(torch.tensor([[0.0, 0.0, 0.0], [0.025, 0.0, 0.0], [0.04, 0.0, 0.0]]))
        torch.testing.assert_close(distance, torch.tensor([0.02, -0.005, 0.01]))


def test_one_part_of_two_inside_out(shapes):
    mesh = shapes.together(shapes.box(), shapes.turned(shapes.box(center=(0.1, 0.0, 0.0))))
    found = repaired(mesh)
    assert (found.orientation.parts, found.orientation.turned_parts, found.orientation.cavities) == (2, 1, 0)
    assert float(MeshSDF(mesh).distance(torch.tensor([[0.1, 0.0, 0.0]]))[0]) == pytest.approx(-0.03)


def test_overlapping_parts_are_one_solid(shapes, generator):
    """Two boxes that share more than half of their length are one box of known size; inner sides are no surface."""
    low, high = (shapes.box((0.03, 0.04, 0.03), (0.0, 0.0, z)) for z in (-0.02, 0.02))
    mesh = shapes.together(low, high)
    found = repaired(mesh)
    sides = 2 * (0.06 * 0.06 + 0.08 * 0.06)
    ends = 4 * 0.06 * 0.08
    # two ends are inside
    assert found.hidden_share == pytest.approx(0.5 * ends / (2 * sides + ends), rel=0.02)
    points = spread(2000, generator)
    exact = Box(HALF).double().distance(points)
    error = (MeshSDF(mesh).distance(points) - exact).abs()
    assert float(error.max()) < 1e-9


def test_parts_that_cross(shapes, generator):
    """A bar through a slab: the depth within is that of the union, to where pieces are cut."""
    mesh = shapes.together(shapes.box((0.05, 0.05, 0.01)), shapes.box((0.01, 0.01, 0.05)))
    found = repaired(mesh)
    assert found.hidden_share > 0.01
    assert 0 < found.detail < 0.001
    parts = [Box((0.05, 0.05, 0.01)).double(), Box((0.01, 0.01, 0.05)).double()]
    points = spread(4000, generator, 0.06)
    exact = torch.stack([part.distance(points) for part in parts]).amin(0)
    error = MeshSDF(mesh).distance(points) - exact
    outside = exact > 0
    assert float(error[outside].abs().max()) < 1e-9
    # inside, a part's own distance is a bound only; the middle is further from the surface than from either's sides
    assert float(error[~outside].max()) < found.detail
    middle = MeshSDF(mesh).distance(torch.zeros(1, 3, dtype=torch.float64))
    assert float(middle[0]) == pytest.approx(-((0.01**2 + 0.01**2) ** 0.5), abs=found.detail)


@pytest.mark.parametrize("faces", [[[0, 1, 2]], [[0, 1, 2], [0, 2, 1]], [[0, 0, 1]]])
def test_sheets_are_refused(faces):
    vertices = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
    with pytest.raises(MeshError, match=r"encloses a volume|different corners"):
        repaired(TriangleMesh(vertices, torch.tensor(faces)))


def test_volume(shapes):
    assert enclosed_volume(shapes.box(center=(5.0, 0.0, 0.0)).corners) == pytest.approx(VOLUME)
    assert enclosed_volume(shapes.tetrahedron(0.06).corners) == pytest.approx(0.06**3 / (6 * 2**0.5))
