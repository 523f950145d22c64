"""The meshes to measure with, and the script that measures."""

import pytest
import torch

from scripts import mesh_distances
from scripts.bench import meshes
from scripts.bench.mug_mesh import mug_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Cup, Mug

pytest.importorskip("scipy")


def test_the_cup_is_the_closed_forms(generator):
    mug = Mug()
    cup = meshes.cup_part(mug, 360)
    shape = MeshSDF(cup)
    assert shape.repair.closed and shape.repair.orientation.turned_parts == 0
    exact = Cup(mug.outer_radius, mug.height, mug.wall, mug.base).double()
    points = 0.06 * torch.randn(2000, 3, generator=generator, dtype=torch.float64)
    # chords lie within the circle by its radius less its apothem
    assert float((shape.distance(points) - exact.distance(points)).abs().max()) < 2e-6
    sides = cup.corners.roll(-1, 1) - cup.corners
    assert float(sides.norm(dim=-1).amax() / sides.norm(dim=-1).amin(-1).amin()) > 100  # long and narrow


def test_parts_are_taken_apart_and_put_together(generator):
    whole = mug_mesh(Mug())
    cup, handle = meshes.parts_of(whole)
    assert len(cup.faces) + len(handle.faces) == len(whole.faces)
    assert float(handle.bounds[0, 0]) > 0.036 > float(cup.bounds[0, 0])
    again = meshes.together(cup, handle)
    torch.testing.assert_close(again.corners.sum((0, 1)), whole.corners.sum((0, 1)))


def test_solids_are_what_they_say(generator):
    points = 0.05 * torch.randn(500, 3, generator=generator, dtype=torch.float64)
    box = MeshSDF(meshes.box((0.02, 0.03, 0.04)))
    torch.testing.assert_close(box.distance(points), Box((0.02, 0.03, 0.04)).double().distance(points))
    tetrahedron = MeshSDF(meshes.tetrahedron(0.06))
    assert float(tetrahedron.distance(torch.zeros(1, 3))) == pytest.approx(-0.06 / 24**0.5, rel=1e-5)


def test_faces_are_turned_by_share(generator):
    mesh = meshes.box((0.02, 0.03, 0.04))
    assert torch.equal(meshes.turned(mesh, generator=generator).faces, mesh.faces.flip(-1))
    assert torch.equal(meshes.turned(mesh, 0.0, generator=generator).faces, mesh.faces)


def test_one_surface_lies_on_the_closed_form():
    pytest.importorskip("igl")
    mug = Mug().double()
    mesh = meshes.one_surface(mug, 0.003)
    assert float(mug.distance(mesh.vertices).abs().max()) < 1e-9
    repair = MeshSDF(mesh).repair
    assert repair.closed and repair.orientation.parts == 1 and repair.hidden_share == 0


def test_shapes_are_measured_and_shown(monkeypatch):
    pytest.importorskip("igl")
    monkeypatch.setattr(mesh_distances, "SPACINGS_MM", (5.0,))
    lines = []
    for shape in ("cup + overlapping handle", "tetrahedron, 80 mm"):
        row = mesh_distances.measure(shape, 300)
        assert row["wrong_signs"] == 0 and row["exact_p95_mm"] < 1e-9
        assert 0.5 < row["tables"]["5"]["near_p95_mm"] < 3
        lines.append({"kind": "accuracy", "shape": shape, **row})
    shown = mesh_distances.show(lines, {})
    assert "| cup + overlapping handle |" in shown and "| tetrahedron, 80 mm | 4 | 0 %, 0 mm |" in shown
