"""The gripper in MuJoCo, the table of its grasps, and particles that MuJoCo pushes."""

import math
from dataclasses import replace

import pytest
import torch

pytest.importorskip("mujoco")

from rumi.dynamics.along_path import push_along_path
from rumi.dynamics.sliding import Sliding
from rumi.sim.path_push import MujocoPathPush
from rumi.tasks.touch_box import grasps as touch_grasps
from rumi.tasks.touch_box.gripper_robot import GripperRobot
from rumi.tasks.touch_box.mujoco_scene import path_scene
from rumi.tasks.touch_box.robot import TouchRobot
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask
from sdf.cache import save_arrays

TASK = TouchTask(rates=(1.0, 0.0))
BOX = torch.tensor([0.45, 0.1, 0.3], dtype=torch.float64)


@pytest.fixture(scope="module")
def robot():
    return GripperRobot(TASK)


def truth(pose=BOX, friction=0.4):
    return BoxTruth(pose, friction, 0.4, 0.5)


def poke(pose, angle, aside=0.0, depth=0.02):
    """Straight at a box from one side, on until the fingers' middle is `depth` beyond its own."""
    way = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    across = torch.stack((-way[1], way[0]))
    end = pose[:2] + aside * across + depth * way
    share = torch.linspace(0.0, 1.0, 41, dtype=torch.float64)[:, None]
    line = end - 0.2 * way + share * 0.2 * way
    return torch.cat((line, torch.full((41, 1), angle, dtype=torch.float64)), 1)


def slides(count=1, friction=0.4):
    return Sliding(
        torch.zeros(2, dtype=torch.float64),
        torch.tensor(1.8 * TASK.even_lever_m, dtype=torch.float64),
        torch.tensor(friction, dtype=torch.float64),
    ).expand(count)


def test_a_poke_pushes_as_the_quasi_static_model_has_it(robot):
    assert isinstance(robot, TouchRobot)
    for angle, aside in ((0.3, 0.0), (0.3, 0.03), (0.3 + 0.5 * math.pi, 0.01)):
        robot.reset(truth(), 0)
        start = robot.box_pose()
        path = poke(BOX, angle, aside, depth=0.0)
        touched = robot.execute(path, lambda so_far: True)
        assert float((touched.path - path)[:, :2].norm(dim=-1).max()) < 1e-3
        expected = push_along_path(start[None], touched.path[None], TASK.fingers, TASK.outline, slides())
        moved = float((robot.box_pose() - start)[:2].norm())
        assert moved > 0.02
        assert float((robot.box_pose() - expected.track[0, -1])[:2].norm()) < 0.15 * moved
        felt = expected.distance[0] <= 2e-4
        assert int((felt != touched.contact).sum()) <= 3


def test_a_poke_is_cut_short_or_blocked(robot):
    robot.reset(truth(), 0)
    touched = robot.execute(poke(BOX, 0.3), lambda so_far: not bool(so_far.contact.any()))
    assert touched.stopped == "belief"
    assert touched.contact.tolist() == [False] * (len(touched.contact) - 1) + [True]
    onto = poke(BOX, 0.3, depth=0.2)  # begins at the box's middle
    before = robot.box_pose()
    blocked = robot.execute(onto, lambda so_far: True)
    assert blocked.blocked and blocked.stopped == "blocked" and len(blocked.contact) == 0
    assert float((robot.box_pose() - before)[:2].norm()) < 0.01


@pytest.mark.parametrize(
    ("aside", "turned", "holds"), [(0.0, 0.0, True), (0.008, 0.2, True), (0.03, 0.0, False), (0.0, 1.2, False)]
)
def test_a_grasp_lifts_what_is_between_the_fingers(robot, aside, turned, holds):
    robot.reset(truth(), 0)
    across = torch.tensor([math.cos(0.3), math.sin(0.3)], dtype=torch.float64)
    pose = robot.box_pose() + torch.cat((aside * across, torch.tensor([turned])))
    assert robot.grasp(pose) is holds


def test_the_table_of_grasps_is_what_the_gripper_does(robot, tmp_path, monkeypatch):
    monkeypatch.setattr(touch_grasps, "_ENDS", (0.03, 0.06, 0.6))
    monkeypatch.setattr(touch_grasps, "_COUNTS", (2, 2, 3))
    table = touch_grasps.grasp_table(TASK, cache_dir=tmp_path)
    # in the middle and straight it is lifted, 30 mm aside not, wherever along and however turned
    assert table.odds[0, 0, 1] == 1.0
    assert float(table.odds[1].max()) == 0.0
    assert len(list(tmp_path.iterdir())) == 1
    again = touch_grasps.grasp_table(TASK, cache_dir=tmp_path)
    torch.testing.assert_close(again.odds, table.odds, rtol=0, atol=0)


@pytest.fixture
def told(monkeypatch):
    """Floors of the grasps that were simulated, without simulating them."""
    asked = []

    def lifted(robot, boxes, which):
        asked.append([one.floor_friction for one in which])
        return torch.ones(len(boxes))

    monkeypatch.setattr(touch_grasps, "lifted", lifted)
    return asked


@pytest.mark.parametrize("damage", [lambda data: data[:100], lambda data: b"", lambda data: data[:-40] + b"x" * 40])
def test_a_damaged_table_of_grasps_is_simulated_again(tmp_path, told, damage):
    touch_grasps.grasp_table(TASK, cache_dir=tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(damage(path.read_bytes()))
    again = touch_grasps.grasp_table(TASK, cache_dir=tmp_path)
    assert len(told) == 2 and float(again.odds.min()) == 1.0
    assert torch.equal(touch_grasps.grasp_table(TASK, cache_dir=tmp_path).odds, again.odds)
    assert len(told) == 2 and [one.name for one in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("odds", [torch.ones(2, 2), torch.full(touch_grasps._COUNTS, float("nan")).double()])
def test_a_table_of_something_else_is_simulated_again(tmp_path, told, odds):
    touch_grasps.grasp_table(TASK, cache_dir=tmp_path)
    (path,) = tmp_path.iterdir()
    save_arrays(path, {"odds": odds.numpy()})
    assert float(touch_grasps.grasp_table(TASK, cache_dir=tmp_path).odds.min()) == 1.0
    assert len(told) == 2


@pytest.mark.parametrize(
    "other", [{"floor_friction": (1.5, 2.0)}, {"friction": (0.3, 0.6)}, {"mass_kg": (0.5, 0.6)}, {"half": (0.02, 0.08)}]
)
def test_each_task_has_its_own_table(tmp_path, told, other):
    touch_grasps.grasp_table(TASK, cache_dir=tmp_path)
    touch_grasps.grasp_table(replace(TASK, **other), cache_dir=tmp_path)
    assert len(told) == len(list(tmp_path.iterdir())) == 2


def test_a_box_that_a_path_begins_inside_of_stays(generator):
    """The engine would throw it metres away."""
    path = poke(BOX, 0.3, depth=0.0)[None]
    away = torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.02, 0.4], [-0.03, 0.0, 1.2]], dtype=torch.float64)
    start = path[0, :1] * torch.tensor([1.0, 1.0, 0.0])
    inside = start + away
    outside = torch.stack((BOX, start[0] + torch.tensor([0.0385, 0.0, 0.0])))  # the second by 1.5 mm less than touching
    poses = torch.cat((inside, outside))
    found = MujocoPathPush(path_scene(TASK), threads=1)(poses, path, TASK.fingers, TASK.outline, slides(5))
    assert torch.equal(found.track[:3], inside[:, None].expand(3, 40, 3))
    assert bool((found.distance[:3, 0] < 0).all())
    steps = torch.cat((poses[:, None], found.track), 1).diff(dim=1)[..., :2].norm(dim=-1)
    assert float(steps.max()) < 0.02
    assert float((found.track[3, -1] - BOX)[:2].norm()) > 0.02


def test_particles_in_the_engine_are_the_same_with_any_number_of_threads(generator):
    poses = BOX + torch.tensor([0.03, 0.03, 0.3]) * torch.randn(12, 3, generator=generator, dtype=torch.float64)
    path = poke(BOX, 0.3)[None]
    friction = 0.2 + 0.4 * torch.rand(12, generator=generator, dtype=torch.float64)
    own = slides(12)._replace(friction=friction)
    one, two = (
        MujocoPathPush(path_scene(TASK), threads=n)(poses, path, TASK.fingers, TASK.outline, own) for n in (1, 2)
    )
    assert torch.equal(one.track, two.track)
    assert torch.equal(one.distance, two.distance)


def test_particles_in_the_engine_go_as_quasi_static_ones_do():
    far = torch.tensor([0.45, 0.5, 0.0], dtype=torch.float64)
    poses = torch.stack((BOX, BOX + torch.tensor([0.01, 0.02, 0.1]), far))
    path = poke(BOX, 0.3, depth=0.0)[None]
    engine = MujocoPathPush(path_scene(TASK))(poses, path, TASK.fingers, TASK.outline, slides(3))
    model = push_along_path(poses, path, TASK.fingers, TASK.outline, slides(3))
    moved = (model.track[:, -1] - poses)[:2, :2].norm(dim=-1)
    apart = (engine.track[:, -1] - model.track[:, -1])[:2, :2].norm(dim=-1)
    assert bool((apart < 0.2 * moved).all())
    assert torch.equal(engine.track[2, -1], far)
    assert float((engine.distance - model.distance).abs().max()) < 0.006
