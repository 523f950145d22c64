"""Robots of a simulated task: a gripper, one with a force sensor at its wrist, or one on an arm that feels torques."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.sim.arm_world import ArmWorld
from rumi.sim.bodies import Body
from rumi.sim.force_sensing_world import ForceSensingWorld
from rumi.sim.robot_arm import RobotArm
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.sensors import measure
from rumi.sim.settings import PhysicsSettings, SimSettings
from rumi.sim.world import Track, World
from rumi.sim.wrist_force import wrist_force
from rumi.tasks.rummage.scene_spec import TaskSpec
from sensors.reading import FORCE, TORQUE_CONTACT


def make_world(
    spec: TaskSpec,
    settings: SimSettings,
    shape: GripperShape,
    arm: RobotArm | None,
    body: Body,
    physics: PhysicsSettings,
) -> World:
    """The scene of an object with the robot of the settings; the gripper flies where no arm carries it.

    Raises:
        UsageError: a force sensor at the wrist of an arm.
    """
    height = None if spec.spatial else spec.height_m
    if arm is None:
        kind = ForceSensingWorld if settings.sensors.wrist_force else World
        return kind(body, shape, height, settings.time_step_s, physics)
    if settings.sensors.wrist_force:
        raise UsageError("Expected --robot gripper with a wrist's force sensor, which the arm does not carry")
    return ArmWorld(body, shape, height, settings.time_step_s, physics, arm=arm)


def measurements(
    world: World, sensors: SensorSettings, track: Track, world_T_tool: Float[Tensor, "K 4 4"], noise: torch.Generator
) -> dict[str, Float[Tensor, "K ..."]]:
    """What the settings' further sensors and the robot's own measured during an action, by name."""
    found = measure(sensors.further, world, track, world_T_tool, noise)
    if isinstance(world, ForceSensingWorld) and world.trace is not None:
        found[FORCE] = wrist_force(world.trace, sensors.wrist_noise_n, noise)
    if isinstance(world, ArmWorld):
        found[TORQUE_CONTACT] = world.signals.float()[:, None]
    return found
