import json
import math
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from rumi.cli import main
from rumi.errors import UsageError
from rumi.registration.pose_summary import summarise_particles
from rumi.runs.export import FORMATS, estimates_of
from rumi.runs.export_files import roll_pitch_yaw
from rumi.runs.folder import RunRecorder, load_run
from rumi.tasks.registry import TASKS, entry_of
from sdf import se3, so3
from sdf.mesh.surface_nets import mesh_of
from sdf.primitives import Box
from tests.fixtures.made_up_run import make_up

TURNED = se3.exp(torch.tensor([0.4, -0.2, 0.7, 0.5, -1.1, 2.0], dtype=torch.float64))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made, folder = make_up(6, particles=20), tmp_path_factory.mktemp("runs") / "run"
    with RunRecorder(folder, {"task": "mug-0", "seed": 3}, made.geometry) as recorder:
        for step in made.steps:
            recorder(step)
        recorder.finish(made.result)
    return folder


@pytest.fixture(scope="module")
def found(folder):
    """Estimates of a run whose object ended tilted."""
    run = load_run(folder)
    made = estimates_of(run, entry_of(run).pose)
    last = replace(made.last, pose=replace(made.last.pose, world_T_object=TURNED))
    return replace(made, steps=(*made.steps[:-1], last), mesh=mesh_of(Box((0.02, 0.03, 0.04)), 0.01))


@pytest.fixture
def written(found, tmp_path):
    """Writes one format to a folder of its own."""

    def write(name):
        path = tmp_path / name / FORMATS[name].file
        path.parent.mkdir()
        files = FORMATS[name].write(found, path)
        assert sorted(files) == sorted(path.parent.iterdir()), "these files and nothing else"
        return path

    return write


def test_json_and_npz_say_the_same(found, written):
    told = json.loads(written("json").read_text())
    with np.load(written("npz")) as arrays:
        np.testing.assert_allclose(arrays["world_T_object"][-1], TURNED.numpy(), atol=1e-12)
        np.testing.assert_array_equal(arrays["covariance"][-1], np.array(told["pose"]["covariance"]))
        assert arrays["mode_weight"].sum(-1).max() <= 1 + 1e-9
        assert len(arrays["free"]) == told["free_points"] > 0
        np.testing.assert_allclose(np.exp(arrays["particle_log_weight"]).sum(), 1.0, atol=1e-6)
    assert [step["step"] for step in told["steps"]] == list(range(6))
    np.testing.assert_allclose(told["pose"]["world_T_object"], TURNED.numpy(), atol=1e-12)


@pytest.mark.sim
def test_mujoco_loads_the_object_at_its_pose(found, written):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(written("mjcf")))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body, geom = data.body("object"), data.geom(0)
    np.testing.assert_allclose(body.xpos, TURNED[:3, 3].numpy(), atol=1e-6)
    np.testing.assert_allclose(body.xmat.reshape(3, 3), TURNED[:3, :3].numpy(), atol=1e-6)
    placed = model.mesh_vert @ geom.xmat.reshape(3, 3).T + geom.xpos
    np.testing.assert_allclose(placed.min(0), se3.apply(TURNED, found.mesh.vertices).numpy().min(0), atol=1e-6)


def test_urdf_and_its_mesh(found, written):
    trimesh = pytest.importorskip("trimesh")
    kinematics = pytest.importorskip("pytorch_kinematics")
    path = written("urdf")
    chain = kinematics.build_chain_from_urdf(path.read_text()).to(dtype=torch.float64)
    pose = chain.forward_kinematics(torch.zeros(0, dtype=torch.float64))["object"].get_matrix()[0]
    torch.testing.assert_close(pose, TURNED, atol=1e-6, rtol=0)
    name = ElementTree.parse(path).find("link[@name='object']/visual/geometry/mesh").get("filename")
    mesh = trimesh.load(path.parent / name, process=False)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.vertices, found.mesh.vertices.numpy(), atol=1e-6)


@pytest.mark.parametrize("pitch", [0.3, math.pi / 2, -math.pi / 2])
def test_angles_of_a_rotation(pitch):
    axes = torch.eye(3, dtype=torch.float64)

    def turn(roll, pitch, yaw):
        x, y, z = (so3.exp(angle * axis) for angle, axis in zip((roll, pitch, yaw), axes, strict=True))
        return z @ y @ x

    rotation = turn(0.7, pitch, -2.0)
    torch.testing.assert_close(turn(*roll_pitch_yaw(rotation)), rotation, atol=1e-8, rtol=0)


def test_rosbags_reads_pose_covariance_modes_and_free_space(found, written):
    highlevel = pytest.importorskip("rosbags.highlevel")
    typesys = pytest.importorskip("rosbags.typesys")
    read = {}
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with highlevel.AnyReader([written("mcap")], default_typestore=store) as bag:
        for connection, _, data in bag.messages():
            read.setdefault(connection.topic, []).append(bag.deserialize(data, connection.msgtype))
    assert [len(read[topic]) for topic in ("/tf", "/rumi/pose", "/rumi/modes", "/rumi/free")] == [6, 6, 6, 1]
    last, pose = read["/rumi/pose"][-1], found.last.pose
    assert last.header.frame_id == "world" and last.header.stamp.sec == 6
    at, turn = last.pose.pose.position, last.pose.pose.orientation
    np.testing.assert_allclose((at.x, at.y, at.z), TURNED[:3, 3].numpy(), atol=1e-12)
    np.testing.assert_allclose((turn.x, turn.y, turn.z, turn.w), so3.quaternion(TURNED[:3, :3]).numpy(), atol=1e-12)
    np.testing.assert_array_equal(last.pose.covariance.reshape(6, 6), pose.covariance.numpy())
    frames = {one.child_frame_id: one.transform for one in read["/tf"][-1].transforms}
    assert frames["tool"].translation.x == pytest.approx(float(found.last.world_T_tool[0, 3]), abs=1e-12)
    assert frames["object"].rotation.w == turn.w
    assert list(read["/rumi/mode_weights"][-1].data) == [mode.weight for mode in pose.modes]
    assert read["/rumi/free"][0].width == len(found.free)


def test_a_covariance_is_that_of_ros_by_sampling():
    """A twist of the object's own frame, drawn by known standard deviations, is turned into the world's fixed axes."""
    own = torch.diag(torch.tensor([0.001, 0.002, 0.003, 0.01, 0.02, 0.03], dtype=torch.float64)) ** 2
    random = torch.Generator().manual_seed(1)
    twists = torch.randn(20000, 6, generator=random, dtype=torch.float64) @ own.sqrt()
    moved = se3.make(so3.exp(twists[:, 3:]), twists[:, :3])
    pose = summarise_particles(TURNED @ moved, torch.zeros(20000), TURNED)
    turn = torch.block_diag(TURNED[:3, :3], TURNED[:3, :3])
    scale = (turn @ own @ turn.T).diagonal().sqrt()
    away = (pose.covariance - turn @ own @ turn.T) / (scale[:, None] * scale)
    assert float(away.abs().max()) < 0.05


def test_the_command_writes_beside_the_run(folder, capsys):
    assert main(["export", str(folder), "--to", "json", "--step", "2"]) == 0
    path = folder / "export" / "pose.json"
    assert capsys.readouterr().out.strip() == str(path)
    assert len(json.loads(path.read_text())["steps"]) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["RUN", "--to", "usd"], "There is no format 'usd'; there are json, npz, mjcf, urdf, mcap"),
        (["RUN", "--to", "json", "--step", "9"], "0 to 5, got 9"),
        (["RUN", "--to", "json", "--mesh", "a.obj"], "Expected no --mesh with json"),
        (["RUN", "--to", "mjcf", "--mesh", "nowhere.obj"], "no such file"),
        (["RUN/settings.json", "--to", "json"], "is no HDF5 file"),
        (["nowhere", "--to", "json"], "There is no run folder nowhere"),
        (["RUN", "--to", "npz", "--out", "RUN/trace.npz"], "beside the run's own files"),
        (["RUN", "--to", "json", "--out", "RUN/../own.stl"], "to be new or a .json file"),
        (["RUN", "--to", "urdf", "--out", "RUN/../part.urdf"], "part.obj, where the mesh goes"),
        (["RUN", "--to", "urdf", "--mesh", "RUN/../part.obj", "--out", "RUN/../part.urdf"], "to leave the mesh"),
    ],
)
def test_bad_input_is_named(arguments, message, folder, capsys):
    block = mesh_of(Box((0.02, 0.03, 0.04)), 0.01)
    own = [f"v {x} {y} {z}" for x, y, z in block.vertices.tolist()]
    own += [f"f {a} {b} {c}" for a, b, c in (block.faces + 1).tolist()]
    files = {folder.parent / name: "\n".join(own) for name in ("own.stl", "part.obj")}
    for path, text in files.items():
        path.write_text(text)
    assert main(["export", *(word.replace("RUN", str(folder)) for word in arguments)]) == 2
    assert message in capsys.readouterr().err
    assert all(path.read_text() == text for path, text in files.items())


def test_a_run_that_knows_no_pose_yet_is_refused(folder):
    run = load_run(folder)
    blind = replace(run, steps=[SimpleNamespace(poses=None)])
    with pytest.raises(UsageError, match="which does not yet"):
        estimates_of(blind, entry_of(run).pose)


@pytest.mark.parametrize(("name", "size"), [("touch-box", (0.06, 0.16, 0.1)), ("peg", (0.2, 0.1, 0.06))])
def test_the_object_of_a_task_that_knows_its_measures_needs_no_file(name, size, tmp_path):
    from rumi.commands.export import object_mesh
    from rumi.runs.folder import Run

    entry = TASKS[name]
    mesh = object_mesh(Run(tmp_path, entry.as_dict(entry.preset("default")), None, [], None))
    low, high = mesh.bounds
    np.testing.assert_allclose((high - low).numpy(), size, atol=1e-12)
    np.testing.assert_allclose((high + low)[:2].numpy(), 0.0, atol=1e-12)
    assert low[2] == 0.0, "it stands on its frame's floor"
    a, b, c = mesh.corners.unbind(1)
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6.0)
    assert volume == pytest.approx(size[0] * size[1] * size[2]), "closed, and counter-clockwise from outside"
