"""Python of the how-to pages, carried out as it is printed, with small stand-ins for what a page takes as given.

Those of the README, the tutorial, own objects and learning code run in tests of their own.
"""

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import rumi
from rumi.rosbag.mapping_file import mapping_of
from sdf import se3, so3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Box, Cylinder, Placed, Sphere
from sdf.symmetry import Symmetries
from sensors.vision.camera import look_at, pinhole

ROOT = Path(__file__).resolve().parents[2]
HOW_TO = ROOT / "scripts" / "docs" / "how-to"


def code(page: Path, *begins: str) -> str:
    """The blocks of a page, fenced or indented, that begin so."""
    text = page.read_text()
    fenced = re.findall(r"(?ms)^```python\n(.*?)^```\n", text)
    blocks = fenced + re.findall(r"(?m)(?:^ {4}.*\n)+(?:\n(?:^ {4}.*\n)+)*", re.sub(r"(?ms)^```.*?^```\n", "", text))
    found = [next(block for block in blocks if block.strip().startswith(begin)) for begin in begins]
    return "\n".join(re.sub(r"(?m)^ {4}", "", block) if block.startswith("    ") else block for block in found)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def meshes(here):
    """Files of a box, by the names that the pages use."""
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box((0.08, 0.06, 0.04))
    for name in ("part.stl", "mug.obj", "drill.obj"):
        box.export(name)
    box.apply_scale(1000.0).export("hand.stl")
    return here


def wall(metres: float) -> np.ndarray:
    return np.full((60, 80), metres, np.float32)


def test_a_camera_s_view(here):
    pytest.importorskip("cv2")
    given = {
        "body": None, "links": None, "box": torch.tensor([[0.2, -0.3, 0.0], [0.9, 0.3, 0.3]]),
        "depth": wall(0.5), "rgb": np.full((60, 80, 3), (20, 40, 220), np.uint8), "t": 0.0,
        "intrinsics": pinhole(60, 80, 0.8), "view": SimpleNamespace(memory=None),
        "world_T_camera": look_at(torch.tensor([0.0, 0.0, 0.4]), torch.tensor([0.5, 0.0, 0.0])),
    }  # fmt: skip
    exec(code(HOW_TO / "cameras.md", "from sensors import Image"), given)
    assert given["view"].surface.shape == (60, 80)


def test_a_cloud(here):
    pytest.importorskip("cv2")
    points = np.random.default_rng(0).uniform(0.0, 100.0, (200, 3))
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in points)
    head = (
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 200\nHEIGHT 1\nPOINTS 200\nDATA ascii\n"
    )
    Path("scene.pcd").write_text(head + rows)
    from sensors import ViewSettings

    given = {
        "world_T_camera": torch.eye(4), "settings": ViewSettings(segmentation="plane"),
        "g": torch.Generator().manual_seed(0),
    }  # fmt: skip
    exec(code(HOW_TO / "cameras.md", "from sensors.vision.point_files"), given)
    assert torch.as_tensor(given["cloud"].points).reshape(-1, 3).shape == (200, 3)
    assert float(torch.as_tensor(given["cloud"].points).max()) <= 0.1


def test_a_bubble(here):
    pytest.importorskip("cv2")
    pressed = wall(0.10)
    pressed[20:40, 30:50] = 0.09
    given = {"rest_depth": wall(0.10), "depth": pressed, "intrinsics": pinhole(60, 80, 0.8),
             "tool_T_camera": torch.eye(4), "world_T_tool": torch.eye(4)}  # fmt: skip
    exec(code(HOW_TO / "cameras.md", "from sensors.touch.bubble"), given)
    assert bool(given["patch"].contact.any())


def test_a_choice_in_time(here):
    given = {
        "states": torch.zeros(4, 2), "tool": torch.zeros(2), "log_weights": torch.zeros(4),
        "pokes_at": lambda state: [(state + 0.1, state + 0.2), (state + 0.2, state + 0.3)],
        "gain": lambda poke: float(poke[1][0]), "work_so_far": [100, 200, 300] * 100,
        "seconds_so_far": [1e-4, 2e-4, 3e-4] * 100,
    }  # fmt: skip
    exec(code(HOW_TO / "deadlines.md", "from rumi.planning.anytime"), given)
    assert given["made"].gain == pytest.approx(0.3)


def test_touches_by_a_wrench(here):
    turns = torch.stack([so3.exp(angle * torch.eye(3, dtype=torch.float64)[axis]) for axis in (0, 1) for angle in (0.0, 1.0, 2.0)])  # fmt: skip # noqa: E501
    weight = torch.tensor([0.0, 0.0, -2.0], dtype=torch.float64)
    felt = (turns.transpose(-1, -2) @ weight[:, None])[..., 0]
    still = torch.cat((felt, torch.zeros_like(felt)), -1)
    push = still[:1] + torch.tensor([-5.0, 0.0, 0.0, 0.0, -0.5, 0.0]).double()
    given = {"still_wrenches": still, "world_R_sensor": turns, "before_touch": still[:1], "readings": push,
             "world_R_sensor_then": turns[:1], "world_R_sensor_now": turns[:1]}  # fmt: skip
    exec(code(HOW_TO / "forces.md", "import torch"), given)
    assert given["contact"].status.tolist() == [1]
    torch.testing.assert_close(
        given["contact"].point_s[0], torch.tensor([0.0125, 0.0, 0.1]).double(), atol=1e-6, rtol=0
    )


@pytest.mark.sim
def test_signals_by_torques(here):
    joint = '<joint name="j{0}" type="hinge" axis="0 {1} {2}"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>'
    inner = joint.format(1, 1, 0) + '<body pos=".3 0 0">' + joint.format(2, 0, 1) + "</body>"
    Path("panda.urdf").write_text(f"<mujoco><worldbody><body>{inner}</body></worldbody></mujoco>")
    still = torch.zeros(50, 2, dtype=torch.float64)
    given = {"joints": ["j1", "j2"], "stamps": 0.001 * torch.arange(50.0, dtype=torch.float64), "position": still,
             "velocity": still, "torque": still, "free": slice(0, 20)}  # fmt: skip
    exec(code(HOW_TO / "forces.md", "from rumi.sim.robot_dynamics"), given)
    assert given["signal"].shape == (50,) and not bool(given["signal"][:20].any())


def test_touched_points(meshes):
    box = Box((0.04, 0.03, 0.02))
    points = torch.tensor([[0.04, 0.01, 0.0], [0.0, 0.03, 0.01], [0.01, 0.0, 0.02], [-0.04, 0.0, 0.0]]).double()
    assert float(box.distance(points).abs().max()) < 1e-9
    given = {"points": points}
    exec(code(HOW_TO / "localize.md", "from rumi.registration.from_contacts"), given)
    assert float(given["found"].distance_m.min()) < 1e-4


@pytest.fixture(scope="module")
def model() -> ObjectModel:
    return object_model("box", Box((0.03, 0.03, 0.03)), Symmetries.none(), spacing=0.006, points=20)


def test_a_dataset_of_runs(here, monkeypatch):
    from rumi.runs.folder import RunRecorder
    from tests.fixtures.made_up_run import make_up

    made = make_up(3, particles=5)
    for name in ("runs/mug-0-rumi-default-s0", "runs/pushes"):
        with RunRecorder(name, {"task": "mug-0", "seed": 3}, made.geometry) as recorder:
            for step in made.steps:
                recorder(step)
    text = code(HOW_TO / "learning.md", "from torch.utils.data")
    given = {}
    exec(text.replace("num_workers=2", "num_workers=0"), given)
    assert given["batch"].control.shape[:2] == (2, 3), "two runs of three steps"


def test_a_filter_to_learn_through(model):
    from rumi.belief.contact_evidence import ContactSignalEvidence
    from rumi.belief.evidence_filter import EvidenceFilter, SystematicResampler
    from rumi.belief.particles import PoseBelief
    from rumi.belief.prior import PlanarPrior
    from rumi.belief.rejuvenation import rejuvenate
    from sensors.touch.contact_model import ContactModel

    given = {
        "EvidenceFilter": EvidenceFilter, "SystematicResampler": SystematicResampler,
        "ContactSignalEvidence": ContactSignalEvidence, "generator": torch.Generator().manual_seed(0),
        "belief": PoseBelief.uniform(se3.identity((6,), dtype=torch.float32)), "mug": model.sdf,
        "probes": torch.zeros(1, 4, 3), "sensor": ContactModel(), "signals": torch.ones(1, dtype=torch.bool),
    }  # fmt: skip
    exec(code(HOW_TO / "learning.md", "track = EvidenceFilter"), given)
    assert math.isfinite(float(given["log"].sum()))
    given |= {
        "rejuvenate": rejuvenate, "prior": PlanarPrior(torch.zeros(1, 3), torch.ones(3)),
        "every": ContactSignalEvidence(model.sdf, given["probes"], given["sensor"], given["signals"]),
    }  # fmt: skip
    given["info"] = given["info"]._replace(resampled=torch.tensor(True))
    exec(code(HOW_TO / "learning.md", "belief = rejuvenate"), given)
    assert given["belief"].attached_T_object[:, 0, 3].unique().numel() > 1


def test_scenes_side_by_side():
    from rumi.loop import Last
    from tests.test_loop import Counter, Told

    given = {"tasks": [Told(), Told()], "agents": [Counter(enough=2), Counter(idle=1)]}
    exec(code(HOW_TO / "learning.md", "from rumi.session"), given)
    assert given["results"] == [(2, "sure", "grasp"), (1, "nothing to do", "grasp")]
    assert given["actions"] == ["on", Last("grasp")]


@pytest.mark.sim
@pytest.mark.slow
def test_an_environment(at_home):
    pytest.importorskip("gymnasium")
    given = {}
    exec(code(HOW_TO / "learning.md", "import gymnasium"), given)
    assert math.isfinite(given["reward"])


def test_tools(meshes):
    given = {"rumi": rumi, "Sphere": Sphere, "Placed": Placed, "Cylinder": Cylinder, "Box": Box,
             "up": se3.make(torch.eye(3), torch.tensor([0.0, 0.0, 0.08])), "ahead": torch.eye(4)}  # fmt: skip
    exec(code(HOW_TO / "own-robot.md", "ball = "), given)
    assert all(isinstance(given[name], rumi.SolidTool) for name in ("ball", "stick", "hand"))


def test_a_table_of_distances(meshes):
    given = {}
    exec(code(ROOT / "scripts/docs/results/meshes.md", "import sdf"), given)
    assert abs(float(given["table"].distance(torch.tensor([[0.06, 0.0, 0.0]]))) - 0.02) < 0.002


def test_a_log_of_one_s_own(here):
    pytest.importorskip("h5py")
    from sensors.log.reader import Log
    from sensors.log.writer import LogWriter, StreamSpec

    given = {"LogWriter": LogWriter, "StreamSpec": StreamSpec, "stamp_ns": 10**18}
    exec(code(ROOT / "scripts/docs/reference/files.md", "with LogWriter"), given)
    with Log("push.h5") as log:
        assert len(log.stream("wrist")) == 1


def test_the_mapping_file_of_the_page_is_one(here):
    """All tables of the reference at once but the alternatives that it names in comments."""
    text = (ROOT / "scripts/docs/reference/mapping.md").read_text()
    toml = re.sub(
        r"(?m)^ {4}", "", "\n".join(re.findall(r"(?m)^ {4}.*$", text.partition("Every setting is followed")[0]))
    )
    mapping = mapping_of(toml)
    assert mapping.wrench.radius_m == 0.0125 and mapping.robot.remove and mapping.actions.instants == 10
    assert json.dumps(mapping.settings) == '{"filter": {"motion": "corrected"}}'
