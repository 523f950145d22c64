"""`rumi run` with the user's own mesh: its folder, its figures, and what is wrong with the input."""

import hashlib
import json
from pathlib import Path

import pytest

from rumi import exit_codes
from rumi.cli import main
from rumi.runs.folder import load_run
from rumi.runs.json_settings import setting_names
from rumi.tasks.rummage.settings import Settings, from_dict
from scripts.bench.mug_mesh import mug_mesh, write_obj
from sdf.primitives import Mug
from tests.fixtures.meshes import box
from tests.fixtures.small_run import SMALL

for package in ("trimesh", "scipy", "networkx"):
    pytest.importorskip(package)
pytestmark = [pytest.mark.sim, pytest.mark.usefixtures("at_home", "all_in_reach")]  # meshes of many heights

COARSE = [*SMALL, "--spacing", "0.004", "--collision", "hull"]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def mesh(tmp_path):
    path = tmp_path / "my-mug.obj"
    write_obj(mug_mesh(Mug(), 0.006), path)
    return path


def run_small(*more):
    return main(["run", "mug-0", "--steps", "1", "--no-figures", *more])


def test_a_run_with_a_mesh(mesh, capsys, all_in_reach):
    options = (*COARSE, "--mesh", str(mesh), "--mass", "0.5", "--friction", "0.4", "--upright", "0", "0", "20")
    assert run_small(*options) == exit_codes.NOT_CONVERGED
    folder = Path("runs/mug-0-my-mug-rumi-default-s0")
    run = load_run(folder)
    assert len(run.steps) == 2
    said = json.loads((folder / "object.json").read_text())
    assert said["mesh"]["file"] == "my-mug.obj"
    assert said["mesh"]["sha256"] == hashlib.sha256(mesh.read_bytes()).hexdigest()
    assert said["mesh"]["object_T_mesh"][0][0] == pytest.approx(0.9397, abs=1e-4)
    assert said["symmetry"] == "none"
    own = from_dict(run.settings).object
    assert (own.mass_kg, own.friction, own.upright, own.mesh) == (0.5, 0.4, (0.0, 0.0, 20.0), str(mesh))
    assert any(all_in_reach.glob("mesh-*.npz"))
    # drawn from the folder alone
    mesh.unlink()
    pytest.importorskip("matplotlib")
    assert main(["plot", str(folder)]) == exit_codes.DONE
    assert len(list((folder / "figures").glob("*.png"))) >= 2
    assert "Traceback" not in capsys.readouterr().err


def test_the_tasks_own_object_is_described_too():
    small = SMALL
    assert run_small(*small, "--out", "own") == exit_codes.NOT_CONVERGED
    said = json.loads(Path("own/object.json").read_text())
    assert (said["name"], said["mesh"]) == ("mug", None)


def test_what_is_lower_than_the_usual_tool_is_found_or_refused_before_anything_is_written(tmp_path, capsys):
    write_obj(box((0.06, 0.04, 0.015)), tmp_path / "slab.obj")
    write_obj(box((0.08, 0.05, 0.001)), tmp_path / "plate.obj")
    assert run_small(*COARSE, "--mesh", "slab.obj", "--out", "slab") == exit_codes.NOT_CONVERGED
    assert float(load_run("slab").steps[0].reading.tool_pose[0, 2, 3]) == pytest.approx(0.023)
    assert run_small(*COARSE, "--mesh", "plate.obj") == exit_codes.BAD_INPUT
    assert "got 160 x 100 x 2 mm" in (said := capsys.readouterr().err) and "`rumi localize`" in said
    assert not list(Path("runs").iterdir())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--mesh", "none.obj"], "none.obj"),
        (["--mesh", "text.obj"], "text.obj"),
        (["--mesh", "my-mug.obj", "--scale", "1000"], "mm"),
        (["--mesh", "my-mug.obj", "--scale", "-1"], "scale"),
        (["--mesh", "my-mug.obj", "--symmetry", "round"], "Expected symmetries"),
        (["--mesh", "my-mug.obj", "--mass", "0"], "mass"),
        (["--mesh", "my-mug.obj", "--upright", "80", "0", "0"], "tipped"),
        (["--scale", "0.001"], "--mesh"),
    ],
)
def test_bad_input_is_refused(mesh, options, said, capsys):
    Path("text.obj").write_text("nothing to see\n")
    assert run_small(*(COARSE if "--mesh" in options else SMALL), *options, "--out", "there") == exit_codes.BAD_INPUT
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error
    # nothing was begun: the folder can be used again
    assert not Path("there/settings.json").exists()


def test_flags_are_known_by_their_short_names(capsys):
    names = {"mesh", "scale", "mass", "friction", "upright", "symmetry", "spacing", "collision"}
    assert names <= set(setting_names(Settings))
    assert run_small("--mas", "1") == exit_codes.BAD_INPUT
    assert "--mass KG" in capsys.readouterr().err
