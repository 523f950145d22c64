"""Puts a run of touch alone together: robot, table of grasps, push model, by name."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, cast, get_args

from rumi.agent import Parts
from rumi.dynamics.along_path import PathPush
from rumi.dynamics.registry import push_model
from rumi.errors import UsageError
from rumi.sim.fault import Fault
from rumi.tasks.grasp_table import GraspTable
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.faulty import FaultyRobot
from rumi.tasks.touch_box.mujoco_scene import path_scene
from rumi.tasks.touch_box.robot import SimulatedBox, TouchBox, TouchRobot
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings

Robot = Literal["gripper", "arm", "planar"]
ROBOTS: tuple[str, ...] = get_args(Robot)


def build_touch_box(
    task: TouchTask,
    settings: TouchSettings,
    robot: Robot = "gripper",
    *,
    cache_dir: Path | None = None,
    faults: Sequence[Fault] = (),
) -> Parts[TouchBox, Toucher]:
    """All that a run needs; needs MuJoCo.

    Args:
        task: the scene.
        settings: of the run.
        robot: "gripper" flies freely and feels at stated rates; "arm" feels by its joints' torques; "planar" is no
            simulation but the quasi-static model itself.
        cache_dir: folder that keeps the grasps' success; None simulates it each time (a minute).
        faults: what goes wrong.

    Raises:
        UsageError: an unknown robot, or one that is not there; rates of readings for one that has its own.
    """
    from rumi.tasks.touch_box.grasps import grasp_table

    check_robot(task, robot)
    table = grasp_table(task, cache_dir=cache_dir)
    made = make_robot(task, robot, table)
    if faults:
        if not isinstance(made, SimulatedBox):
            raise UsageError(
                f"Expected --robot gripper or planar with --fault, got {robot}: nothing goes wrong with it"
            )
        made = cast(TouchRobot, FaultyRobot(made, faults))
    agent = Toucher(task, settings, made, table, make_path_push(settings.push_model, task))
    return Parts(TouchBox(task, made), agent)


def check_robot(task: TouchTask, robot: Robot) -> None:
    """Refuse a task that has what a robot would leave aside: rates of readings, for the arm."""
    usual = TouchTask()
    if robot == "arm" and (task.rates, task.correlation) != (usual.rates, usual.correlation):
        raise UsageError(
            "The arm feels by its own torques, whose rates are its own: leave out task.rates and task.correlation, or "
            "choose --robot gripper or planar"
        )


def make_robot(task: TouchTask, robot: Robot, table: GraspTable) -> TouchRobot:
    """The robot of a name; see `build_touch_box`."""
    check_robot(task, robot)
    if robot == "planar":
        from rumi.tasks.touch_box.planar_robot import PlanarRobot

        return PlanarRobot(task, table)
    if robot == "gripper":
        from rumi.tasks.touch_box.gripper_robot import GripperRobot

        return GripperRobot(task)
    if robot == "arm":
        from rumi.tasks.touch_box.arm_robot import ArmRobot

        return ArmRobot(task)
    raise UsageError(f"Expected a robot out of {', '.join(ROBOTS)}, got {robot!r}")


def make_path_push(name: str, task: TouchTask) -> PathPush:
    """How a tool moves boxes, by a push model's name.

    Raises:
        UsageError: there is no such push model, or it does not push along paths.
    """
    return push_model(name, "path").path(lambda: path_scene(task))
