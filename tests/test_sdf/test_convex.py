"""Convex hulls and pieces: closed forms, the cache, and what happens without the library."""

import importlib.util
import logging

import numpy as np
import pytest
import torch

from sdf.mesh import convex
from sdf.mesh.convex import ConvexSettings, convex_pieces, hull
from sdf.mesh.mesh import MeshError, TriangleMesh
from sdf.mesh.repair import enclosed_volume
from sdf.mesh.rest import center_of_mass

pytest.importorskip("scipy")
needs_coacd = pytest.mark.skipif(importlib.util.find_spec("coacd") is None, reason="needs coacd")


def ell(long=0.10, high=0.10, thick=0.03, deep=0.04):
    """An L standing in the plane y = 0: a bar along x and one along z."""
    outline = [(0, 0), (long, 0), (long, thick), (thick, thick), (thick, high), (0, high)]
    front = torch.tensor([[x, -deep / 2, z] for x, z in outline], dtype=torch.float64)
    n = len(front)
    vertices = torch.cat((front, front + torch.tensor([0.0, deep, 0.0], dtype=torch.float64)))
    # by two quads, whose common corner is the inner one
    flat = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    sides = [f for i in range(n) for f in ((i, i + n, (i + 1) % n), ((i + 1) % n, i + n, (i + 1) % n + n))]
    faces = flat + [(c + n, b + n, a + n) for a, b, c in flat] + sides
    return TriangleMesh(vertices, torch.tensor(faces))


BARS = ((0, 1, 2, 6, 7, 8, 3, 9), (0, 5, 4, 6, 11, 10, 3, 9))
"""Corners of the L in whose hull the bar along x, and that along z, is."""


def volume(mesh):
    return enclosed_volume(mesh.corners)


def beyond(mesh, points):
    """How far points are outside of a convex, outward oriented mesh at most."""
    a, b, c = mesh.corners.unbind(-2)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    return float(((points[:, None] - a) * normals).sum(-1).max())


def test_hull_of_an_ell():
    mesh = ell()
    assert volume(mesh) == pytest.approx(0.04 * (0.1 * 0.03 + 0.07 * 0.03))
    found = hull(mesh)
    # the square without the triangle beyond the line that joins the bars' ends
    assert volume(found) == pytest.approx(0.04 * (0.01 - 0.5 * 0.07 * 0.07))
    assert beyond(found, mesh.vertices) < 1e-9
    assert len(found.vertices) == 10


def test_flat_mesh_has_no_hull():
    flat = TriangleMesh(torch.eye(3, dtype=torch.float64)[[0, 1, 2, 0]], torch.tensor([[0, 1, 2], [3, 2, 1]]))
    with pytest.raises(MeshError, match="volume"):
        hull(flat)


@needs_coacd
def test_pieces_of_an_ell(tmp_path, monkeypatch, caplog):
    mesh = ell()
    pieces = convex_pieces(mesh, cache_dir=tmp_path)
    assert len(pieces) >= 2
    assert sum(map(volume, pieces)) == pytest.approx(volume(mesh), rel=0.05)
    for piece in pieces:
        assert beyond(piece, piece.vertices) < 1e-4  # convex
    # each corner of the mesh is in a piece
    assert max(min(beyond(piece, vertex[None]) for piece in pieces) for vertex in mesh.vertices) < 1e-3
    again = convex_pieces(mesh)
    assert all(torch.equal(a.vertices, b.vertices) for a, b in zip(pieces, again, strict=True))
    # the second time from the folder, another mesh or other settings not
    (kept,) = tmp_path.glob("convex-*.npz")
    monkeypatch.setattr(convex, "_decomposed", lambda *_: pytest.fail("worked out again"))
    loaded = convex_pieces(mesh, cache_dir=tmp_path)
    assert all(
        torch.equal(a.faces, b.faces) and torch.equal(a.vertices, b.vertices)
        for a, b in zip(pieces, loaded, strict=True)
    )
    monkeypatch.setattr(convex, "_decomposed", lambda *_: (hull(mesh),))
    assert len(convex_pieces(ell(long=0.11), cache_dir=tmp_path)) == 1
    assert len(convex_pieces(mesh, ConvexSettings(concavity=0.2), cache_dir=tmp_path)) == 1
    assert len(list(tmp_path.iterdir())) == 3
    # whatever else lies there is worked out again
    for content in (b"nonsense", kept.read_bytes()[:200]):
        kept.write_bytes(content)
        with caplog.at_level(logging.WARNING):
            assert len(convex_pieces(mesh, cache_dir=tmp_path)) == 1
        assert "again" in caplog.text
    np.savez(kept, vertices=np.zeros((2, 3)), faces=np.zeros((1, 3)), vertex_counts=[5], face_counts=[1])
    assert len(convex_pieces(mesh, cache_dir=tmp_path)) == 1
    assert len(convex_pieces(mesh, cache_dir=tmp_path)) == 1


@needs_coacd
def test_overlapping_parts_are_taken_apart_each_by_itself():
    """Two boxes that cross: exact, where a remeshed union would be rounded."""
    first, second = (hull(TriangleMesh(ell().vertices[list(half)], torch.tensor([[0, 1, 2]]))) for half in BARS)
    both = TriangleMesh(
        torch.cat((first.vertices, second.vertices)), torch.cat((first.faces, second.faces + len(first.vertices)))
    )
    pieces = convex_pieces(both)
    assert len(pieces) == 2
    assert sorted(map(volume, pieces)) == pytest.approx(sorted((volume(first), volume(second))), rel=1e-4)


@needs_coacd
def test_a_hollow_stays_with_what_is_about_it():
    """A shell: its inner surface is no body of its own."""
    outer = hull(ell(thick=0.0999))
    inner = TriangleMesh(outer.vertices * 0.5 + 0.5 * center_of_mass(outer), outer.faces.flip(-1))
    shell = TriangleMesh(
        torch.cat((outer.vertices, inner.vertices)), torch.cat((outer.faces, inner.faces + len(outer.vertices)))
    )
    assert convex._parts(shell) == [shell]
    assert [len(part.faces) for part in convex._parts(outer)] == [len(outer.faces)]


def test_without_the_library_the_hull_with_a_warning(monkeypatch, caplog):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with caplog.at_level(logging.WARNING):
        (piece,) = convex_pieces(ell())
    assert "pip install coacd" in caplog.text
    assert volume(piece) > 1.4 * volume(ell())
    caplog.clear()
    assert len(convex_pieces(ell(), ConvexSettings(method="hull"))) == 1
    assert not caplog.text


def test_center_of_mass_of_an_ell():
    bars = [((0.05, 0.0, 0.015), 0.1 * 0.03), ((0.015, 0.0, 0.065), 0.07 * 0.03)]
    expected = sum(torch.tensor(c, dtype=torch.float64) * v for c, v in bars) / sum(v for _, v in bars)
    torch.testing.assert_close(center_of_mass(ell()), expected, rtol=0, atol=1e-12)
