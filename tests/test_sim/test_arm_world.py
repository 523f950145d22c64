"""The arm that carries the gripper follows, pushes as a gripper that flies does, feels by its torques, and stops."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco")
pytest.importorskip("pytorch_kinematics")

from rumi.errors import UsageError
from rumi.robot.arm import ArmGeometry
from rumi.robot.gripper import GripperShape
from rumi.robot.tool import Tool
from rumi.sim.arm_scene import ArmPhysics, links_xml
from rumi.sim.arm_world import ArmControl, ArmWorld
from rumi.sim.robot_arm import RobotArm
from rumi.sim.settings import PhysicsSettings, SimSettings
from rumi.sim.world import World
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.simulated import SimTask
from sdf import se3
from sdf.object_model import box_model
from sdf.primitives import Box
from sensors.reading import TORQUE_CONTACT

BASE, HEIGHT, STEP = (-0.45, 0.0, 0.0), 0.045, 0.004
START, FAR = torch.tensor((0.2, 0.0, 0.0)), torch.tensor((0.2, 0.6, 0.0))
SHAPE, GRIPPER = Box((0.06, 0.06, 0.10)), GripperShape()
MASSES = '<inertial><mass value="2"/><inertia ixx=".02" iyy=".02" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial>'


def arm_world(*, height_m: float | None = HEIGHT, shape: Box = SHAPE, **changes) -> ArmWorld:
    world = ArmWorld(shape, GRIPPER, height_m, STEP, **{"arm": RobotArm.standard(BASE), **changes})
    world.seed(0)
    return world


def line(start: torch.Tensor, end: torch.Tensor, count: int = 20) -> torch.Tensor:
    return start + (torch.arange(1, count + 1) / count)[:, None] * (end - start)


def weighed(urdf: str) -> str:
    """The arm of the tasks with masses and a shape a link, so that a simulator can take it."""
    shape = '<collision><origin xyz="0 0 0.05"/><geometry><sphere radius="0.03"/></geometry></collision>'
    for index in range(1, 8):
        urdf = urdf.replace(f'<link name="link_{index}"/>', f'<link name="link_{index}">{MASSES}{shape}</link>')
    return urdf


def motors(friction: str = "") -> str:
    text = links_xml(ArmPhysics(base=(0.0, 0.0, 0.0)))
    acts = "".join(f'<motor joint="joint_{k}" forcerange="-150 150" {friction}/>' for k in range(1, 8))
    return f"<mujoco><worldbody>{text}</worldbody><actuator>{acts}</actuator></mujoco>"


def test_the_tool_goes_where_it_is_sent_and_its_joints_feel_nothing_on_the_way():
    world = arm_world()
    world.reset(START, FAR)
    torch.testing.assert_close(world.configuration().float(), START, atol=2e-4, rtol=0)
    targets = line(START, torch.tensor((0.27, -0.06, 0.4)))
    track = world.move(targets, 1.0, 0.1)
    assert (track.configuration - targets).abs().max() < 2e-3
    assert (track.configuration[-1] - targets[-1]).abs().max() < 3e-4
    tilt = torch.acos(track.world_T_tool[:, 2, 2].clamp(-1.0, 1.0))
    assert (track.world_T_tool[:, 2, 3] - HEIGHT).abs().max() < 1e-3 and tilt.max() < math.radians(0.5)
    assert track.refused_m == 0.0 and not world.signals.any() and not world.links_touch.any()


def test_in_space_the_tool_rises_too():
    world = arm_world(height_m=None)
    start = torch.tensor((0.2, 0.0, 0.10, 0.0))
    world.reset(start, FAR)
    goal = torch.tensor((0.25, 0.05, 0.16, -0.3))
    track = world.move(line(start, goal), 1.0, 0.1)
    torch.testing.assert_close(track.configuration[-1].float(), goal, atol=5e-4, rtol=0)


def test_the_same_seed_gives_the_same_bytes_and_another_another_model():
    def run(seed: int) -> torch.Tensor:
        world = arm_world()
        world.seed(seed)
        world.reset(START, torch.tensor((0.30, 0.0, 0.0)))
        return world.move(line(START, torch.tensor((0.27, 0.0, 0.0))), 1.0, 0.1).world_T_object

    assert torch.equal(run(3), run(3))
    assert not torch.equal(run(3), run(4))


def test_it_pushes_as_a_gripper_that_flies():
    stands, end = torch.tensor((0.30, 0.01, 0.3)), torch.tensor((0.28, 0.0, 0.0))
    arm, flying = arm_world(), World(SHAPE, GRIPPER, HEIGHT, STEP)
    moved = []
    for world in (arm, flying):
        world.reset(START, stands)
        moved.append(se3.to_planar(world.move(line(START, end), 1.0, 0.1).world_T_object[-1]))
    assert moved[1][0] - stands[0] > 0.03
    torch.testing.assert_close(moved[0][:2], moved[1][:2], atol=2e-3, rtol=0)
    assert abs(float(moved[0][2] - moved[1][2])) < math.radians(4.0)


def test_its_torques_tell_of_a_contact():
    def told(stands: torch.Tensor) -> torch.Tensor:
        world = arm_world(physics=PhysicsSettings(mass_kg=6.0))
        world.reset(START, stands)
        world.move(line(START, torch.tensor((0.28, 0.04, 0.0))), 1.0, 0.1)
        assert not world.links_touch.any()
        return world.signals

    assert told(torch.tensor((0.32, 0.01, 0.3))).sum() >= 5
    assert not told(FAR).any()


def test_the_hand_presses_no_harder_than_it_may():
    weak = PhysicsSettings(mass_kg=30.0, friction=0.9, max_force_n=25.0, lead_m=0.006)
    world = arm_world(physics=weak)
    world.reset(START, torch.tensor((0.30, 0.0, 0.0)))
    track = world.move(line(START, torch.tensor((0.28, 0.0, 0.0))), 1.0, 0.1)
    # 30 kg on that floor give way to 265 N
    assert float(track.world_T_object[-1, 0, 3]) < 0.305
    assert float(track.configuration[-1, 0]) < 0.26


def test_a_target_out_of_reach_is_refused():
    world = arm_world()
    start = torch.tensor((0.55, 0.0, 0.0))
    world.reset(start, FAR)
    track = world.move(line(start, torch.tensor((0.75, 0.0, 0.0))), 1.0, 0.1)
    assert track.refused_m > 0.05
    reached = float(track.configuration[-1, 0])
    assert 0.55 < reached < 0.62
    assert abs(0.75 - reached - track.refused_m) < 2e-3


def test_a_start_out_of_reach_is_told():
    with pytest.raises(UsageError, match="Expected the arm to reach the tool's start"):
        arm_world().reset(torch.tensor((1.5, 0.0, 0.0)), FAR)


def test_it_stops_where_a_link_touches():
    # a tall heavy block beside the wrist, which the tool alone would pass
    world = arm_world(shape=Box((0.06, 0.06, 0.30)), physics=PhysicsSettings(mass_kg=4.0))
    world.reset(START, torch.tensor((0.02, 0.13, 0.0)))
    track = world.move(line(START, START + torch.tensor((0.0, 0.10, 0.0))), 1.0, 0.1)
    assert world.links_touch.any() and world.signals.any() and track.refused_m > 0.01


def test_what_palm_and_pads_push_does_not_stop_it():
    for y in (0.0, 0.10):  # ahead of the pads, beside the palm
        world = arm_world(shape=Box((0.06, 0.06, 0.08)), physics=PhysicsSettings(mass_kg=4.0))
        world.reset(START, torch.tensor((0.30, 0.0, 0.0)) if y == 0.0 else torch.tensor((0.13, y, 0.0)))
        way = torch.tensor((0.08, 0.0, 0.0)) if y == 0.0 else torch.tensor((0.0, 0.08, 0.0))
        track = world.move(line(START, START + way), 1.0, 0.1)
        assert world.signals.sum() > 5 and not world.links_touch.any()
        assert track.refused_m == 0.0
        torch.testing.assert_close(track.configuration[-1].float(), START + way, atol=5e-3, rtol=0)


def pressing() -> ArmWorld:
    """An arm that has pressed obliquely on what does not give way."""
    drive = {"max_force_n": 25.0, "max_lift_n": 15.0, "max_torque_nm": 4.0, "lead_m": 0.006}
    world = arm_world(height_m=None, physics=PhysicsSettings(mass_kg=300.0, friction=0.1, **drive))
    start = torch.tensor((0.30, 0.0, 0.06, 0.0))
    world.reset(start, torch.tensor((0.42, -0.06, 0.0)))
    world.pressed = world.move(line(start, torch.tensor((0.36, 0.0, 0.08, 0.3))), 1.0, 0.1)
    return world


def test_a_hand_that_is_held_stays_level_and_goes_where_it_can():
    world = pressing()
    track = world.pressed
    tilt = torch.acos(track.world_T_tool[:, 2, 2].clamp(-1.0, 1.0))
    assert world.signals[-5:].all() and float(track.configuration[-1, 0]) < 0.345
    assert tilt.max() < math.radians(1.5)
    # along z and about it, where nothing is in the way
    assert abs(float(track.configuration[-1, 2]) - 0.08) < 4e-3
    assert abs(float(track.configuration[-1, 3]) - 0.3) < 0.03


def test_it_draws_back_from_what_it_pressed_on():
    world = pressing()
    here, back = world.configuration().float(), torch.tensor((0.28, 0.0, 0.06, 0.0))
    track = world.move(line(here, back), 1.0, 0.1)
    assert track.refused_m == 0.0 and not world.signals[4:].any()
    torch.testing.assert_close(track.configuration[-1].float(), back, atol=1e-3, rtol=0)


@pytest.mark.parametrize("source", [weighed(ArmGeometry().urdf()), motors()], ids=["urdf", "mjcf"])
def test_any_arm_can_carry_the_gripper(source):
    shape = ArmGeometry()
    turn = se3.exp(torch.tensor((0.0, 0.0, 0.0, 0.0, -0.5 * math.pi - shape.tool_pitch_rad, 0.0), dtype=torch.float64))
    turn[2, 3] = shape.flange_m + shape.tool_m
    arm = RobotArm.load(source, "link_7", base=BASE, tip_T_tool=turn)
    assert arm.joints == tuple(f"joint_{k}" for k in range(1, 8))
    np.testing.assert_array_equal(arm.torques, [300.0] * 7 if "<robot" in source else [150.0] * 7)
    world = arm_world(arm=arm)
    world.reset(START, FAR)
    targets = line(START, torch.tensor((0.25, 0.05, 0.2)))
    track = world.move(targets, 1.0, 0.1)
    assert (track.configuration[-1] - targets[-1]).abs().max() < 1e-3


@pytest.mark.parametrize(
    ("source", "tip", "message"),
    [
        ("<robot", "link_7", "Expected MJCF or URDF that MuJoCo can read"),
        ("nowhere.urdf", "link_7", "Expected a file of MJCF or URDF, got nowhere.urdf"),
        (motors(), "hand", "There is no body 'hand' in the robot; its bodies are base, link_1"),
        (motors().replace("forcerange", "ctrlrange"), "link_7", "Expected a largest torque of the joint 'joint_1'"),
        (motors(), "base", "Expected joints that move between the robot's root and 'base'"),
    ],
)
def test_what_is_no_arm_is_told(source, tip, message):
    with pytest.raises(UsageError, match=message):
        RobotArm.load(source, tip)


def test_a_control_that_cannot_be_is_told():
    with pytest.raises(UsageError, match="bandwidth"):
        ArmControl(bandwidth=0.0)


@pytest.fixture
def task() -> SimTask:
    spec = replace(find_task("mug-0"), start=(0.36, 0.0, 0.0), camera=None, object_factory=box_model)
    spec = replace(spec, prior=find_task("box-0").prior, physics=PhysicsSettings(mass_kg=3.0))
    tool = Tool(torch.tensor(spec.bounds))
    return SimTask(spec, SimSettings(robot="arm"), tool, spec.object_factory())


def test_a_task_says_what_the_joints_told(task):
    task.reset(0)
    control = torch.tensor((1.0, 0.0, 0.0))
    first, second = task.step(control).reading, task.step(control).reading
    told = first.measurements[TORQUE_CONTACT]
    assert told.shape == (len(first.tool_pose), 1) and not told.any()
    assert second.in_contact.any() and second.measurements[TORQUE_CONTACT].any()
    # the tool is where the joints are, not where it was sent
    assert not torch.equal(second.tool_pose, task.tool.pose(se3.to_planar(second.tool_pose)))


def test_a_wrist_sensor_is_the_gripper_s(task):
    settings = SimSettings(robot="arm", sensors=replace(task.settings.sensors, wrist_force=True))
    with pytest.raises(UsageError, match="Expected --robot gripper with a wrist's force sensor"):
        SimTask(task.spec, settings, task.tool, task.model)
