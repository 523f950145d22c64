"""The meshes to measure with, and the script that measures."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

from scripts.bench import meshes
from scripts.bench.mug_mesh import mug_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Cup, Mug

pytest.importorskip("scipy")

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "mesh_distances.py"


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


def test_the_script_measures_and_shows(tmp_path, monkeypatch, capsys):
    pytest.importorskip("igl")
    spec = importlib.util.spec_from_file_location(SCRIPT.stem, SCRIPT)
    script = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, SCRIPT.stem, script)
    spec.loader.exec_module(script)
    monkeypatch.setattr(script, "SPACINGS_MM", (5.0,))
    out = tmp_path / "distances.jsonl"
    for _ in range(2):  # the second in place of the first
        script.accuracy(script.Accuracy(("cup + overlapping handle", "tetrahedron, 80 mm"), 300, out))
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["shape"] for row in rows] == ["cup + overlapping handle", "tetrahedron, 80 mm"]
    for row in rows:
        assert row["wrong_signs"] == 0
        assert row["exact_p95_mm"] < 1e-9
        assert 0.5 < row["tables"]["5"]["near_p95_mm"] < 3
    script.show(script.Show(out))
    shown = capsys.readouterr().out
    assert "| cup + overlapping handle |" in shown and "| tetrahedron, 80 mm | 4 | 0 %, 0 mm |" in shown
    with pytest.raises(SystemExit, match="Expected one of"):
        script.accuracy(script.Accuracy(("teapot",), 300, out))
