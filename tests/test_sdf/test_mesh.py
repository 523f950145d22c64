"""Reading meshes, and what is no mesh."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from sdf.mesh.mesh import MeshError, TriangleMesh, check_size, load_mesh, merged

trimesh = pytest.importorskip("trimesh")


def write(mesh, path):
    trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False).export(path)
    return path


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off", ".glb", ".OBJ"])
def test_every_format(shapes, tmp_path, suffix):
    box = shapes.box()
    path = write(box, tmp_path / f"box{suffix.lower()}").rename(tmp_path / f"box{suffix}")
    mesh = load_mesh(path)
    assert (len(mesh.vertices), len(mesh.faces)) == (8, 12)
    torch.testing.assert_close(mesh.bounds, box.bounds, atol=1e-7, rtol=0)
    assert mesh.diagonal == pytest.approx(0.1 * 2**0.5, abs=1e-7)


def test_scale_and_several_parts(shapes, tmp_path):
    scene = trimesh.Scene()
    for name, center in (("a", (0.0, 0.0, 0.0)), ("b", (0.2, 0.0, 0.0))):
        part = shapes.box(center=center)
        scene.add_geometry(trimesh.Trimesh(part.vertices.numpy(), part.faces.numpy()), geom_name=name)
    scene.export(tmp_path / "two.glb")
    mesh = load_mesh(tmp_path / "two.glb", scale=0.5)
    assert len(mesh.faces) == 24
    torch.testing.assert_close(mesh.bounds[:, 0], torch.tensor([-0.015, 0.115], dtype=torch.float64))


def test_vertices_on_each_other_become_one(shapes):
    box = shapes.box()
    loose = TriangleMesh(box.corners.reshape(-1, 3), torch.arange(36).reshape(12, 3))
    joined = merged(loose)
    assert len(joined.vertices) == 8
    torch.testing.assert_close(joined.corners, box.corners)
    unused = TriangleMesh(torch.cat((box.vertices, torch.ones(1, 3))), box.faces)
    assert len(merged(unused).vertices) == 8


def test_moved_and_scaled(shapes):
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turn[2, 3] = 0.05
    mesh = shapes.box().moved(turn).scaled(2.0)
    expected = torch.tensor([[-0.08, -0.06, 0.0], [0.08, 0.06, 0.2]], dtype=torch.float64)
    torch.testing.assert_close(mesh.bounds, expected)
    with pytest.raises(ValueError, match="scale"):
        mesh.scaled(0.0)


@pytest.mark.parametrize("first", ["OFF # a square\n", "", "COFF "])
def test_an_off_file_with_comments_and_floats_for_counts(tmp_path, first):
    path = tmp_path / "odd.off"
    path.write_text(f"{first}4.0 1.0 0.0\n0 0 0\n\n1 0 0 # corner\n# more\n1 1 0\n0 1 0\n4 0 1 2 3 0.5 0.5 0.5\n")
    mesh = load_mesh(path)
    assert mesh.faces.shape == (2, 3) and len(mesh.vertices) == 4


BAD = {
    "missing.obj": (None, "no such file"),
    "empty.stl": (b"", "empty file"),
    "noise.obj": (b"\x00\x01 this is no mesh", "mesh"),
    "noise.stl": (b"this is no mesh either" * 9, "mesh"),
    "noise.ply": (b"plywood", "mesh"),
    "noise.glb": (b"glTF but not really a file of that kind", "mesh"),
    "noise.off": (b"OFF\nmany few\n", "mesh"),
    "cloud.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        b"end_header\n0 0 0\n1 1 1\n",
        "cloud of 2 points",
    ),
    "cloud.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "mesh"),
    "cloud.off": (b"OFF\n2 0 0\n0 0 0\n1 1 1\n", "cloud of 2 points"),
    "nan.obj": (b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN"),
    "range.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "mesh"),
    "picture.png": (b"png", r"\.obj, \.stl"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_mesh_is_refused(tmp_path, name):
    content, message = BAD[name]
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MeshError, match=message) as caught:
        load_mesh(path)
    assert name in str(caught.value)


def test_a_folder_is_refused(tmp_path):
    (tmp_path / "mesh.obj").mkdir()
    with pytest.raises(MeshError, match="a folder"):
        load_mesh(tmp_path / "mesh.obj")


def test_a_file_that_may_not_be_read_is_named(shapes, tmp_path, monkeypatch):
    path = write(shapes.box(), tmp_path / "box.off")

    def closed(self, *arguments, **named):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", closed)
    with pytest.raises(MeshError, match=r"Cannot read .*box\.off: Permission denied"):
        load_mesh(path)


def test_arrays_are_checked():
    vertices = torch.eye(3)
    with pytest.raises(MeshError, match="vertices 0 to 2"):
        TriangleMesh(vertices, torch.tensor([[0, 1, 3]]))
    with pytest.raises(MeshError, match="got 3 and 0"):
        TriangleMesh(vertices, torch.zeros(0, 3, dtype=torch.long))
    with pytest.raises(MeshError, match="1 of 3 with NaN"):
        TriangleMesh(torch.tensor([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1000.0, "millimetres (0.001)"),
        (100.0, "centimetres (0.01)"),
        (1 / 0.0254, "inches (0.0254)"),
        (1e9, "what unit"),
    ],
)
def test_wrong_units_are_suspected(shapes, scale, words):
    mesh = shapes.box((0.04, 0.04, 0.06)).scaled(scale)
    with pytest.raises(MeshError, match="--scale") as caught:
        check_size(mesh)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("scale", "words"), [(1000.0, "metres (1)"), (1.0, "millimetres (0.001)"), (1e9, "metres (1)")]
)
def test_a_scale_that_was_given_counts_in_the_guess(shapes, scale, words):
    unit = 1.0 if words == "metres (1)" else 0.001
    mesh = shapes.box((0.04, 0.04, 0.06)).scaled(scale / unit)
    with pytest.raises(MeshError) as caught:
        check_size(mesh, scale)
    assert words in str(caught.value)


def test_right_units_are_not(shapes):
    check_size(shapes.box())


def test_without_trimesh_it_is_said(shapes, tmp_path, monkeypatch):
    path = write(shapes.box(), tmp_path / "box.obj")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs trimesh .*pip install -e '.*\[mesh\]'") as caught:
        load_mesh(path)
    assert caught.value.name == "trimesh"
