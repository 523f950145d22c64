"""Physics of pushing: upright, at rest, and hardly dependent on the time step."""

import math

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.sim.bodies import pieces
from rumi.sim.settings import PhysicsSettings
from rumi.sim.world import World
from sdf import se3
from sdf.primitives import Mug

pytestmark = pytest.mark.sim

SHAPE = Mug(tube_radius=0.008, ring_radius=0.035)
HEIGHT = 0.045

# tool (x, y, yaw), mug (x, y, yaw), motion: 80 mm each
PUSHES = {
    "centred": ((0.30, 0.0, 0.0), (0.40, 0.0, 0.0), (0.08, 0.0, 0.0)),
    "off centre": ((0.30, 0.03, 0.0), (0.40, 0.0, 0.3), (0.08, 0.0, 0.0)),
    "from the side": ((0.40, -0.10, 1.57), (0.42, 0.0, 0.3), (0.0, 0.08, 0.0)),
    "turning": ((0.45, -0.12, 1.2), (0.45, 0.0, 0.0), (0.02, 0.077, 0.3)),
    "against the handle": ((0.28, -0.02, 0.0), (0.37, 0.0, 2.8), (0.077, 0.02, 0.2)),
    "at the handle's side": ((0.50, -0.10, 1.8), (0.45, 0.01, 0.0), (-0.04, 0.069, 0.0)),
}


def push(name, time_step, mini_steps=20):
    start, mug, motion = (torch.tensor(v, dtype=torch.float64) for v in PUSHES[name])
    world = World(SHAPE, GripperShape(), HEIGHT, time_step)
    world.reset(start, mug)
    targets = start + torch.arange(1, mini_steps + 1)[:, None] / mini_steps * motion
    return world, world.move(targets, 1.0, 0.1), targets, mug


@pytest.mark.parametrize("name", PUSHES)
def test_push_of_80_mm(name):
    world, track, targets, mug = push(name, 0.004)
    pose = track.world_T_object[-1]
    moved = float((pose[:2, 3] - mug[:2]).norm())
    assert 0.02 < moved < 0.09  # it was pushed, and not flung
    tilt = torch.rad2deg(torch.acos(track.world_T_object[:, 2, 2].clamp(-1, 1)))
    assert float(tilt.max()) < 5.0
    assert float(track.world_T_object[:, 2, 3].abs().max()) < 0.003
    assert float(np.linalg.norm(world.data.joint("object").qvel[:3])) < 0.001
    # the gripper is where it was told to be
    gap = (track.configuration[-1] - targets[-1]).abs()
    assert float(gap.max()) < 0.0005
    _, fine, _, _ = push(name, 0.0005)
    shift, turn = se3.distance(pose, fine.world_T_object[-1])
    assert float(shift) < 0.005
    assert math.degrees(float(turn)) < 3.0


def test_same_push_same_bytes():
    first, second = push("turning", 0.004)[1], push("turning", 0.004)[1]
    assert torch.equal(first.world_T_object, second.world_T_object)
    assert torch.equal(first.configuration, second.configuration)


def test_reset_forgets_the_push():
    world, track, targets, mug = push("turning", 0.004)
    world.reset(torch.tensor(PUSHES["turning"][0], dtype=torch.float64), mug)
    again = world.move(targets, 1.0, 0.1)
    assert torch.equal(again.world_T_object, track.world_T_object)


def test_mirrored_push_is_mirrored():
    start, mug, motion = (torch.tensor(v, dtype=torch.float64) for v in PUSHES["off centre"])
    mirror = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    ends = []
    for sign in (torch.ones(3, dtype=torch.float64), mirror):
        world = World(SHAPE, GripperShape(), HEIGHT, 0.001)
        world.reset(sign * start, sign * mug)
        targets = sign * start + torch.arange(1, 21)[:, None] / 20 * (sign * motion)
        ends.append(sign * se3.to_planar(world.move(targets, 1.0, 0.1).world_T_object[-1]))
    assert float((ends[0] - ends[1])[:2].norm()) < 0.002
    assert float((ends[0] - ends[1])[2].abs()) < 0.03


def test_untouched_mug_stays():
    world = World(SHAPE, GripperShape(), HEIGHT, 0.004)
    mug = torch.tensor([0.5, 0.1, 0.4], dtype=torch.float64)
    world.reset(torch.tensor([0.1, 0.0, 0.0]), mug)
    track = world.move(torch.linspace(0.1, 0.18, 20)[:, None] * torch.tensor([1.0, 0.0, 0.0]), 1.0, 0.1)
    assert float((se3.to_planar(track.world_T_object[-1]) - mug).abs().max()) < 1e-4


def test_reset_leaves_nothing_to_settle():
    world = World(SHAPE, GripperShape(), HEIGHT, 0.004)
    gripper = torch.tensor((0.15, 0.0, 0.0))
    world.reset(gripper, torch.tensor((0.4, 0.0, 0.3)))
    start = world.world_T_object()
    for _ in range(3):
        world.move(gripper[None], 1.0, 0.1)
        shift, turn = se3.distance(world.world_T_object(), start)
        # far below what the filter takes for a move, 0.1 mm and 1 mrad
        assert float(shift) < 1e-6
        assert float(turn) < 1e-5


def test_an_object_that_turns_over_is_refused(monkeypatch):
    """Also where its axis has become longer than 1 by rounding."""
    world = World(SHAPE, GripperShape(), HEIGHT, 0.004)
    ways = iter((1.0, -1.0 - 1e-12))
    monkeypatch.setattr(world, "world_T_object", lambda: next(ways) * se3.identity().double())
    with pytest.raises(UsageError, match="tipped by 180 degrees"):
        world.reset(torch.tensor((0.15, 0.0, 0.0)), torch.tensor((0.4, 0.0, 0.3)))


def test_instants_follow_the_commands():
    """Without contact the gripper is at each target at the end of its mini step, up to the servo's lag."""
    world = World(SHAPE, GripperShape(), HEIGHT, 0.004)
    start = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    world.reset(start, torch.tensor([0.7, 0.3, 0.0]))
    targets = start + torch.arange(1, 21)[:, None] / 20 * torch.tensor([0.08, -0.04, 0.5], dtype=torch.float64)
    track = world.move(targets, 1.0, 0.1)
    lag = (track.configuration - targets).abs()
    assert float(lag[:, :2].max()) < 0.002 and float(lag[:, 2].max()) < 0.02
    assert float(lag[-1].max()) < 1e-4
    assert world.data.time == pytest.approx(1.1)


def test_pressing_against_something_stuck_does_not_explode():
    """A mug too heavy to move: the drive's force limit holds, and nothing flies off."""
    world = World(SHAPE, GripperShape(), HEIGHT, 0.004, PhysicsSettings(mass_kg=500.0, max_force_n=50.0))
    start = torch.tensor([0.30, 0.0, 0.0], dtype=torch.float64)
    world.reset(start, torch.tensor([0.40, 0.0, 0.0]))
    targets = start + torch.arange(1, 21)[:, None] / 20 * torch.tensor([0.08, 0.0, 0.0], dtype=torch.float64)
    track = world.move(targets, 1.0, 0.1)
    assert bool(torch.isfinite(track.world_T_object).all())
    assert float(track.configuration[-1, 0]) < 0.36  # stopped by the mug
    assert float((track.world_T_object[-1, :2, 3] - torch.tensor([0.40, 0.0]).double()).norm()) < 0.005


def test_rays_agree_with_the_exact_shape():
    """What rays hit lies on the closed-form mug, whose collision shape is made of boxes and capsules."""
    world = World(SHAPE, GripperShape(), HEIGHT, 0.004)
    pose = torch.tensor([0.4, 0.1, -0.8], dtype=torch.float64)
    world.reset(torch.tensor([0.0, -0.3, 0.0]), pose)
    origin = torch.tensor([0.9, 0.4, 0.25], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    aim = torch.tensor([0.4, 0.1, 0.05]) + 0.08 * torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    distance, is_object = world.cast(origin, aim - origin)
    hits = origin + distance[is_object][:, None] * (aim - origin)[is_object]
    assert len(hits) > 600
    local = se3.apply(se3.inverse(world.world_T_object()), hits)
    assert float(SHAPE.distance(local).abs().max()) < 0.0008
    assert float(SHAPE.members[1].distance(local).min()) < 0.0008  # the handle is among them
    floor = ~is_object & torch.isfinite(distance)
    below = origin[2] + distance[floor] * (aim - origin)[floor, 2]
    assert float(below.abs().max()) < 0.07  # the floor, or the gripper


def test_rays_into_the_sky_miss():
    world = World(SHAPE, GripperShape(), HEIGHT, 0.004)
    world.reset(torch.tensor([0.0, 0.0, 0.0]), torch.tensor([0.4, 0.0, 0.0]))
    distance, is_object = world.cast(torch.tensor([0.0, 0.0, 1.0]), torch.tensor([[0.0, 0.0, 1.0], [0.4, 0.0, -0.98]]))
    assert math.isinf(float(distance[0])) and not bool(is_object[0])
    assert bool(is_object[1])


def test_mass_and_floor_contact():
    physics = PhysicsSettings(mass_kg=0.7)
    world = World(SHAPE, GripperShape(), HEIGHT, 0.004, physics)
    body = world.model.body("object").id
    assert float(world.model.body_mass[body]) == pytest.approx(0.7)
    parts = pieces(SHAPE, physics)
    assert [part.floor for part in parts].count(True) == 1
    assert len(parts) == 1 + physics.wall_boxes + physics.handle_capsules
    world.reset(torch.tensor([0.0, 0.0, 0.0]), torch.tensor([0.4, 0.0, 0.0]))
    world.move(torch.zeros(20, 3), 1.0, 0.1)
    touching = {int(g) for pair in np.asarray(world.data.contact.geom) for g in pair}
    assert len(touching) == 2  # the floor and the base


def test_rotation_matrices_are_those_of_mujoco():
    world, track, _, _ = push("turning", 0.004)
    world._mujoco.mj_kinematics(world.model, world.data)
    expected = torch.from_numpy(np.array(world.data.body("object").xmat).reshape(3, 3))
    torch.testing.assert_close(track.world_T_object[-1, :3, :3], expected, atol=1e-9, rtol=0)
