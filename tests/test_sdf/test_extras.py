import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

from rumi import exit_codes
from rumi.cli import main
from sdf.extras import EXTRAS, optional, remedy

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OWN = {"sdf", "sensors", "kmppi", "rumi", "scripts", "tests"}
PACKAGES = ("sdf", "sensors", "kmppi", "rumi")
OPTIONAL = {package: extra for extra, packages in EXTRAS.items() for package in packages.split()}


def imports(tree, *, guarded=False):
    """Packages that a module imports, and whether at once: not in a function, nor for types alone."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name.partition(".")[0], guarded) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module.partition(".")[0], guarded
        else:
            typing = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node)
            later = typing or isinstance(node, ast.FunctionDef)
            yield from imports(node, guarded=guarded or later)


def test_what_may_be_missing_is_imported_when_it_is_needed_and_brought_by_an_extra():
    needed = {re.split(r"[^\w-]", one)[0].replace("-", "_") for one in PROJECT["dependencies"]} | OWN | {"llvmlite"}
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        for name, guarded in imports(ast.parse(path.read_text())):
            if name in needed or name in sys.stdlib_module_names:
                continue
            assert name in OPTIONAL, f"{path} imports {name}"
            assert guarded, f"{path} imports {name} before it is needed"


def test_extras_are_those_of_the_project():
    extras = PROJECT["optional-dependencies"]
    assert set(EXTRAS) == set(extras) - {"all", "dev", "docs"}
    (everything,) = extras["all"]
    assert set(everything.split("[")[1].rstrip("]").split(",")) == {
        *("sim", "robot", "plot", "mesh", "vision", "logs", "serve")
    }


def test_what_installs_it_is_named(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert remedy("cv2") == f"pip install -e '{ROOT}[vision]'"
    assert remedy("lz4.frame") == f"pip install -e '{ROOT}[logs]'"
    monkeypatch.chdir(ROOT)
    assert remedy("vision") == "pip install -e '.[vision]'"
    assert remedy("cv2", tmp_path) == "pip install 'opencv-contrib-python-headless>=4.10' 'scipy' 'trimesh'"
    assert remedy("numpy") == ""
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(
        ModuleNotFoundError, match=r"An image needs cv2 \(.*\): pip install -e '\.\[vision\]'"
    ) as caught:
        optional("cv2", "An image")
    assert caught.value.name == "cv2"


@pytest.mark.sim
@pytest.mark.usefixtures("at_home")
@pytest.mark.parametrize(
    ("lacking", "arguments"),
    [
        ("mujoco", ["run", "touch-box"]),
        ("cv2", ["run", "mug-0", "--simulator.sensors.kind", "both", "--steps", "0", "--no-figures"]),
        ("gpytorch", ["run", "mug-0", "--method", "gpvr", "--steps", "0"]),
        ("h5py", ["replay", "log.h5"]),
        ("rosbags", ["import", "bag", "--map", "map.toml"]),
        ("trimesh", ["mesh", "box.stl"]),
        ("trimesh", ["localize", "box.stl", "touches.csv"]),
        ("matplotlib", ["run", "peg"]),
    ],
)
def test_a_missing_package_is_said_in_a_line(lacking, arguments, monkeypatch, capsys):
    frames = '[frames]\nworld = "base"\ntool = "hand"\n'
    scene = '[scene]\nbuiltin = "mug"\nwithin = [[0, 0, 0], [1, 1, 1]]\n'
    Path("map.toml").write_text(f"schema = 1\n[topics]\n{frames}{scene}")
    Path("log.h5").write_text("")
    Path("box.stl").write_text("solid box\nendsolid box\n")
    Path("touches.csv").write_text("0,0,0\n1,0,0\n0,1,0\n0,0,1\n")
    for name in [name for name in sys.modules if name.partition(".")[0] == lacking]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, lacking, None)
    assert main(arguments) == exit_codes.BAD_INPUT
    said = capsys.readouterr().err
    assert f"pip install -e '{ROOT}[{OPTIONAL[lacking]}]'" in said.splitlines()[-1]
    assert "Traceback" not in said
    assert not Path("runs").exists() or not any(Path("runs").iterdir())
