"""The user's own mesh: put upright, checked against the task, described."""

import hashlib
from dataclasses import replace

import pytest
import torch

from rumi.errors import UsageError
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.objects import ObjectSettings, own_model, record, with_object
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import preset
from scripts.bench.mug_mesh import mug_mesh, write_obj
from sdf import se3, so3
from sdf.primitives import Mug
from tests.fixtures.meshes import box

pytest.importorskip("trimesh")
pytest.importorskip("scipy")
pytest.importorskip("networkx")
pytestmark = pytest.mark.sim

SPEC = SCENES["mug-0"]
HALF = (0.03, 0.04, 0.06)


def box_file(folder, half=HALF, turn=(0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0), name="box.obj"):
    pose = se3.make(so3.exp(torch.tensor(turn, dtype=torch.float64)), torch.tensor(at, dtype=torch.float64))
    path = folder / name
    write_obj(box(half).moved(pose), path)
    return path


def model_of(path, cache, **settings):
    settings = {"spacing_m": 0.004, "collision": "hull"} | settings
    return own_model(ObjectSettings(mesh=str(path), **settings), cache_dir=cache)


def sizes(model):
    low, high = model.exact.bounds
    return (high - low).tolist()


def test_its_own_frame_where_it_stands(tmp_path, cache):
    path = box_file(tmp_path, at=(0.01, 0.0, 0.06))
    model = model_of(path, cache)
    assert model.name == "box" and model.source.file == "box.obj"
    assert model.source.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    torch.testing.assert_close(model.source.object_T_mesh, torch.eye(4, dtype=torch.float64))
    torch.testing.assert_close(model.exact.bounds, torch.tensor([[-0.02, -0.04, 0.0], [0.04, 0.04, 0.12]]))
    # half a turn about each axis through its middle
    assert len(model.symmetries) == 4
    torch.testing.assert_close(model.symmetries.center, torch.tensor([0.01, 0.0, 0.06]), atol=2e-4, rtol=0)
    said = record(model)
    assert said["mesh"]["sha256"] == model.source.sha256 and str(tmp_path) not in str(said)
    assert said["size_m"] == pytest.approx([0.06, 0.08, 0.12]) and said["height_m"] == pytest.approx(0.0)
    assert "half a turn about" in said["symmetry"]


def test_turned_no_more_than_it_takes(tmp_path, cache):
    model = model_of(box_file(tmp_path, turn=(0.05, 0.0, 0.0)), cache)
    turn = so3.log(model.source.object_T_mesh[:3, :3])
    torch.testing.assert_close(turn, torch.tensor([-0.05, 0.0, 0.0], dtype=torch.float64), atol=1e-6, rtol=0)
    assert "its own z, turned by 2.9 degrees" in model.source.upright


def test_laid_down_as_it_most_likely_rests(tmp_path, cache):
    """Leaning by half a radian it stands on no face: on its largest one, 2 x 40 by 2 x 60 mm."""
    model = model_of(box_file(tmp_path, turn=(0.5, 0.3, 0.0)), cache)
    assert sizes(model)[2] == pytest.approx(0.06, abs=1e-6)
    assert "most likely" in model.source.upright
    # of the object, only its frame is another: mesh points carried over are on its surface
    mesh = model.exact.mesh.vertices
    assert float(model.exact.distance(mesh.float()).abs().max()) < 1e-6


def test_as_it_is_told(tmp_path, cache):
    model = model_of(box_file(tmp_path), cache, upright=(90.0, 0.0, 0.0))
    assert sizes(model) == pytest.approx([0.06, 0.12, 0.08], abs=1e-6)
    # roll about x, then yaw about z
    both = model_of(box_file(tmp_path), cache, upright=(90.0, 0.0, 90.0)).source.object_T_mesh[:3, :3]
    torch.testing.assert_close(both @ torch.tensor([0.0, 1.0, 0.0]).double(), torch.tensor([0.0, 0.0, 1.0]).double())
    torch.testing.assert_close(both @ torch.tensor([1.0, 0.0, 0.0]).double(), torch.tensor([0.0, 1.0, 0.0]).double())


def test_an_origin_beside_the_object_is_moved(tmp_path, cache):
    model = model_of(box_file(tmp_path, at=(1.0, -2.0, 0.5)), cache)
    low, high = model.exact.bounds
    torch.testing.assert_close(low + high, torch.zeros(3), atol=1e-6, rtol=0)
    torch.testing.assert_close(model.source.object_T_mesh[:3, 3], torch.tensor([-1.0, 2.0, -0.5]).double())


def test_declared_symmetry_is_in_the_meshs_frame(tmp_path, cache):
    """Of a mesh that lies on its side, a turn about its own z is one about a level line."""
    path = box_file(tmp_path)
    model = model_of(path, cache, upright=(90.0, 0.0, 0.0), symmetry="z2")
    torch.testing.assert_close(model.symmetries.rotations[1], torch.diag(torch.tensor([-1.0, 1.0, -1.0])))
    assert model_of(path, cache, symmetry="none").symmetries.trivial
    with pytest.raises(UsageError, match="none, ball, or axes"):
        model_of(path, cache, symmetry="square")


def test_mass_and_friction(tmp_path, cache):
    own = ObjectSettings(mesh=str(box_file(tmp_path)), mass_kg=0.9, friction=0.2, spacing_m=0.004, collision="hull")
    spec, model = with_object(SPEC, own, cache_dir=cache)
    assert (spec.physics.mass_kg, spec.physics.friction, spec.physics.collision) == (0.9, 0.2, "hull")
    assert spec.object_factory() is model and spec.start == SPEC.start
    # also of the task's own object
    spec, model = with_object(SPEC, ObjectSettings(mass_kg=0.5))
    assert spec.physics.mass_kg == 0.5 and isinstance(model.exact, Mug) and model.source is None


def test_what_does_not_fit_the_task(tmp_path, cache):
    def fits(half, **settings):
        own = ObjectSettings(mesh=str(box_file(tmp_path, half)), collision="hull", spacing_m=0.01, **settings)
        return with_object(SPEC, own, cache_dir=cache)

    with pytest.raises(UsageError, match=r"at most 400 mm wide.*got 440 x 100 x 100 mm: if that is its size") as said:
        fits((0.22, 0.05, 0.05))
    assert "millimetres" not in str(said.value)
    side = r"\(--upright (0 -?90|-?90 0) 0\)"  # four are as likely, but for a last digit
    with pytest.raises(UsageError, match=rf"23 mm high, got 50 x 50 x 20 mm.*{side}, or touch it from above"):
        fits((0.025, 0.025, 0.01), upright=(0.0, 0.0, 0.0))
    # what would not stand on another side is not told to
    with pytest.raises(UsageError, match="pass over: touch it from above"):
        fits((0.05, 0.05, 0.0008))
    with pytest.raises(UsageError, match=r"as if it were in millimetres \(0.001\)"):
        own_model(ObjectSettings(mesh=str(box_file(tmp_path, (30.0, 40.0, 60.0)))))
    fits((0.22, 0.05, 0.05), scale=0.5)


def test_a_task_with_a_mesh(tmp_path, cache):
    """Built as the command does it: the origin of a mesh is where it is in the file, the object on the floor."""
    path = tmp_path / "mug.obj"
    write_obj(mug_mesh(Mug(), 0.006).moved(se3.make(torch.eye(3), torch.tensor([0.0, 0.0, -0.04]))), path)
    own = ObjectSettings(mesh=str(path), spacing_m=0.004, collision="hull")
    task, rummager = build(replace(preset(task="mug-0"), object=own), cache_dir=cache)
    assert rummager.height_m == pytest.approx(0.04)
    first = task.reset(0)
    expected = se3.from_planar(torch.tensor(SPEC.start), 0.04)
    shift, turn = se3.distance(first.truth, expected)
    assert float(shift) < 0.001 and float(turn) < 0.01
    seen = first.reading.observation
    local = se3.apply(se3.inverse(first.truth), seen.points)
    distance = task.model.exact.distance(local)
    assert float(distance[seen.semantics == 2].abs().max() if bool((seen.semantics == 2).any()) else 0.0) < 0.001
    assert rummager.model.symmetries.trivial
