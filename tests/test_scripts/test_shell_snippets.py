"""Shell commands of the tutorial and the how-to pages, carried out as they are printed, in a folder of their own.

What a page takes as given lies there: meshes, touched points, a bag, a run of the demo and one of an own robot. Runs
are made short (the preset `fast`, one action), the bridge's run ends after two. The README's commands have a test of
their own.
"""

import os
import re
import runpy
import shlex
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rumi
from rumi.cli import main
from rumi.environment import has_display
from rumi.viz.live import _free_ports
from scripts.bench.mug_mesh import mug_mesh, write_obj
from sdf.primitives import Mug
from tests.test_scripts.test_pages import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = {
    r"scripts/(demo|test)\b": "what this is run by",
    r"python -m (build|sphinx)\b": "run by test_wheel.py and .ci/run",
    r"python -m rerun_cli\b": "needs a graphics driver",
    r"python -m scripts\.bench\b": "takes hours",
    r"rumi reproduce (?!.*--show)": "takes hours",
    r"python scripts/ros_bridge_node\.py": "needs ROS 2; test_bridge.py holds it against a stub",
}
"""Commands that are parsed alone, by a pattern, with the reason."""
PAGES = sorted({page for page, _ in COMMANDS if page != "README.md"})
SHORT = ["--preset", "fast", "--steps", "1", "--no-figures"]
MESH_TOO = ["--collision", "hull"]

PUSH = """[topics]
"touched" = "contact"
"gripper" = { role = "pose", child = "gripper", frame = "base" }

"""
"""Topics of the recording as text."""

pytestmark = [pytest.mark.slow, pytest.mark.sim]


def commands(page):
    """Commands of a page in its order, without those that are left out."""
    known = {line for name, line in COMMANDS if name == page}
    lines = [line.strip() for line in (ROOT / page).read_text().splitlines()]
    found = list(dict.fromkeys(line for line in lines if line in known))
    assert set(found) == known
    return [line for line in found if not any(re.match(pattern, line) for pattern in LEFT_OUT)]


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """A folder with all that the pages take as given."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("matplotlib")
    pytest.importorskip("rosbags")
    pytest.importorskip("h5py")
    from rosbags.convert import convert
    from rosbags.typesys import Stores, get_typestore

    from tests.fixtures.bags import MAP, record

    folder = tmp_path_factory.mktemp("given")
    write_obj(mug_mesh(Mug(), 0.006), folder / "mug.obj")
    mug = trimesh.load(folder / "mug.obj")
    shutil.copy(folder / "mug.obj", folder / "drill.obj")
    points, faces = trimesh.sample.sample_surface(mug, 30, seed=1)
    points, normals = points + np.array([0.4, 0.0, 0.1]), mug.face_normals[faces]
    rows = [", ".join(f"{x:.6f}" for x in (*point, *normal)) for point, normal in zip(points, normals, strict=True)]
    (folder / "touches.csv").write_text("\n".join(rows) + "\n")
    trimesh.PointCloud(1000.0 * points).export(folder / "touches.ply")
    lying = trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))  # a page stands the cup up again
    for name in ("part.stl", "mug.stl", "cup.stl"):
        made = mug.copy().apply_scale(1000.0)
        (made.apply_transform(lying) if name == "cup.stl" else made).export(folder / name)
    for kept in {name for _, line in COMMANDS for name in re.findall(r"--results (\S+jsonl)", line)}:
        (folder / kept).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / kept, folder / kept)
    bag = record(folder / "bag").bag
    shutil.copy(bag, folder / "pushes.mcap")
    shutil.copy(bag, folder / "bag.mcap")
    types = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    convert([folder / "bag"], folder / "push.bag", "", 0, None, "", types[1], types[0], (), (), (), ())
    shutil.rmtree(folder / "bag")
    (folder / "monday").mkdir()
    for name in ("a.bag", "b.bag"):
        shutil.copy(folder / "push.bag", folder / "monday" / name)
    (folder / "lab.toml").write_text(MAP)
    (folder / "push").mkdir()
    (folder / "push/touched.csv").write_text("stamp_s,touched\n1.0,0\n1.5,1\n")
    (folder / "push/gripper.csv").write_text("stamp_s,x,y,z,qx,qy,qz,qw\n1,0,0,0.1,0,0,0,1\n2,0.1,0,0.1,0,0,0,1\n")
    (folder / "push.toml").write_text(re.sub(r"(?s)\[topics\].*?\n\n", PUSH, MAP))
    before = Path.cwd()
    os.chdir(folder)
    try:
        assert main(["run", "mug-0", "--no-figures", "--out", "runs/mug-0-rumi-default-s0"]) in (0, 1)
        assert main(["import", "bag.mcap", "--map", "lab.toml"]) == 0
        script("scripts/own_robot.py")
    finally:
        os.chdir(before)
    return folder


def script(path, *arguments):
    """Carry out a script of the checkout here, its run made short."""
    whole = rumi.run
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [path, *arguments])
        patch.setattr(rumi, "run", lambda *given, steps, **named: whole(*given, steps=1, **named))
        try:
            runpy.run_path(str(ROOT / path), run_name="__main__")
        except SystemExit as ended:
            assert ended.code in (0, None), (path, ended.code)


def test_what_is_left_out_is_on_a_page_and_little():
    lines = [line for page, line in COMMANDS]
    left = {line for line in lines if any(re.match(pattern, line) for pattern in LEFT_OUT)}
    assert all(any(re.match(pattern, line) for line in lines) for pattern in LEFT_OUT)
    assert len(left) < len(set(lines)) / 3


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_run(page, given, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "page"
    shutil.copytree(given, folder)
    monkeypatch.chdir(folder)
    server = None
    try:
        for line in commands(page):
            prepare(page, line)
            words = shlex.split(line, comments=True)
            if words[:2] == ["rumi", "serve"]:
                server, port = serving(server, words)
            elif words[:2] == ["python", "scripts/bridge_client.py"]:
                client = [sys.executable, "-I", str(ROOT / words[1]), str(port)]
                done = subprocess.run(client, capture_output=True, text=True, timeout=600)
                assert done.returncode == 0 and "true place" in done.stdout, done.stderr
            elif words[0] == "python":
                script(*words[1:], *(["--out", "runs/again"] if "--out" not in words else []))
            else:
                code = carry_out(words)
                assert code in allowed(words), (line, code, capsys.readouterr().err)
                assert "Traceback" not in capsys.readouterr().err
    finally:
        if server is not None:
            end(server)


def prepare(page, line):
    """What a page has its reader do by hand before a command."""
    if page.endswith("first-hour.md"):
        if line.startswith("rumi mesh"):
            text = (ROOT / page).read_text()
            for block in re.findall(r"(?ms)^```python\n(.*?)^```\n", text)[1:]:
                exec(block, {})
        if "--suggest" in line:
            Path("lab.toml").unlink()
        if "--map lab.toml" in line:  # lines that say TODO filled in; the object is a mesh
            from tests.fixtures.bags import MAP

            Path("lab.toml").write_text(MAP.replace('builtin = "mug"\n', ""))


def carry_out(words):
    """A command of rumi, its runs made short; the exit code."""
    name = words[1]
    extra = []
    if name == "run":
        extra = [*SHORT, *(MESH_TOO if "--mesh" in words else [])]
    words = [str(path) for word in words[1:] for path in (sorted(Path().glob(word)) if "*" in word else [word])]
    try:
        return main([*words, *extra])
    except SystemExit as ended:
        return ended.code


def allowed(words):
    """Exit codes that are right: 1 is of what ran and did not succeed."""
    if words[1] == "view" or "--view" in words:
        return (0, 1) if has_viewer() else (2,)
    return (0, 1) if words[1] in ("run", "replay", "doctor") else (0,)


def has_viewer():
    """Whether the viewer is installed; a window that opens would stay."""
    try:
        import rerun  # noqa: F401
    except ImportError:
        return False
    return not has_display()


def serving(server, words):
    """A server in a process of its own, on a port that is free, and the port."""
    if server is not None:
        end(server)
    port, _ = _free_ports()
    more = ["--port", str(port), "--preset", "fast", "--steps", "2"]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    server = subprocess.Popen(
        [sys.executable, "-m", "rumi", *words[1:], *more], env=env, stderr=subprocess.PIPE, text=True
    )
    assert any("serving on" in line for line in server.stderr), words
    with socket.create_connection(("127.0.0.1", port)):
        pass
    return server, port


def end(server):
    """End a server."""
    server.terminate()
    server.communicate(timeout=60.0)
