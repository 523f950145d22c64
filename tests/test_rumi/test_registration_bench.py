"""The drill's registration problem at reduced size, and the table of its mesh."""

import os
from pathlib import Path

import pytest
import torch

from rumi.bench import drill
from rumi.bench.cases.registration import ours
from rumi.bench.mesh import MeshDistance, mesh_table, read_obj
from rumi.registration.register import RegisterSettings
from sdf.primitives import Box

pytest.importorskip("scipy")

CUBE = """
v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
f 4 3 2 1
f 5/1 6/2 7/3 8/4
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f 4 1 5 8
"""


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    path = tmp_path / "cube.obj"
    rows = [row.split() for row in CUBE.strip().splitlines()]
    path.write_text(
        "\n".join(
            f"v {0.03 * int(a)} {0.04 * int(b)} {0.05 * int(c)}" for k, a, b, c in (r for r in rows if r[0] == "v")
        )
        + "\n"
        + "\n".join(" ".join(r) for r in rows if r[0] == "f")
    )
    return path


def test_a_mesh_is_tabulated_as_the_box_that_it_is(cube, generator):
    table, box = mesh_table(cube, 0.004), Box((0.03, 0.04, 0.05))
    points = 0.05 * torch.randn(2000, 3, generator=generator)
    exact = box.distance(points)
    # trilinear values err at edges by part of a cell; none has the wrong sign far from the surface
    assert float((table.distance(points) - exact).abs().max()) < 0.004
    assert float((table.distance(points) - exact).abs().median()) < 1e-4


def test_a_mesh_without_one_face_still_has_an_inside(cube, tmp_path):
    rows = cube.read_text().splitlines()
    faces = [row for row in rows if row.startswith("f")]
    vertices, triangles = read_obj(cube)
    assert triangles.shape == (12, 3)
    # one triangle of twelve is gone: distances stay, and its place stays closed for what is a cell wide
    mesh = MeshDistance(vertices, triangles[1:])
    assert float(mesh.distance(torch.zeros(1, 3))[0]) == pytest.approx(0.03, abs=1e-6)
    assert len(faces) == 6


def test_files_without_a_mesh_are_refused(tmp_path):
    path = tmp_path / "empty.obj"
    path.write_text("# nothing")
    with pytest.raises(ValueError, match="vertices and faces"):
        read_obj(path)


@pytest.mark.data
def test_most_poses_kept_of_the_drill_are_right():
    assert os.environ["RUMI_DATA"]
    model = drill.drill(0.005)
    problem = drill.problem(model.sdf, 1000, each=100)
    assert len(problem.observation) == 300
    torch.testing.assert_close(problem.observation.points.mean(0), torch.zeros(3), atol=1e-6, rtol=0)
    settings = RegisterSettings(kept=50, starts=1500, polished=200)
    poses = ours(model, problem, 1000, settings)()
    error = drill.surface_error(model, poses, problem.truth)
    assert len(poses) == 50
    assert int((error < drill.FOUND_M).sum()) >= 40
    assert float(drill.surface_error(model, problem.truth[None], problem.truth)[0]) < 5e-4
