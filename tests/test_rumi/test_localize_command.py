"""`rumi localize`, and the files of points it reads."""

import json

import numpy as np
import pytest
import torch

from rumi import cli
from rumi.cli import main
from rumi.errors import UsageError
from rumi.touch_files import read_contacts
from sdf import se3, so3

pytest.importorskip("trimesh")
pytest.importorskip("scipy")

CORNERS = [[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.02, 0.1, 0.0], [0.03, 0.02, 0.07]]
FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
POINTS = np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0], [-4.0, 5e-1, 0.6], [0.5, 0.25, 0.125]])
NORMALS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]])


@pytest.fixture
def wedge(tmp_path):
    path = tmp_path / "wedge.obj"
    rows = ["v " + " ".join(map(str, x)) for x in CORNERS] + ["f " + " ".join(str(k + 1) for k in f) for f in FACES]
    path.write_text("\n".join(rows) + "\n")
    return str(path)


@pytest.fixture
def touched(tmp_path):
    """Points on the wedge, 12 a face, where it stands at 0.4, 0.1, 0.2; a CSV with normals."""
    generator = torch.Generator().manual_seed(0)
    corners = torch.tensor(CORNERS, dtype=torch.float64)[torch.tensor(FACES)]
    share = torch.distributions.Dirichlet(torch.ones(3, dtype=torch.float64))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        points = (share.sample((4, 12))[..., None] * corners[:, None]).sum(-2).reshape(-1, 3)
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=-1).repeat_interleave(12, 0)
    turn = so3.exp(torch.randn(3, generator=generator, dtype=torch.float64))
    pose = se3.make(turn, torch.tensor([0.4, 0.1, 0.2], dtype=torch.float64))
    table = torch.cat((se3.apply(pose, points), normals @ turn.mT), -1)
    path = tmp_path / "touches.csv"
    rows = [",".join(f"{x:.9f}" for x in row) for row in table.tolist()]
    path.write_text("x,y,z,nx,ny,nz\n" + "\n".join(rows) + "\n")
    return str(path), pose


def test_a_pose_comes_back(wedge, touched, capsys):
    path, pose = touched
    for extra in ([], ["--normals"], ["--center", "0.4", "0.1", "0.2", "--radius", "0.02", "0.02", "0.02", "--clip"]):
        assert main(["localize", wedge, path, "--json", "--starts", "200", "--no-symmetries", *extra]) == cli.DONE
        found = json.loads(capsys.readouterr().out)
        best = found["modes"][found["best"]]
        assert torch.allclose(torch.tensor(best["world_T_object"], dtype=torch.float64), pose, atol=2e-3)
        assert best["mean_distance_mm"] < 0.02 and found["points"] == 48 and found["seconds"]["localize"] > 0
        assert (best["mean_normal_deg"] is not None) == (extra == ["--normals"])


def test_for_people(wedge, touched, capsys):
    assert main(["localize", wedge, touched[0], "--starts", "200"]) == cli.DONE
    said = capsys.readouterr()
    assert "1 mode from 48 points" in said.out and "seconds:" in said.out and said.err.count("Error") == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--center", "0", "0", "0"], "--center and --radius together"),
        (["--clip"], "with --clip"),
        (["--center", "0", "0", "0", "--radius", "0", "0.1", "0.1"], "--radius above 0"),
        (["--points-scale", "0"], "--points-scale above 0"),
        (["--points-scale", "1000"], "millimetres"),
        (["--scale", "1000"], "metres"),
        (["--noise", "-1"], "--noise above 0"),
        (["--starts", "0"], "--starts of 1 or more"),
    ],
)
def test_options_that_cannot_be(wedge, touched, arguments, words, capsys):
    assert main(["localize", wedge, touched[0], "--no-symmetries", *arguments]) == cli.BAD_INPUT
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("few.csv", "0 0 0\n0 0 0.1\n", "3 contact points or more, got 2"),
        ("line.csv", "0 0 0\n0 0 0.05\n0 0 0.1\n", "not all on one line"),
        ("empty.csv", "", "got none"),
        ("words.csv", "0 0 0\n0 0 one\n", "line 2 has something that is no number"),
        ("ragged.csv", "0 0 0\n0 0\n", "line 2 has 2 numbers"),
        ("four.csv", "0 0 0 1\n0 0 1 1\n", "3 numbers a line, or 6"),
        ("short.off", "OFF\n5 0 0\n0 0 0\n", "the 5 points that its header says, got 1"),
        ("long.off", "OFF\n1 0 0\n0 0 0\n0 0 1\n", "the 1 points that its header says, got 2"),
        ("no.ply", "plynot\n", "PLY header"),
        ("what.docx", "x", "ending in .csv"),
    ],
)
def test_contacts_that_cannot_be(wedge, tmp_path, name, text, words, capsys):
    path = tmp_path / name
    path.write_text(text)
    assert main(["localize", wedge, str(path), "--no-symmetries"]) == cli.BAD_INPUT
    assert words in capsys.readouterr().err


def test_files_that_are_not_there(wedge, touched, tmp_path, capsys):
    assert main(["localize", wedge, str(tmp_path / "none.csv")]) == cli.BAD_INPUT
    assert "no such file" in capsys.readouterr().err
    assert main(["localize", str(tmp_path / "none.obj"), touched[0]]) == cli.BAD_INPUT
    assert "no such file" in capsys.readouterr().err
    cloud = tmp_path / "cloud.off"
    cloud.write_text("OFF\n3 0 0\n0 0 0\n0 0 1\n0 1 0\n")
    assert main(["localize", str(cloud), touched[0]]) == cli.BAD_INPUT
    assert "without faces" in capsys.readouterr().err


def test_normals_that_are_not_there_or_not_unit(wedge, tmp_path, capsys):
    path = tmp_path / "points.csv"
    path.write_text("0 0 0\n0 0 0.05\n0 0.1 0\n")
    assert main(["localize", wedge, str(path), "--normals", "--no-symmetries"]) == cli.BAD_INPUT
    assert "points alone" in capsys.readouterr().err
    path.write_text("0 0 0 0 0 2\n0 0 0.05 0 0 1\n0 0.1 0 0 0 1\n")
    assert main(["localize", wedge, str(path), "--normals", "--no-symmetries"]) == cli.BAD_INPUT
    assert "unit normals" in capsys.readouterr().err


def write(path, points, normals):
    """One of the formats, told by the name."""
    both = points if normals is None else np.concatenate((points, normals), 1)
    names = ["x", "y", "z", "nx", "ny", "nz"][: both.shape[1]]
    rows = "\n".join(" ".join(repr(float(x)) for x in row) for row in both) + "\n"
    if path.suffix in (".npz", ".npy"):
        if path.suffix == ".npy":
            np.save(path, both)
        else:
            np.savez(path, points=points, **({} if normals is None else {"normals": normals}))
    elif path.suffix == ".off":
        rows = rows.replace("\n", "\n# in between\n\n", 1)
        path.write_text(f"OFF  \n {len(points)}.00000\t0.00000 0.0\n{rows}")
    elif path.suffix == ".ply":
        kind = path.stem
        fields = "".join(f"property {'float' if kind == 'little' else 'double'} {name}\n" for name in names)
        form = {"ascii": "ascii", "little": "binary_little_endian", "big": "binary_big_endian"}[kind]
        head = f"ply\nformat {form} 1.0\ncomment hello\nelement vertex {len(points)}\n{fields}"
        head += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
        body = rows.encode() if kind == "ascii" else both.astype("<f4" if kind == "little" else ">f8").tobytes()
        path.write_bytes(head.encode() + body)
    elif path.suffix == ".csv":
        path.write_text("# touched\n" + ";".join(names) + "\n" + rows.replace(" ", ";"))
    else:
        path.write_text(rows)


@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a.off", "ascii.ply", "little.ply", "big.ply", "a.npz", "a.npy"])
@pytest.mark.parametrize("normals", [None, NORMALS])
def test_every_format(tmp_path, name, normals):
    path = tmp_path / name
    write(path, POINTS, normals)
    found = read_contacts(path, scale=0.5)
    assert np.allclose(found.points.numpy(), 0.5 * POINTS, rtol=1e-6)
    assert (found.normals is None) == (normals is None)
    if found.normals is not None:
        assert np.allclose(found.normals.numpy(), NORMALS)


def test_columns_by_name(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,z,y,x\n0,3,2,1\n1,6,5,4\n2,9,8,7\n")
    assert read_contacts(path).points.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    path.write_text("x,y,w\n1,2,3\n")
    with pytest.raises(UsageError, match="no number"):
        read_contacts(path)
