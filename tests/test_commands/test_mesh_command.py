"""`rumi mesh`."""

import json

import pytest
import torch

from rumi import exit_codes
from rumi.cli import main

pytest.importorskip("trimesh")
pytest.importorskip("scipy")

SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


@pytest.fixture
def box(tmp_path):
    """Writes a box of 60 x 80 x 100 units and gives the file."""

    def write(unit=0.001, sides=SIDES, name="box.obj"):
        corners = torch.tensor([[x, y, z] for x in (-30, 30) for y in (-40, 40) for z in (-50, 50)]) * unit
        rows = ["v " + " ".join(map(str, corner)) for corner in corners.tolist()]
        rows += ["f " + " ".join(str(k + 1) for k in side) for side in sides]
        path = tmp_path / name
        path.write_text("\n".join(rows) + "\n")
        return str(path)

    return write


def test_a_good_mesh(box, capsys):
    assert main(["mesh", box()]) == exit_codes.DONE
    said = capsys.readouterr()
    assert "box.obj" in said.out and "60 x 80 x 100 mm" in said.out and "nothing is wrong" in said.out
    assert said.err == ""


def test_symmetries_are_said(box, capsys):
    """A box of three lengths: half a turn about each of its axes."""
    assert main(["mesh", box()]) == exit_codes.DONE
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("  symmetry"))
    assert "half a turn about" in line and "3 mirror planes" in line
    assert all(axis in line for axis in ("(1.00, 0.00, 0.00)", "(0.00, 1.00, 0.00)", "(0.00, 0.00, 1.00)"))


def test_json(box, capsys):
    assert main(["mesh", box(sides=SIDES[1:]), "--json", "--spacing", "0.004"]) == exit_codes.DONE
    found = json.loads(capsys.readouterr().out)
    assert found["usable"] is True and found["watertight"] is False and found["spacing_m"] == 0.004
    assert found["findings"][0]["level"] == "warning"


def test_millimetres(box, capsys):
    path = box(unit=1)
    assert main(["mesh", path]) == exit_codes.BAD_INPUT
    assert "millimetres (0.001)" in capsys.readouterr().out
    assert main(["mesh", path, "--scale", "0.001"]) == exit_codes.DONE
    capsys.readouterr()
    assert main(["mesh", path, "--scale", "1000"]) == exit_codes.BAD_INPUT
    assert "in millimetres (0.001)" in capsys.readouterr().out
    assert main(["mesh", box(unit=0.001), "--scale", "1000"]) == exit_codes.BAD_INPUT
    assert "in metres (1)" in capsys.readouterr().out


def test_no_volume(box, capsys):
    assert main(["mesh", box(sides=SIDES[:1])]) == exit_codes.BAD_INPUT
    assert "encloses a volume" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.obj", None, "no such file"),
        ("empty.obj", "", "empty file"),
        ("text.stl", "hello", "Expected a mesh"),
        ("cloud.off", "OFF\n1 0 0\n0 0 0\n", "cloud of 1 points"),
        ("nan.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN"),
        ("notes.txt", "hello", ".obj, .stl"),
    ],
)
def test_what_cannot_be_read(tmp_path, capsys, name, content, words):
    if content is not None:
        (tmp_path / name).write_text(content)
    assert main(["mesh", str(tmp_path / name)]) == exit_codes.BAD_INPUT
    said = capsys.readouterr()
    assert words in said.err and "RUMI_DEBUG" not in said.err and "Traceback" not in said.err
    assert said.err.startswith("rumi: ")


@pytest.mark.parametrize("arguments", [[], ["box.obj", "--scale", "0"], ["box.obj", "--spacing", "-1"], ["a", "--no"]])
def test_bad_options(arguments, capsys):
    assert main(["mesh", *arguments]) == exit_codes.BAD_INPUT
    assert "Traceback" not in capsys.readouterr().err
