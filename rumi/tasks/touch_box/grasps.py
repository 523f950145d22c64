"""The chance that a grasp succeeds, simulated once over a grid of misplacements of the box."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.seeding import split
from rumi.tasks.grasp_table import GraspTable, simulated_table
from rumi.tasks.touch_box.gripper_robot import LIFTED_M, GripperRobot
from rumi.tasks.touch_box.mujoco_scene import GripperPhysics, scene_xml, set_truth
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask
from sdf.cache import content_key

_ENDS, _COUNTS = (0.022, 0.09, 0.9), (12, 7, 19)
_TRUTHS = 6  # friction and mass differ from grasp to grasp, as many ways
_STEP_S = 0.002
_ROWS = 64


def grasp_table(task: TouchTask, *, cache_dir: Path | None = None) -> GraspTable:
    """Simulated success of grasps of a misplaced box, friction and mass drawn from the task's ranges.

    Args:
        task: the scene.
        cache_dir: folder that keeps the table; None simulates it each time (half a minute).
    """
    physics = GripperPhysics(time_step_s=_STEP_S)
    robot = GripperRobot(task, physics)
    ranges = (task.friction, task.floor_friction, task.mass_kg)
    key = content_key(
        repr((scene_xml(task, physics, grasping=True), _ENDS, _COUNTS, _TRUTHS, LIFTED_M, ranges)),
        robot.grasp_controls(torch.zeros(3)).tobytes(),
    )
    path = None if cache_dir is None else cache_dir / f"grasps-{key}.npz"
    like = GraspTable(torch.zeros(_COUNTS), _ENDS)
    return simulated_table(like, lambda boxes: lifted(robot, boxes, truths(task, _TRUTHS)), path)


def truths(task: TouchTask, count: int) -> list[BoxTruth]:
    """Boxes at the origin, with friction and mass spread over the task's ranges."""
    generator = split(0, "grasps")
    shares = torch.rand(count, 3, generator=generator, dtype=torch.float64).tolist()
    ranges = (task.friction, task.floor_friction, task.mass_kg)
    drawn = [[low + s * (high - low) for s, (low, high) in zip(row, ranges, strict=True)] for row in shares]
    return [BoxTruth(torch.zeros(3, dtype=torch.float64), *row) for row in drawn]


def lifted(robot: GripperRobot, boxes: Float[Tensor, "B 3"], which: list[BoxTruth]) -> Tensor:
    """Whether boxes at poses are lifted by a grasp that takes them to stand at the origin.

    Args:
        robot: that grasps.
        boxes: (x, y, yaw), metres and radians.
        which: mass and friction, that the boxes have in turn.
    """
    from mujoco import rollout

    mujoco, kind = robot._mujoco, robot._mujoco.mjtState.mjSTATE_FULLPHYSICS
    size = int(mujoco.mj_stateSize(robot.grasping, kind))
    states, before = np.empty((len(boxes), size)), np.empty(len(boxes))
    robot.reset(which[0], 0)
    for row, box in enumerate(boxes):
        robot.put_box(box)
        robot.above(torch.zeros(3, dtype=torch.float64))
        mujoco.mj_getState(robot.grasping, robot.data, states[row], kind)
        before[row] = robot.data.qpos[robot.box_height]
    controls = robot.grasp_controls(torch.tensor([0.0, 0.0, 0.5 * np.pi], dtype=torch.float64))
    rose = np.empty(len(boxes))
    for index, truth in enumerate(which):
        model = mujoco.MjModel.from_xml_string(scene_xml(robot.task, robot.physics, grasping=True))
        set_truth(mujoco, model, robot.task, truth)
        rows = np.arange(index, len(boxes), len(which))
        data = [mujoco.MjData(model)]
        with rollout.Rollout(nthread=0) as engine:
            for first in range(0, len(rows), _ROWS):
                part = rows[first : first + _ROWS]
                found, _ = engine.rollout(model, data, states[part], controls[None])
                rose[part] = found[:, -1, 1 + robot.box_height] - before[part]
    return torch.from_numpy(rose > LIFTED_M)
