"""Guarded moves: they end a little after what they meet, by what the robot feels, whoever carries the tool."""

from dataclasses import replace

import pytest
import torch

from rumi.robot.gripper import GripperShape
from rumi.sim.arm_world import ArmWorld
from rumi.sim.error_settings import PadErrors
from rumi.sim.faults import parse_fault
from rumi.sim.force_sensing_world import ForceSensingWorld
from rumi.sim.guarded_move import GuardedMove
from rumi.sim.robot_arm import RobotArm
from rumi.sim.settings import SimSettings
from rumi.sim.world import Guard, World
from rumi.tasks.rummage.build import make_task
from rumi.tasks.rummage.scenes import SCENES, make_tool
from sdf import se3
from sdf.primitives import Box

pytestmark = pytest.mark.sim

AHEAD = torch.tensor([1.0, 0.0, 0.0])
SPEC = replace(SCENES["mug-0"], start=(0.40, 0.0, 0.3))
MINI_M = 0.08 / SimSettings().mini_steps
SHAPE, GRIPPER, STEP_S = Box((0.06, 0.06, 0.10)), GripperShape(), 0.004


def run(arm_tool, mug, count, faults=(), spec=SPEC, **settings):
    task = make_task(spec, replace(SimSettings(), **settings), tool=arm_tool, model=mug, faults=faults)
    first = task.reset(0)
    return task, first, [task.step(AHEAD) for _ in range(count)]


def moved(before, after):
    return float((after.truth[:3, 3] - before.truth[:3, 3]).norm())


def first_touch(results):
    return next(k for k, result in enumerate(results) if bool(result.reading.in_contact.any()))


def test_an_action_ends_soon_after_its_contact(arm_tool, mug):
    _, first, free = run(arm_tool, mug, 4)
    at = first_touch(free)
    for guard_m in (0.0, 0.01):
        _, start, guarded = run(arm_tool, mug, at + 1, guarded="always", guard_m=guard_m)
        before = guarded[at - 1] if at else start
        reading = guarded[at].reading
        assert len(reading.tool_pose) == len(reading.in_contact) < 20 and bool(reading.in_contact[-1])
        # the pads feel 3 mm ahead, and the sensors report after each mini step
        assert moved(before, guarded[at]) <= guard_m + MINI_M + 1e-3
        assert moved(free[at - 1] if at else first, free[at]) > moved(before, guarded[at])


def test_it_goes_on_for_longer_where_a_camera_sees_what_it_did(arm_tool, mug):
    sees = replace(SPEC, looks_again=True)
    for spec, guard_m in ((SPEC, 0.015), (sees, 0.03)):
        auto, asked = (run(arm_tool, mug, 4, spec=spec, guarded="always", guard_m=m)[2] for m in (None, guard_m))
        assert first_touch(auto) < 4
        assert all(
            torch.equal(one.reading.tool_pose, other.reading.tool_pose) for one, other in zip(auto, asked, strict=True)
        )


def test_what_meets_nothing_is_the_same_to_the_bit(arm_tool, mug):
    _, _, free = run(arm_tool, mug, 4)
    at = first_touch(free)
    assert at > 0
    _, _, guarded = run(arm_tool, mug, at, guarded="always", guard_m=0.0)
    for mine, other in zip(guarded, free, strict=False):
        assert torch.equal(mine.reading.tool_pose, other.reading.tool_pose)
        assert torch.equal(mine.reading.observation.points, other.reading.observation.points)
        assert torch.equal(mine.truth, other.truth)


def test_it_goes_on_late_where_the_robot_stops_late(arm_tool, mug):
    ends = []
    for late_s in (0.0, 0.1):
        _, _, found = run(arm_tool, mug, 4, guarded="always", guard_m=0.0, stops_late_s=late_s)
        ends.append(found[first_touch(found)].reading.configuration[0])
    # 8 mm farther, and the sensors report after up to a mini step more
    assert 0.004 < float(ends[1] - ends[0]) < 0.008 + 2.0 * MINI_M


def test_a_hand_that_feels_nothing_is_not_stopped_and_one_that_is_stuck_hardly_moves(arm_tool, mug):
    dead = run(arm_tool, mug, 4, (parse_fault("dead@1", steps=9),), guarded="always", guard_m=0.0)[2]
    assert all(len(found.reading.tool_pose) == 20 for found in dead)
    stuck = run(arm_tool, mug, 1, (parse_fault("stuck@1", steps=9),), guarded="always", guard_m=0.0)[2]
    assert len(stuck[0].reading.tool_pose) == 1


def test_pads_that_miss_everything_do_not_stop_it(arm_tool, mug):
    blind = run(arm_tool, mug, 4, guarded="always", guard_m=0.0, pads=PadErrors(missed=0.999))[2]
    assert all(len(found.reading.tool_pose) == 20 and not found.reading.in_contact.any() for found in blind)


def test_a_tool_in_space_that_is_held_up_ends_by_the_way_it_was_to_go():
    """On top of a box it goes nowhere: 10 mm farther down it gives up, and not with the whole of the action."""
    spec = replace(SCENES["box-0"], tool_start=(0.49, 0.03, 0.12, 0.0))
    lengths = []
    for guarded in ("never", "always"):
        settings = SimSettings(guarded=guarded, guard_m=0.01)
        task = make_task(spec, settings, tool=make_tool(spec, settings, free_flying=True))
        task.reset(0)
        down = [task.step(torch.tensor([0.0, 0.0, -1.0, 0.0])).reading for _ in range(2)]
        lengths.append(len(down[1].in_contact))
        assert bool(down[1].in_contact[-1])
        assert float(down[1].tool_pose[-1, 2, 3] - down[1].tool_pose[0, 2, 3]) > -0.02
    assert lengths[0] == 20 and lengths[1] <= 5


def test_contact_that_ends_begins_the_way_anew():
    places = torch.tensor([[0.0, 0.0], [0.004, 0.0], [0.008, 0.0], [0.012, 0.0], [0.016, 0.0]])
    feels = (True, False, True, True, True)
    over = GuardedMove(0.006, lambda index: (places[index], feels[index]))
    assert [over(index) for index in range(5)] == [False, False, False, False, True]
    turned = GuardedMove(0.006, lambda index: (torch.tensor([0.0, 0.07 * index]), True))
    assert [turned(index) for index in range(2)] == [False, True]
    yaws = (3.14, -3.13, -3.05)  # past half a turn
    over = GuardedMove(0.006, lambda index: (torch.tensor([0.0, yaws[index]]), True))
    assert [over(index) for index in range(3)] == [False, False, True]


@pytest.mark.parametrize("kind", [World, ForceSensingWorld, ArmWorld])
def test_every_world_ends_where_it_is_told_and_stands_still_then(kind):
    carried = {"arm": RobotArm.standard((-0.45, 0.0, 0.0))} if kind is ArmWorld else {}
    world = kind(SHAPE, GRIPPER, 0.045, STEP_S, **carried)
    world.seed(0)
    start = torch.tensor((0.2, 0.0, 0.0))
    world.reset(start, torch.tensor((0.5, 0.3, 0.0)))
    targets = start + torch.linspace(0.05, 1.0, 20)[:, None] * torch.tensor((0.08, 0.0, 0.0))
    track = world.move(targets, 1.0, 0.1, Guard(lambda index: index == 5))
    assert len(track.configuration) == len(track.world_T_object) == 6
    assert abs(float(track.configuration[-1, 0]) - float(targets[5, 0])) < 2e-3
    assert torch.equal(track.configuration[-1], world.configuration()) and track.refused_m == 0.0
    if isinstance(world, ForceSensingWorld):
        assert world.trace is not None
        assert len(world.trace.ends) == 6 and world.trace.ends[-1] == len(world.trace.stamp) - 1
    if isinstance(world, ArmWorld):
        assert len(world.signals) == len(world.links_touch) == 6
    back = world.move(start + torch.zeros(20, 1), 1.0, 0.1)
    assert abs(float(back.configuration[-1, 0]) - 0.2) < 2e-3


def test_a_guard_that_never_stops_changes_nothing():
    ends = []
    for guard in (None, Guard(lambda index: False)):
        world = World(SHAPE, GRIPPER, 0.045, STEP_S)
        world.reset(torch.tensor((0.2, 0.0, 0.0)), torch.tensor((0.30, 0.01, 0.3)))
        targets = torch.linspace(0.205, 0.28, 20)[:, None] * torch.tensor((1.0, 0.0, 0.0))
        ends.append(world.move(targets, 1.0, 0.1, guard))
    assert torch.equal(ends[0].world_T_object, ends[1].world_T_object)
    assert float(se3.distance(ends[0].world_T_object[0], ends[0].world_T_object[-1])[0]) > 0.01
