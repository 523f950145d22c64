"""The example of an own robot, from its fake driver to its replayed log, and the check of its calibration."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

from rumi import exit_codes
from rumi.cli import main
from rumi.errors import UsageError
from rumi.metrics.alignment import align
from rumi.rosbag.mapping import read_mapping
from rumi.rosbag.scene import rummager_of_map, settings_of
from rumi.runs.replay import replay
from rumi.task import Task
from rumi.tasks.rummage.scenes import large_handled_mug
from rumi.tasks.rummage.settings import preset, to_dict
from sdf import se3
from sdf.primitives import Box, Sphere
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

pytest.importorskip("h5py")

from sensors.log.reader import Log

SCRIPT = Path(__file__).resolve().parent.parent.parent / "scripts" / "own_robot.py"
TRUTH = se3.from_planar(torch.tensor([0.56, 0.03, 0.7]))


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("own_robot", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def found(script, tmp_path_factory):
    """A run of the fake robot: its folder and its last step."""
    folder = tmp_path_factory.mktemp("own")
    _, last = script.main(folder, script.FakeDriver(TRUTH))
    return folder, last


@pytest.mark.slow
def test_it_finds_the_mug(found):
    _, last = found
    pose = last.belief.mode()
    assert float((pose[:2, 3] - TRUTH[:2, 3]).norm()) < 0.005
    assert last.contacts > 0


@pytest.mark.parametrize("taken", ["log.h5", "settings.json"])
def test_a_folder_with_a_run_or_a_log_is_refused(script, taken, tmp_path):
    (tmp_path / taken).write_text("of another run")
    with pytest.raises(UsageError, match=r"holds a (run|log) already: give another folder"):
        script.main(tmp_path, script.FakeDriver(TRUTH))
    assert [path.name for path in tmp_path.iterdir()] == [taken]


def test_a_camera_that_is_off_by_no_number_is_refused(script):
    with pytest.raises(UsageError, match="Expected --camera-off in metres, got nan"):
        script.FakeDriver(TRUTH, camera_off_m=float("nan"))


def test_it_is_a_task(script, tmp_path):
    mapping = read_mapping(SCRIPT.with_suffix(".toml"))
    with script.LogWriter(tmp_path / "log.h5", script.STREAMS) as log:
        driver = script.FakeDriver(TRUTH)
        robot = script.OwnRobot(driver, mapping, log)
        assert isinstance(robot, Task)
        first = robot.reset(0)
        seen = first.reading.observation
        surface, free = (seen.points[seen.of_class(kind)] for kind in (Semantics.SURFACE, Semantics.FREE))
        exact = large_handled_mug().exact
        off = exact.distance(se3.apply(se3.inverse(TRUTH), surface))
        assert len(surface) > 100 and float(off.abs().max()) < 0.006
        assert float(exact.distance(se3.apply(se3.inverse(TRUTH), free)).min()) > 0
        robot.tool = rummager_of_map(mapping, settings_of(mapping), first.reading.tool_pose[:, :3, 3]).tool
        touched = 0
        for control in torch.tensor([[1.0, 0.4, 0.0]] + 4 * [[1.0, 0.0, 0.0]]):
            reading = robot.step(control).reading
            felt = reading.observation.points[reading.observation.of_class(Semantics.SURFACE)]
            touched += len(felt)
            if len(felt):
                assert float(exact.distance(se3.apply(se3.inverse(TRUTH), felt)).abs().max()) < 0.0031
            free = reading.observation.points[reading.observation.of_class(Semantics.FREE)]
            if len(free):
                assert float(exact.distance(se3.apply(se3.inverse(TRUTH), free)).min()) > 0
        assert touched > 0


@pytest.mark.slow
def test_its_readings_give_the_same_belief_bit_for_bit(found):
    folder, last = found
    mapping = read_mapping(SCRIPT.with_suffix(".toml"))
    with Log(folder / "log.h5") as log:
        taken = log.taken()
        assert log.problems == [] and log.end["steps"] == last.step
    rummager = rummager_of_map(mapping, settings_of(mapping), taken[0].reading.tool_pose[:, :3, 3])
    done = replay(taken, rummager, seed=0)
    assert done.same == [True] * (last.step + 1)


@pytest.mark.slow
def test_its_raw_streams_give_the_object_too(found, capsys, monkeypatch, tmp_path):
    folder, _ = found
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RUMI_CACHE", str(tmp_path))
    assert main(["replay", str(folder)]) in (exit_codes.DONE, exit_codes.NOT_CONVERGED)
    said = capsys.readouterr()
    assert "left out" not in said.err
    (line,) = [line for line in said.out.splitlines() if "pose     x" in line]
    x, y = (float(word) for word in line.split()[2:6:2])
    assert abs(x - 0.56) < 0.005 and abs(y - 0.03) < 0.005


def test_check_finds_a_camera_that_is_off(script, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RUMI_CACHE", str(tmp_path))
    mapping = read_mapping(SCRIPT.with_suffix(".toml"))
    for name, off in (("good.h5", 0.0), ("off.h5", 0.01)):
        with script.LogWriter(tmp_path / name, script.STREAMS, about={"map": mapping.text}) as log:
            script.OwnRobot(script.FakeDriver(TRUTH, camera_off_m=off), mapping, log).reset(0)
    pose = ["--pose", "0.56", "0.03", "0", "0", "0", "40.107"]
    assert main(["check", "good.h5", *pose]) == exit_codes.DONE
    good = capsys.readouterr().out
    assert "0.0 % beyond 6 mm" in good and " 0 of them inside the object" in good
    assert Path("check.png").stat().st_size > 10_000
    assert main(["check", "good.h5", "--step", "99"]) == exit_codes.BAD_INPUT
    assert "Expected --step 0 to" in capsys.readouterr().err
    assert main(["check", "off.h5", *pose, "--out", "off"]) == exit_codes.DONE
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "nearest" in line]
    shift = [float(word.strip("(,)")) for word in line.split("moved by ")[1].split()[:3]]
    assert abs(shift[0] + 10.0) < 0.5 and abs(shift[1]) < 0.5 and abs(shift[2]) < 0.5


def points_on(solid, count, generator):
    """Points on a solid's surface: random ones brought there along the gradient."""
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    points = 0.1 * points / points.norm(dim=-1, keepdim=True)
    for _ in range(50):
        points = points.detach().requires_grad_(True)
        distance = solid.distance(points)
        (slope,) = torch.autograd.grad(distance.sum(), points)
        points = (points - distance[:, None] * slope).detach()
    return points


def test_check_of_a_log_without_a_reading_says_so(script, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    settings = to_dict(preset("default", task="mug-0"))
    with script.LogWriter(tmp_path / "log.h5", settings=settings):
        pass
    assert main(["check", "log.h5"]) == exit_codes.BAD_INPUT
    assert "Expected a log with a first reading at least, got none: there is nothing to draw" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("out", "written"),
    [("folder", "folder/check.png"), ("pic", "pic.png"), ("a/b.svg", "a/b.svg"), ("a.b/pic", "a.b/pic.png")],
)
def test_check_names_the_picture_that_it_writes(out, written, monkeypatch, tmp_path):
    from rumi.commands.check import _picture

    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    assert _picture(Path(out)) == Path(written)


def test_check_refuses_what_it_cannot_draw(capsys):
    pose = ["--pose", "0.5", "nan", "0", "0", "0", "0"]
    assert main(["check", "none.h5", *pose]) == exit_codes.BAD_INPUT
    assert "Expected --pose to be six numbers, got 0.5 nan" in capsys.readouterr().err
    assert main(["check", "none.h5", "--pose", "0.5", "1"]) == exit_codes.BAD_INPUT
    assert "Expected --pose to be six numbers, got 0.5 1.0" in capsys.readouterr().err
    assert main(["check", "none.h5", "--pose"]) == exit_codes.BAD_INPUT
    assert "Expected --pose to be six numbers, got none" in capsys.readouterr().err
    assert main(["check", "none.h5", "--out", "pic.xyz"]) == exit_codes.BAD_INPUT
    assert "Expected --out to end in .png, .pdf" in capsys.readouterr().err


def test_misfit_of_a_box_is_undone(generator):
    box = Box((0.05, 0.08, 0.03))
    pose = se3.exp(torch.tensor([0.4, 0.1, 0.2, 0.3, -0.2, 0.5], dtype=torch.float64))
    off = se3.exp(torch.tensor([0.004, -0.003, 0.002, 0.02, 0.01, -0.03], dtype=torch.float64))
    on = points_on(box, 600, generator)
    seen = Observation.of(se3.apply(pose @ off, on), Semantics.SURFACE)
    inside = Observation.of(pose[None, :3, 3].clone(), Semantics.FREE)
    found = align(concatenate([seen, inside]), pose, box)
    assert float(found.corrected.abs().max()) < 1e-6
    at = se3.make(torch.eye(3, dtype=torch.float64), pose[:3, 3])
    expected = se3.inverse(at) @ pose @ se3.inverse(off) @ se3.inverse(pose) @ at
    torch.testing.assert_close(found.correction, expected, atol=1e-5, rtol=0)
    assert float(found.free[0]) < -0.02
    assert "1 points: 1 of them inside the object, the deepest" in found.text()


def test_what_points_do_not_tell_is_left_alone(generator):
    ball = Sphere(0.05)
    seen = points_on(ball, 200, generator) + torch.tensor([0.003, 0.0, 0.0], dtype=torch.float64)
    found = align(Observation.of(seen, Semantics.SURFACE), torch.eye(4, dtype=torch.float64), ball)
    assert float(found.corrected.abs().max()) < 1e-6
    expected = torch.tensor([-0.003, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(found.correction[:3, 3], expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.correction[:3, :3], torch.eye(3, dtype=torch.float64), atol=0.01, rtol=0)


def test_few_points_give_no_correction():
    seen = Observation.of(torch.zeros(3, 3), Semantics.SURFACE)
    found = align(seen, torch.eye(4), Sphere(0.05))
    assert found.correction is None
    assert "surface  3 points" in found.text() and "fewer than 20 points: this says nothing" in found.text()


def test_one_patch_gives_no_correction(generator):
    box = Box((0.05, 0.08, 0.03))
    side = torch.rand(400, 3, dtype=torch.float64, generator=generator)
    patch = torch.tensor([0.02, 0.02, 0.0]) * side + torch.tensor([0.0, 0.0, 0.033])
    found = align(Observation.of(patch, Semantics.SURFACE), torch.eye(4, dtype=torch.float64), box)
    assert found.correction is None
    assert "nearest  one patch, 28 mm across: this says nothing" in found.text()
