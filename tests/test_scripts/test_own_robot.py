"""The example of an own robot, from its stub to its replayed run, and the check of a camera's calibration."""

import ast
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import rumi
from rumi import exit_codes
from rumi.cli import main
from rumi.metrics.alignment import align
from rumi.task import Task
from rumi.tasks.rummage.settings import preset, to_dict
from sdf import se3
from sdf.primitives import Box, Sphere
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from sensors.vision.camera import look_at, pinhole

pytest.importorskip("h5py")

from sensors.log.writer import LogWriter, StreamSpec

SCRIPT = Path(__file__).resolve().parent.parent.parent / "scripts" / "own_robot.py"
TRUTH = se3.from_planar(torch.tensor([0.56, 0.03, 0.7]))
MAP = """
schema = 1
[topics]
"depth" = { role = "depth", camera = "camera" }
"camera" = "camera"
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "mug"
within = [[0.40, -0.15, 0.0], [0.75, 0.20, 0.15]]
[actions]
view_s = 0.2
"""
STREAMS = [
    StreamSpec("depth", "depth", "camera", {"topic": "depth", "camera": "camera"}),
    StreamSpec("camera", "camera", "camera", {"topic": "camera"}),
    StreamSpec("tf/base/gripper", "pose", "base", {"parent": "base", "child": "gripper"}),
    StreamSpec("tf/base/camera", "pose", "base", {"parent": "base", "child": "camera", "static": True}),
]


def code_lines(source, imports=False):
    """Lines of code: without blank ones, comments and docstrings, and with imports where they are asked for."""
    tree = ast.parse(source)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    skipped = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom) and not imports]
    skipped += [node.body[0] for node in ast.walk(tree) if isinstance(node, documented) and ast.get_docstring(node)]
    away = {line for node in skipped for line in range(node.lineno, node.end_lineno + 1)}
    lines = enumerate(source.splitlines(), 1)
    return [at for at, line in lines if line.strip() and not line.strip().startswith("#") and at not in away]


def test_the_example_is_short():
    """A robot, its camera, its mug and the run of it: sixty lines that a newcomer reads before writing others."""
    assert len(code_lines(SCRIPT.read_text(encoding="utf-8"))) <= 60


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("own_robot", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def agent(script):
    return script.robot_for().agent


@pytest.fixture
def robot(script, agent):
    """A robot whose mug nobody has pushed yet."""
    return script.Robot(agent, TRUTH.clone())


@pytest.fixture(scope="module")
def found(script, tmp_path_factory):
    """A run of the made-up robot: its folder, how it ended, its steps and the robot."""
    folder = tmp_path_factory.mktemp("own") / "run"
    return folder, *script.main(folder)


@pytest.mark.slow
@pytest.mark.outcome
def test_it_ends_sure_and_right(found):
    _, result, steps, robot = found
    shift, turn = se3.distance(steps[-1].belief.mode(), robot.truth)
    assert result.stopped_by == "sure" and float(shift) < 0.002 and float(turn) < 0.05
    assert float(se3.distance(robot.truth, TRUTH)[0]) > 0.01  # and the mug was pushed about meanwhile


@pytest.mark.slow
def test_its_replay_is_the_run(found):
    folder, _, steps, robot = found
    assert rumi.replay(folder, robot.agent).same == [True] * len(steps)


def test_check_finds_a_camera_that_is_off(robot, capsys, monkeypatch, tmp_path):
    """The log of one first view, whose camera is where it is, or is not where the log says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RUMI_CACHE", str(tmp_path))
    robot.reset(0)
    camera, intrinsics = (
        look_at(torch.tensor([-0.05, 0.0, 0.4]), torch.tensor([0.55, 0.03, 0.02])),
        pinhole(120, 160, 0.8),
    )
    depth = robot.depth(camera, intrinsics).numpy()
    for name, off in (("good.h5", 0.0), ("off.h5", 0.01)):
        told = camera.clone()
        told[0, 3] += off
        with LogWriter(tmp_path / name, STREAMS, about={"map": MAP}) as log:
            log.append("tf/base/gripper", 10**9, 10**9, pose=robot.tool.pose(robot.at).numpy())
            log.append("tf/base/camera", 10**9, 10**9, pose=told.numpy())
            size, none = np.array(depth.shape, np.int32), np.zeros(0)
            log.append("camera", 10**9, 10**9, intrinsics=intrinsics.numpy(), distortion=none, size=size)
            log.append("depth", 10**9 + 10**8, 10**9 + 10**8, depth=np.where(np.isfinite(depth), depth, 0.0))
            log.append("tf/base/gripper", 10**9 + 2 * 10**8, 10**9 + 2 * 10**8, pose=robot.tool.pose(robot.at).numpy())
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


def test_its_readings_are_true(robot):
    """What it saw and felt is on the mug where it then is, and what it swept is not in it."""
    exact = robot.model.exact
    assert isinstance(robot, Task)
    first, before, touched = robot.reset(0), robot.truth, 0
    assert int(first.observation.of_class(Semantics.SURFACE).sum()) > 100
    for control in torch.tensor([[1.0, 0.4, 0.0]] + 4 * [[1.0, 0.0, 0.0]]):
        reading = robot.step(control)
        at = (reading.object_motion @ before)[reading.instant]
        places = se3.apply(se3.inverse(at), reading.observation.points[:, None])[:, 0]
        off, felt = exact.distance(places), reading.observation.of_class(Semantics.SURFACE)
        assert bool((off[~felt] > -0.003).all())
        touched += int(felt.sum())
        if bool(felt.any()):
            assert float(off[felt].abs().max()) < 0.003
        before = reading.object_motion[-1] @ before
    assert touched > 0 and torch.allclose(before, robot.truth, atol=1e-5)


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
    with LogWriter(tmp_path / "log.h5", settings=settings):
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
