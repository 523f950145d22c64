"""What wrist and joints feel of a push, against what the simulator knows."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from rumi.robot.gripper import gripper_links
from rumi.sim.faults import parse_fault
from rumi.sim.force_sensing_world import ForceSensingWorld
from rumi.sim.joint_torques import JointFeeler, JointSettings, LevelKinematics
from rumi.sim.world import World
from rumi.sim.wrist_force import wrist_force
from rumi.tasks.handle.settings import HandleSettings, task_of
from rumi.tasks.handle.simulated import HandleTask, _soon
from sdf import se3
from sensors.force.force_torque import WrenchStatus
from sensors.semantics import Semantics

pytestmark = pytest.mark.sim

SPEC = task_of(HandleSettings())
AHEAD = torch.tensor([1.0, 0.0, 0.0])
EXACT = JointSettings().without_errors()


def world_before(body, tool, kind=ForceSensingWorld, start=(0.42, 0.02, 0.0)):
    world = kind(body, tool.shape, SPEC.height_m, 0.004, SPEC.physics)
    world.reset(torch.tensor(start), torch.tensor([0.50, 0.0, 0.2]))
    return world


def push(world, ahead_m=0.08):
    start = world.configuration()
    share = (torch.arange(20) + 1.0)[:, None] / 20
    return start, world.move(start + share * torch.tensor([ahead_m, 0.0, 0.0]), 1.0, 0.1)


def test_motions_are_those_of_the_plain_world_to_the_bit(body, tool):
    tracks = [push(world_before(body, tool, kind))[1] for kind in (World, ForceSensingWorld)]
    assert torch.equal(tracks[0].configuration, tracks[1].configuration)
    assert torch.equal(tracks[0].world_T_object, tracks[1].world_T_object)


def test_the_wrench_is_that_of_the_contacts(body, tool):
    """It balances friction on the floor while the mug is pushed steadily, and its line goes through what is touched."""
    world = world_before(body, tool, start=(0.40, 0.045, 0.0))
    push(world, 0.06)
    felt = world.trace
    touching = np.abs(felt.wrench).sum(-1) > 0
    assert 30 < touching.sum() < len(touching)
    steady = felt.wrench[100:220][touching[100:220]]
    friction = SPEC.physics.friction * SPEC.physics.mass_kg * 9.81
    # the gripper's own friction carries a part of the weight
    assert -2.5 * friction < steady[:, 0].mean() < -0.5 * friction
    force, moment = steady[:, :3].mean(0), steady[:, 3:].mean(0)
    assert abs(force @ moment) / np.linalg.norm(force) < 0.02 * np.linalg.norm(force)


@pytest.fixture(scope="module")
def pushed(mug, tool):
    """Two pushes by seeds, as all sensors report them."""
    task = HandleTask(HandleSettings(), tool, mug)
    found = []
    for seed in (1000, 1002):
        task.reset(seed)
        x, y, _ = task.spec.start
        task.world.reset(torch.tensor([x - 0.09, y + 0.01, 0.0]), torch.tensor(task.spec.start))
        task._from = task.world.configuration()
        found.append((task.step(AHEAD), task.world.trace, task.wrist_contacts(task.world.trace)))
    return found


def test_a_hand_that_is_dead_and_off_reports_no_force_and_another_place(mug, tool, pushed):
    faults = [parse_fault(text, steps=5, seed=2) for text in ("dead@1", "hand:6@1")]
    task = HandleTask(HandleSettings(), tool, mug, faults=faults)
    task.reset(1000)
    assert isinstance(task.world, ForceSensingWorld)
    x, y, _ = task.spec.start
    task.world.reset(torch.tensor([x - 0.09, y + 0.01, 0.0]), torch.tensor(task.spec.start))
    reading, usual = task.step(AHEAD).reading, pushed[0][0].reading
    assert len(usual.wrench.points) and bool(usual.signals.any())
    assert not len(reading.wrench.points) and not bool(reading.signals.any()) and not bool(reading.in_contact.any())
    apart = (reading.tool_pose - usual.tool_pose)[:, :3, 3].norm(dim=-1)
    torch.testing.assert_close(apart, torch.full_like(apart, 0.006), atol=1e-5, rtol=0)


def test_touches_by_the_wrench_lie_on_the_mug(pushed, mug):
    distances, deviations = [], []
    for result, _, _ in pushed:
        reading = result.reading
        touch, motion = reading.wrench, reading.object_motion
        carried = motion[-1] @ se3.inverse(motion[touch.instant])
        points = se3.apply(se3.inverse(result.truth) @ carried, touch.points[:, None])[:, 0]
        distances += mug.exact.distance(points).abs().tolist()
        deviations += touch.point_sd.tolist()
    assert len(distances) >= 3
    assert max(distances) < 0.008 and np.median(distances) < 0.003
    assert 0.0001 < np.median(deviations) < 0.006


def test_free_points_are_hardly_in_the_mug(pushed, mug):
    """By the measured motion's error, and by what a touch that no sensor feels yet presses."""
    for result, _, _ in pushed:
        reading, motion = result.reading, result.reading.object_motion
        free = reading.observation.of_class(Semantics.FREE)
        carried = motion[-1] @ se3.inverse(motion[reading.instant[free]])
        points = se3.apply(se3.inverse(result.truth) @ carried, reading.observation.points[free][:, None])[:, 0]
        assert len(points) > 100 and float(mug.exact.distance(points).min()) > -0.003


def test_sensors_agree_on_when_something_was_touched(pushed):
    """All of them a mini step late, and some readings of the joints lost."""
    for result, felt, (contact, _) in pushed:
        ends = [0, *(felt.ends + 1)]
        now = np.array([np.linalg.norm(felt.wrench[a:b, :3].mean(0)) for a, b in pairwise(ends)])
        force = np.concatenate((now[:1], now[:-1]))
        told = contact.status.numpy() != int(WrenchStatus.NONE)
        assert (told[force > 1.3]).all() and not told[force < 0.7].any()
        # one of a touch's beginning may be missed
        lasting, none = (force > 1.0) & (np.roll(force, 1) > 1.0), (force == 0) & (np.roll(force, 1) == 0)
        signals = result.reading.signals.numpy()
        assert lasting.sum() > 4 and signals[lasting].mean() > 0.6 and not signals[none].any()


def test_readings_of_wrist_and_joints_are_lost_late_and_off(mug, tool):
    """As images are; and silence just before a contact frees nothing, since the contact may have been there already."""
    settings = HandleSettings(sensors=("wrench", "torques"))
    noisy, clean = (HandleTask(replace(settings, noise_free=free), tool, mug) for free in (False, True))
    off = []
    for seed in range(1000, 1004):
        noisy.reset(seed)
        off.append(noisy._wrist_off)
    shifts = torch.stack([each[:3, 3].norm() for each in off])
    turns = torch.stack([se3.distance(each, se3.identity().double())[1] for each in off])
    torch.testing.assert_close(shifts, torch.full_like(shifts, 0.002), atol=1e-6, rtol=0)
    torch.testing.assert_close(turns, torch.full_like(turns, math.radians(1.0)), atol=1e-6, rtol=0)
    kept = torch.stack([noisy._arrived(20, torch.Generator().manual_seed(seed)) for seed in range(200)]).float()
    assert float(kept.mean()) == pytest.approx(0.9, abs=0.01)
    rows = torch.arange(5)
    assert noisy._delayed(rows).tolist() == [0, 0, 1, 2, 3] and clean._delayed(rows).tolist() == rows.tolist()
    touched = torch.tensor([0, 0, 0, 1, 0, 0, 0, 0, 0, 0]).bool()
    assert _soon(touched).int().tolist() == [0, 1, 1, 1, 0, 0, 0, 0, 1, 1], "nobody knows what comes after the end"
    clean.reset(1000)
    assert torch.equal(clean._wrist_off, se3.identity().double()) and bool(clean._arrived(20, torch.Generator()).all())


def test_the_residual_is_the_contact_seen_through_the_filter(body, tool):
    """With exact sensors and an exact model, in the middle of a long steady force."""
    world = world_before(body, tool)
    start, _ = push(world)
    feeler = JointFeeler(SPEC.base, SPEC.height_m, EXACT)
    force = np.array([-3.0, 1.0, 0.5, 0.02, -0.1, 0.05])
    felt = world.trace._replace(wrench=np.tile(force, (len(world.trace.stamp), 1)))
    residual = feeler.residual(felt, start).numpy()
    kinematics, joints = feeler.kinematics, feeler._joints
    expected = kinematics.jacobian(joints).T @ force
    assert np.abs(residual[-1] - expected).max() < 0.02
    # one time constant after its begin a step shows by 63 %
    first = kinematics.jacobian(kinematics.track(np.array([[*start[:2], SPEC.height_m, start[2]]]))[0][0]).T @ force
    share = residual[round(1.0 / 25.0 / 0.004) - 1, 0] / first[0]
    assert share == pytest.approx(1.0 - math.exp(-1.0), abs=0.06)


def test_without_contact_an_exact_observer_feels_nothing(body, tool):
    world = world_before(body, tool, start=(0.25, 0.0, 0.0))
    start, _ = push(world, 0.06)
    residual = JointFeeler(SPEC.base, SPEC.height_m, EXACT).residual(world.trace, start)
    assert float(residual.abs().max()) < 0.03


def test_after_the_arm_was_lost_its_joints_tell_nothing_until_the_action_ends(body, tool, monkeypatch):
    """Found again it may be held in another way, for which no rest was taken: a false contact from there on."""
    world = world_before(body, tool, start=(0.25, 0.0, 0.0))
    start, _ = push(world, 0.06)
    feeler = JointFeeler(SPEC.base, SPEC.height_m, EXACT)
    follow = feeler.kinematics.track

    def lost_on_the_way(poses, begin=None):
        joints, errors = follow(poses, begin)
        middle = len(poses) // 2
        errors[middle] = 1.0
        joints[middle:] += 0.3  # held in another way
        return joints, errors

    monkeypatch.setattr(feeler.kinematics, "track", lost_on_the_way)
    signals, known = feeler.signals(world.trace, start)
    assert bool(known[0]) and not bool(known[-1])
    assert bool((known.int().diff() <= 0).all()), "once lost, unknown to the end"
    assert not bool(signals[~known].any())


def test_the_arm_holds_its_tool_level_where_the_gripper_is(body, tool):
    kinematics = LevelKinematics(JointFeeler(SPEC.base, SPEC.height_m, EXACT).physics)
    pose = np.array([0.35, 0.1, SPEC.height_m, 0.3])
    place, turn = kinematics.place(kinematics.track(pose[None])[0][0])
    assert np.abs(place - pose[:3]).max() < 1e-4
    expected = [[math.cos(0.3), -math.sin(0.3), 0.0], [math.sin(0.3), math.cos(0.3), 0.0], [0.0, 0.0, 1.0]]
    assert np.abs(turn - np.array(expected)).max() < 1e-3


def test_sensors_that_are_off_tell_nothing(mug, tool):
    task = HandleTask(HandleSettings(sensors=("torques",)), tool, mug)
    first = task.reset(1000)
    assert len(first.reading.observation) == 0
    task.world.reset(torch.tensor([0.38, 0.03, 0.0]), torch.tensor(task.spec.start))
    reading = task.step(AHEAD).reading
    assert not bool(reading.observation.of_class(Semantics.SURFACE).any())
    assert len(reading.wrench.points) == 0 and bool(reading.signals.any())
    seeing = HandleTask(HandleSettings(sensors=("camera",)), tool, mug)
    assert bool(seeing.reset(1000).reading.observation.of_class(Semantics.SURFACE).any())
    seeing.world.reset(torch.tensor([0.38, 0.03, 0.0]), torch.tensor(seeing.spec.start))
    blind = seeing.step(AHEAD).reading
    assert blind.signals is None and not bool(blind.in_contact.any())
    assert not bool(blind.observation.of_class(Semantics.SURFACE).any())


def depths(reading, tool, chosen):
    """Of free points in the gripper, by how far they are inside of it where it was then."""
    index = (reading.observation.of_class(Semantics.FREE) & chosen[reading.instant]).nonzero()[:, 0]
    own = se3.inverse(reading.tool_pose)[reading.instant[index]]
    places = se3.apply(own, reading.observation.points[index][:, None])[:, 0]
    return -torch.stack([link.distance(places) for link in gripper_links(tool.shape)]).amin(0)


def test_a_silent_sensor_frees_the_grippers_skin_and_a_touched_one_does_not(mug, tool):
    task = HandleTask(HandleSettings(sensors=("wrench",)), tool, mug)
    task.reset(1000)
    x, y, _ = task.spec.start
    task.world.reset(torch.tensor([x - 0.20, y, 0.0]), torch.tensor(task.spec.start))
    silent = task.step(AHEAD).reading
    assert not bool(silent.in_contact.any())
    assert float(depths(silent, tool, ~silent.in_contact).min()) < 0.001
    touched = task.step(AHEAD).reading
    assert int(touched.in_contact.sum()) > 4
    assert float(depths(touched, tool, touched.in_contact).min()) > 0.0029


def test_a_seed_gives_the_same_mug_to_all_sensors_and_its_handle_is_hidden(mug, tool):
    tasks = [HandleTask(HandleSettings(sensors=sensors), tool, mug) for sensors in (("camera",), ("wrench",))]
    for seed in (1000, 1001):
        x, y, yaw = tasks[0].drawn(seed)
        assert tasks[1].drawn(seed) == (x, y, yaw)
        camera = SPEC.camera.position
        away = math.atan2(y - camera[1], x - camera[0])
        assert abs(yaw - away) <= math.radians(20.0)
        assert math.hypot(x - 0.5, y) <= 0.06


def test_sensors_without_noise_tell_the_truth(mug, tool):
    settings = HandleSettings(noise_free=True)
    task = HandleTask(settings, tool, mug)
    first = task.reset(1000)
    seen = first.reading.observation.points[first.reading.observation.of_class(Semantics.SURFACE)]
    assert float(mug.exact.distance(se3.apply(se3.inverse(first.truth), seen)).abs().max()) < 0.001
    task.world.reset(torch.tensor([0.38, 0.03, 0.0]), torch.tensor(task.spec.start))
    before = task.world.world_T_object()
    pushed = task.step(AHEAD)
    moved = (pushed.truth.double() @ se3.inverse(before.double())).float()
    torch.testing.assert_close(pushed.reading.object_motion[-1], moved, atol=1e-5, rtol=0)
    contact, _ = task.wrist_contacts(task.world.trace)
    again, _ = task.wrist_contacts(task.world.trace)
    assert torch.equal(contact.point_s, again.point_s), "no noise is drawn"


def test_a_wrist_reports_the_mean_force_of_each_mini_step(body, tool):
    """Of equal steps of the physics the means add up to the whole; noise has the deviation that is asked for."""
    world = world_before(body, tool)
    push(world)
    whole = world.trace.wrench[:, :3]
    counts = np.diff(np.concatenate(([-1], world.trace.ends)))
    random = torch.Generator().manual_seed(0)
    exact = wrist_force(world.trace, 0.0, random)
    assert exact.shape == (20, 3) and counts.sum() == len(whole)
    np.testing.assert_allclose(counts @ exact.double().numpy(), whole.sum(0), rtol=1e-4, atol=1e-3)
    off = torch.stack([wrist_force(world.trace, 0.5, random) - exact for _ in range(200)])
    assert abs(float(off.std()) - 0.5) < 0.01 and float(off.mean().abs()) < 0.02
