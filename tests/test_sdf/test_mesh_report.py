"""What is said of a mesh."""

import json

import pytest
import torch

from sdf.mesh.mesh import TriangleMesh
from sdf.mesh.mesh_report import report

pytest.importorskip("scipy")


def said(found, level=None):
    return " | ".join(f.text for f in found.findings if level in (None, f.level))


def test_a_good_mesh(shapes):
    found = report(shapes.box())
    assert found.usable and found.watertight and not found.findings
    assert (found.vertices, found.faces, found.parts) == (8, 12, 1)
    assert found.size_m == pytest.approx((0.06, 0.08, 0.1))
    assert found.volume_m3 == pytest.approx(8 * 0.03 * 0.04 * 0.05)
    assert found.area_m2 == pytest.approx(8 * (0.03 * 0.04 + 0.03 * 0.05 + 0.04 * 0.05))
    assert found.wall_m == pytest.approx(0.06, rel=0.01)
    assert found.spacing_m == 0.002 and len(found.nodes) == 3
    assert "nothing is wrong" in found.text() and "60 x 80 x 100 mm" in found.text()
    assert json.loads(json.dumps(found.to_dict()))["usable"] is True


def test_everything_that_is_put_right_is_said(shapes):
    box = shapes.turned(shapes.box(), [2])
    box = TriangleMesh(box.vertices, torch.cat((box.faces, box.faces[:1], box.faces[:1, [0, 0, 1]])))
    ball = shapes.without(shapes.turned(shapes.sphere(0.02, rings=12).moved(lift(0.05))), 40)
    hollow = shapes.turned(shapes.box((0.01, 0.01, 0.01)))
    found = report(shapes.together(box, ball, hollow))
    text = said(found)
    assert found.usable and not found.watertight and found.parts == 3
    for words in (
        "1 opening,",
        "parts overlap",
        "1 face turned",
        "1 part turned",
        "1 cavity",
        "more than once",
        "area",
    ):
        assert words in text, words
    assert found.text().count("note:") + found.text().count("warning:") == len(found.findings) == 7


def lift(z):
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = z
    return pose


def test_wide_openings_are_warned_of(shapes):
    found = report(shapes.without(shapes.box(), 0, 1))
    assert found.usable
    assert "closed by flat fans" in said(found, "warning")


def test_loose_sides_are_warned_of(shapes):
    sides = [shapes.without(shapes.box(), *(k for k in range(12) if k // 2 != side)) for side in range(6)]
    found = report(shapes.together(*sides))
    assert found.usable and "6 openings that cannot be closed (24 open edges" in said(found, "warning")


def test_a_moebius_band_is_warned_of(shapes):
    turns = torch.arange(12, dtype=torch.float64) * torch.pi / 6
    across = 0.005 * torch.stack((torch.cos(turns / 2), torch.sin(turns / 2)), -1)
    radial = torch.stack((turns.cos(), turns.sin(), torch.zeros(12)), -1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    edge = across[:, :1] * radial + across[:, 1:] * up
    vertices = torch.cat((0.04 * radial + edge, 0.04 * radial - edge))
    faces = []
    for k in range(12):
        a, b = (k, k + 12), ((k + 1) % 12, (k + 1) % 12 + 12)
        b = b if k < 11 else b[::-1]  # the twist
        faces += [(a[0], a[1], b[0]), (a[1], b[1], b[0])]
    found = report(shapes.together(shapes.box().moved(lift(0.2)), TriangleMesh(vertices, torch.tensor(faces))))
    assert "one side only" in said(found, "warning")


@pytest.mark.parametrize(("scale", "word"), [(1000.0, "millimetres"), (0.01, "unit"), (17.0, "unit")])
def test_sizes_that_cannot_be(shapes, scale, word):
    found = report(shapes.box().scaled(scale))
    if scale == 17.0:  # a large thing: a question only
        assert found.usable and "are the units metres" in said(found, "warning")
        return
    assert not found.usable
    assert word in said(found, "error")
    assert found.spacing_m is None
    # who gives a spacing means it
    assert report(shapes.box().scaled(scale), spacing=0.1 * scale).usable


def test_sheets(shapes):
    found = report(shapes.without(shapes.box(), *range(2, 12)))
    assert not found.usable and "encloses a volume" in said(found, "error")
    assert "error:" in found.text() and found.volume_m3 is None


def test_walls_too_thin_for_the_table(shapes):
    found = report(shapes.box((0.05, 0.05, 0.001)), spacing=0.003)
    assert found.usable and "walls of 2 mm" in said(found, "warning") and "--spacing 0.001" in said(found)
