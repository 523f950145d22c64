"""`rumi localize`, and the files of points it reads."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from rumi import exit_codes
from rumi.cli import main
from rumi.commands.contact_files import read_contacts
from rumi.errors import UsageError
from sdf import se3, so3

pytest.importorskip("trimesh")
pytest.importorskip("scipy")

CORNERS = [[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.02, 0.1, 0.0], [0.03, 0.02, 0.07]]
FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
POINTS = np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0], [-4.0, 5e-1, 0.6], [0.5, 0.25, 0.125]])
NORMALS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]])
PLY = """ply
format ascii 1.0
element vertex COUNT
property float x
property float y
property float z
end_header
0 0 0
"""


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
        assert (
            main(["localize", wedge, path, "--json", "--starts", "200", "--no-symmetries", *extra]) == exit_codes.DONE
        )
        found = json.loads(capsys.readouterr().out)
        best = found["modes"][found["best"]]
        assert torch.allclose(torch.tensor(best["world_T_object"], dtype=torch.float64), pose, atol=2e-3)
        assert best["mean_distance_mm"] < 0.02 and found["points"] == 48 and found["seconds"]["localize"] > 0
        assert (best["mean_normal_deg"] is not None) == (extra == ["--normals"])


def test_normals_into_the_object_are_named(wedge, touched, tmp_path, capsys):
    path, _ = touched
    rows = [line.split(",") for line in Path(path).read_text().splitlines()[1:]]
    for count in (48, 4):
        inward = tmp_path / f"inward{count}.csv"
        some = rows[:: len(rows) // count]
        inward.write_text("\n".join(",".join(row[:3] + [str(-float(x)) for x in row[3:]]) for row in some) + "\n")
        outward = tmp_path / f"outward{count}.csv"
        outward.write_text("\n".join(",".join(row) for row in some) + "\n")
        for file, wrong in ((inward, True), (outward, False)):
            arguments = ["localize", wedge, str(file), "--starts", "200", "--no-symmetries"]
            assert main([*arguments, "--normals", "--json"]) == exit_codes.DONE
            said = capsys.readouterr()
            found = json.loads(said.out)
            assert found["normals_inward"] is wrong and ("seem to point into the object" in said.err) is wrong
            assert (found["turned_normals_gain_nats"] > 5.0) is wrong
            assert main([*arguments, "--json"]) == exit_codes.DONE
            said = capsys.readouterr()
            assert "normals_inward" not in json.loads(said.out) and "into the object" not in said.err


def test_for_people(wedge, touched, capsys):
    assert main(["localize", wedge, touched[0], "--starts", "200"]) == exit_codes.DONE
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
        (["--points-scale", "inf"], "--points-scale above 0 and finite"),
        (["--points-scale", "nan"], "--points-scale above 0 and finite"),
        (["--center", "nan", "0", "0", "--radius", "1", "1", "1"], "--center of three finite numbers"),
        (["--seed", str(2**70)], "--seed to be 0 or more"),
        (["--seed", "-1"], "--seed to be 0 or more"),
        (["--noise", "-1"], "--noise above 0"),
        (["--noise", "0"], "--noise above 0"),
        (["--noise", "nan"], "--noise above 0"),
        (["--noise", "inf"], "--noise above 0"),
        (["--noise", "1e-30", "--json"], "--noise above 0 m, from 1e-09"),
        (["--starts", "0"], "--starts of 1 or more"),
    ],
)
def test_options_that_cannot_be(wedge, touched, arguments, words, capsys):
    assert main(["localize", wedge, touched[0], "--no-symmetries", *arguments]) == exit_codes.BAD_INPUT
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("few.csv", "0 0 0\n0 0 0.1\n", "3 contact points or more, got 2"),
        ("line.csv", "0 0 0\n0 0 0.05\n0 0 0.1\n", "not all on one line"),
        ("empty.csv", "", "got none"),
        ("words.csv", "0 0 0\n0 0 one\n", "line 2 has something that is no number"),
        ("ragged.csv", "0 0 0\n0 0\n", "line 2 has 2 numbers"),
        ("twice.csv", "x,y,z,x\n0,0,0,1\n0,0,1,1\n", "each column once, got x more than once"),
        ("four.csv", "0 0 0 1\n0 0 1 1\n", "3 numbers a line, or 6"),
        ("short.off", "OFF\n5 0 0\n0 0 0\n", "the 5 points that its header says, got 1"),
        ("long.off", "OFF\n1 0 0\n0 0 0\n0 0 1\n", "the 1 points that its header says, got 2"),
        ("inf.off", "OFF\ninf 0 0\n0 0 0\n", "number of points after OFF, got inf"),
        ("nan.off", "OFF\nnan 0 0\n0 0 0\n", "number of points after OFF, got nan"),
        ("half.off", "OFF\n1.5 0 0\n0 0 0\n", "number of points after OFF, got 1.5"),
        ("commas.csv", "0,01;0,02;0,03\n0,05;0,02;0\n", "line 1 seems to have decimal commas"),
        ("commas.txt", "x y z\n0,01 -0,02 3e-2\n0,05 0,02 0\n", "line 2 seems to have decimal commas"),
        ("commas.xyz", "0,01\t-0,02\t0,03\n", "line 1 seems to have decimal commas"),
        ("no.ply", "plynot\n", "PLY header"),
        ("negative.ply", PLY.replace("COUNT", "-1"), "count of 0 or more, got 'element vertex -1'"),
        ("uncounted.ply", PLY.replace("COUNT", ""), "count of 0 or more, got 'element vertex'"),
        ("format.ply", PLY.replace("COUNT", "1").replace("ascii", "foo"), "one of ascii, binary_little_endian"),
        ("none.ply", PLY.replace("COUNT", "1").replace("format ascii 1.0\n", ""), "format of a PLY to be one of"),
        ("type.ply", PLY.replace("COUNT", "1").replace("float x", "half x"), "got 'property half x'"),
        ("list.ply", PLY.replace("COUNT", "1").replace("float x", "list uchar int x"), "without lists"),
        ("not.npz", "nope", "expected an archive of arrays"),
        ("not.npy", "nope", "or a NumPy array"),
        ("what.docx", "x", "ending in .csv"),
    ],
)
def test_contacts_that_cannot_be(wedge, tmp_path, name, text, words, capsys):
    path = tmp_path / name
    path.write_text(text)
    assert main(["localize", wedge, str(path), "--no-symmetries"]) == exit_codes.BAD_INPUT
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (POINTS.astype(complex), "real numbers, got complex128"),
        (POINTS.astype(str), "real numbers, got <U"),
        (POINTS > 0, "real numbers, got bool"),
        (POINTS.astype(object), "could not read them"),
    ],
)
def test_arrays_that_are_no_points(wedge, tmp_path, points, words, capsys):
    for name in ("a.npz", "a.npy"):
        if name == "a.npz":
            np.savez(tmp_path / name, points=points)
        else:
            np.save(tmp_path / name, points)
        assert main(["localize", wedge, str(tmp_path / name), "--no-symmetries"]) == exit_codes.BAD_INPUT
        assert words in capsys.readouterr().err


def test_commas_that_part_numbers(tmp_path):
    path = tmp_path / "a.csv"
    for text in ("1,2,3\n4,5,6\n", "1, 2, 3\n4, 5, 6\n", "1 2 3\n4 5 6\n", "1;2;3\n4;5;6\n", "1.0,2.0 3\n4,5 6.0\n"):
        path.write_text(text)
        assert read_contacts(path).points.tolist() == [[1, 2, 3], [4, 5, 6]]
    path.write_text("1,2,3 0,0,1\n4,5,6 0,0,1\n")
    assert read_contacts(path).points.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("noise", ["1e-9", "1e3"])
def test_any_noise_that_is_allowed_lists_modes(wedge, touched, noise, capsys):
    arguments = ["localize", wedge, touched[0], "--no-symmetries", "--starts", "50", "--json", "--noise", noise]
    assert main(arguments) == exit_codes.DONE
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert found["modes"] and sum(mode["weight"] for mode in found["modes"]) == pytest.approx(1.0)


def test_files_that_are_not_there(wedge, touched, tmp_path, capsys):
    assert main(["localize", wedge, str(tmp_path / "none.csv")]) == exit_codes.BAD_INPUT
    assert "no such file" in capsys.readouterr().err
    assert main(["localize", str(tmp_path / "none.obj"), touched[0]]) == exit_codes.BAD_INPUT
    assert "no such file" in capsys.readouterr().err
    cloud = tmp_path / "cloud.off"
    cloud.write_text("OFF\n3 0 0\n0 0 0\n0 0 1\n0 1 0\n")
    assert main(["localize", str(cloud), touched[0]]) == exit_codes.BAD_INPUT
    assert "without faces" in capsys.readouterr().err


def test_normals_that_are_not_there_or_not_unit(wedge, tmp_path, capsys):
    path = tmp_path / "points.csv"
    path.write_text("0 0 0\n0 0 0.05\n0 0.1 0\n")
    assert main(["localize", wedge, str(path), "--normals", "--no-symmetries"]) == exit_codes.BAD_INPUT
    assert "points alone" in capsys.readouterr().err
    path.write_text("0 0 0 0 0 2\n0 0 0.05 0 0 1\n0 0.1 0 0 0 1\n")
    assert main(["localize", wedge, str(path), "--normals", "--no-symmetries"]) == exit_codes.BAD_INPUT
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
