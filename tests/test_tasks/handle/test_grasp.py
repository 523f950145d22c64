"""Grasps by the handle: of the true pose, of wrong ones, and chosen over a belief."""

import math

import pytest
import torch

from rumi.errors import UsageError
from rumi.sim.faults import parse_fault
from rumi.tasks.grasp_table import Grasp
from rumi.tasks.handle import build
from rumi.tasks.handle.grasp import best_grasp, handle_odds
from rumi.tasks.handle.gripper import HandleGripper, grasp_xml
from rumi.tasks.handle.settings import HandleSettings, task_of
from rumi.tasks.handle.simulated import HandleTask
from sdf import se3
from sdf.primitives import Sphere

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def gripper(mug, body):
    return HandleGripper(mug.exact, body, task_of(HandleSettings()).physics)


def test_with_the_true_pose_every_grasp_lifts(gripper):
    generator = torch.Generator().manual_seed(1000)
    for _ in range(12):
        share = torch.rand(3, generator=generator, dtype=torch.float64) - 0.5
        place = share * torch.tensor([0.2, 0.2, 2.0 * math.pi]) + torch.tensor([0.5, 0.0, 0.0])
        assert gripper.grasp(place, se3.from_planar(place))


@pytest.mark.parametrize("yaw", [0.5 * math.pi, math.pi])
def test_where_there_is_no_handle_nothing_is_lifted(gripper, yaw):
    true = torch.tensor([0.5, 0.0, 0.3], dtype=torch.float64)
    assert not gripper.grasp(true + torch.tensor([0.0, 0.0, yaw]), se3.from_planar(true))


def test_of_a_mug_of_another_size_the_agent_knows_nothing(gripper, mug, tool, monkeypatch):
    asked = []
    monkeypatch.setattr(build, "handle_table", lambda own, **_: asked.append(own))
    task, _ = build.build_handle(HandleSettings(), tool=tool, faults=[parse_fault("scale:20", steps=5)])
    still = torch.zeros(3)
    assert asked[0].shape.outer_radius == mug.exact.outer_radius
    assert grasp_xml(asked[0].shape, asked[0].body, asked[0].physics, asked[0].settings) == grasp_xml(
        gripper.shape, gripper.body, gripper.physics, gripper.settings
    )
    # the true mug is grasped as the other would be
    assert task.gripper.shape.outer_radius == pytest.approx(1.2 * mug.exact.outer_radius)
    assert (task.gripper.controls(still) == gripper.controls(still)).all()


def test_a_hand_that_is_off_and_a_mug_that_changed_are_grasped_as_they_are(mug, tool, monkeypatch):
    taken = []

    def grasp(self, pose, _):
        mass = float(self.model.body("object").mass[0])
        taken.append((pose, mass, float(self.model.geom("floor").friction[0])))
        return True

    monkeypatch.setattr(HandleGripper, "grasp", grasp)
    pose = torch.tensor([0.5, 0.0, 0.3], dtype=torch.float64)
    for texts in ((), ("hand:6@1", "mass:2@1", "friction:3@1"), ("mass:2@2",)):
        task = HandleTask(HandleSettings(), tool, mug, faults=[parse_fault(text, steps=5) for text in texts])
        task.reset(0)
        task.step(torch.zeros(3))
        task.finish(Grasp(pose, 1.0))
    plain, other, later = taken
    assert torch.equal(plain[0], pose) and torch.equal(later[0], pose) and later[1:] == plain[1:]
    assert float((other[0] - pose)[:2].norm()) == pytest.approx(0.006, abs=1e-6) and other[0][2] == pose[2]
    assert other[1:] == pytest.approx((2.0 * plain[1], 3.0 * plain[2]))


def test_only_mugs_have_handles(body):
    with pytest.raises(UsageError, match="mug"):
        HandleGripper(Sphere(0.03), body, task_of(HandleSettings()).physics)


def odds():
    """Lifted within 1 cm and 0.3 rad."""
    shape = (9, 6, 13)
    along, aside, yaw = (
        torch.linspace(-0.032, 0.032, shape[0]),
        torch.linspace(0.0, 0.04, shape[1]),
        torch.linspace(-0.9, 0.9, shape[2]),
    )
    good = (along.abs() < 0.01)[:, None, None] & (aside < 0.01)[:, None] & (yaw.abs() < 0.31)
    return handle_odds(good.to(torch.float64))


def test_the_table_knows_mirror_images_and_fails_beyond_its_ends():
    table = handle_odds(torch.rand(9, 6, 13, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    taken = torch.tensor([0.4, 0.1, 0.7], dtype=torch.float64)
    apart = torch.tensor([[0.01, 0.02, 0.3], [0.01, -0.02, -0.3], [0.05, 0.0, 0.0], [0.0, 0.0, 1.5]])
    true = se3.to_planar(se3.from_planar(taken) @ se3.from_planar(apart.double()))
    chance = table(taken, true)
    assert float(chance[0]) == pytest.approx(float(chance[1])) and float(chance[0]) > 0
    assert chance[2:].tolist() == [0.0, 0.0]
    node = se3.to_planar(se3.from_planar(taken) @ se3.from_planar(torch.tensor([-0.016, 0.008, 0.45]).double()))
    assert float(table(taken, node)) == pytest.approx(float(table.odds[2, 1, 9]), abs=1e-5)


def test_the_grasp_is_where_most_of_the_belief_is():
    poses = torch.tensor([[0.5, 0.0, 0.0], [0.502, 0.0, 0.1], [0.5, 0.0, 2.0]])
    grasp = best_grasp(se3.from_planar(poses), torch.tensor([0.3, 0.25, 0.45]).log(), odds())
    assert grasp.probability == pytest.approx(0.55, abs=1e-6)
    assert abs(float(grasp.pose[2])) < 0.2
