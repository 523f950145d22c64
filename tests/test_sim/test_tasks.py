"""The tasks by name, and that they are as hard as they say: decided by geometry, not by any method."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rumi.errors import UsageError
from rumi.robot.arm import ArmGeometry
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.build import make_task
from rumi.tasks.rummage.scenes import SCENES, find_task, make_tool
from sdf import se3
from sensors.semantics import Semantics

pytestmark = pytest.mark.sim

MUGS = ("mug-0", "mug-1", "mug-2")


def surface_in_object(task, result):
    """Surface points of a reading in the object's frame, each by the object's pose at its own instant."""
    reading = result.reading
    chosen = reading.observation.of_class(Semantics.SURFACE)
    points, instant = reading.observation.points[chosen], reading.instant[chosen]
    motion = reading.object_motion
    poses = motion @ se3.inverse(motion[-1]) @ result.truth
    return se3.apply(se3.inverse(poses)[instant], points[:, None])[:, 0]


def on_handle(task, points):
    cup, handle = task.model.exact.members
    return (handle.distance(points) < 0.003) & (handle.distance(points) < cup.distance(points))


def task_named(name, arm_tool, mug, **changes):
    return make_task(replace(SCENES[name], **changes), tool=arm_tool, model=mug)


# motions that bring each mug round until the pads feel its handle (from runs of seeds 1000 and 1001, the last two
# changed a little)
BRINGING_ROUND = {
    "mug-0": [
        (0.43, 0.57, 1), (0.69, 0.18, 1), (1, -0.16, 1), (1, 0.75, -0.86), (0.76, 0.48, -1), (0.76, 0.23, -0.9),
        (0.85, -0.41, 0.14), (0.41, -0.81, -1), (-0.98, 1, 1), (1, 1, -1), (1, -0.22, -1), (0.45, -1, -1),
        (0.08, -1, -0.75), (-1, -1, -0.68), (-0.94, 0.27, -0.91), (0.09, 1, -0.03), (1, 1, 0.92), (1, 0.01, 1),
        (0.95, -0.64, 0.21), (0.4, -1, -0.57),
    ],
    "mug-1": [
        (0.97, -1, 0.53), (1, -0.59, 0.3), (0.97, -0.21, -0.43), (0.94, 1, -0.07), (1, 1, -0.12), (0.86, 1, 0.06),
        (-0.3, 0.57, 0.79), (-0.85, 1, 0.87), (-0.18, -0.28, 0.74), (1, -1, -0.52), (1, 0.43, -1), (0.84, 1, -0.34),
        (-0.97, 0.73, 0.26), (1, -1, -0.99), (0.28, 0.92, 0.77),
    ],
    "mug-2": [
        (-0.97, -0.72, -0.97), (0.26, 0.28, -0.46), (0.91, 0.85, -0.39), (1, 0.71, 1), (0.95, -0.38, 0.13),
        (1, -0.97, -0.06), (1, 0.92, 0.99), (1, 0.05, 0.22), (0.98, -0.93, -0.8), (0.1, -0.97, -1),
        (-0.88, -0.88, -0.26), (-1, -0.89, 0.56), (0.28, 1, 1), (0.84, 1, -0.39), (0.93, -0.17, -1),
        (0.78, -0.5, -0.44), (-0.17, -0.96, -0.89), (-0.85, -0.96, 0.45), (0.4, -0.75, -1),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", MUGS)
def test_handle_is_hidden_at_first(name, arm_tool, mug):
    task = task_named(name, arm_tool, mug)
    points = surface_in_object(task, task.reset(0))
    assert len(points) > 800
    assert float(mug.exact.members[0].distance(points).abs().max()) < 0.001  # the cup's, every one
    assert not bool(on_handle(task, points).any())
    # turned to the camera it would be seen
    x, y, yaw = SCENES[name].start
    turned = task_named(name, arm_tool, mug, start=(x, y, yaw + math.pi))
    assert int(on_handle(turned, surface_in_object(turned, turned.reset(0))).sum()) > 50


@pytest.mark.parametrize("name", MUGS)
def test_start_is_at_the_edge_of_reach(name, arm_tool):
    """A tool pointing away from the base gets a little beyond the mug's axis, one turned aside by 60 degrees does
    not get there."""
    spec = SCENES[name]
    x, y, _ = spec.start
    base = torch.tensor(spec.base)
    offset = torch.tensor([x, y]) - base[:2]
    direction = math.atan2(float(offset[1]), float(offset[0]))
    beyond = torch.arange(-0.3, 0.3, 0.001)
    places = base[:2] + offset * (1 + beyond / offset.norm())[:, None]

    def limit(yaw):
        q = torch.cat((places, torch.full((len(places), 1), direction + yaw)), -1)
        return float(beyond[arm_tool.reach.reachable(q)].max())

    assert -0.01 < limit(0.0) < 0.04
    assert limit(math.radians(60)) < 0 and limit(math.radians(-60)) < 0
    assert bool(arm_tool.reach.reachable(torch.tensor(spec.tool_start)))


@pytest.mark.parametrize("name", MUGS)
def test_pushing_straight_on_loses_the_mug(name, arm_tool, mug):
    """Afterwards no point of the handle is within what the pads' tips reach at any yaw."""
    task = task_named(name, arm_tool, mug)
    result = task.reset(0)
    x, y, _ = task.spec.start
    heading = math.atan2(y - task.spec.tool_start[1], x - task.spec.tool_start[0])
    for _ in range(9):
        turn = (heading - float(result.reading.configuration[2])) / task.settings.action_scale_rad
        result = task.step(torch.tensor([math.cos(heading), math.sin(heading), max(-1.0, min(1.0, turn))]))
    base = torch.tensor(task.spec.base)[:2]
    radius = torch.arange(0.6, 1.3, 0.001)
    straight = torch.stack((base[0] + radius, torch.zeros_like(radius), torch.zeros_like(radius)), -1)
    farthest = float(radius[arm_tool.reach.reachable(straight)].max()) + arm_tool.shape.pad_m[0]
    handle = mug.surface_points[mug.exact.members[1].distance(mug.surface_points).abs() < 1e-4]
    assert len(handle) > 30
    assert float((se3.apply(result.truth, handle)[:, :2] - base).norm(dim=-1).min()) > farthest


@pytest.mark.parametrize("name", MUGS)
def test_handle_can_be_reached(name, arm_tool, mug):
    """Hard is not impossible: some way of pushing brings the handle to the pads."""
    task = task_named(name, arm_tool, mug)
    task.reset(0)
    felt = [
        int(on_handle(task, surface_in_object(task, task.step(torch.tensor(control, dtype=torch.float32)))).sum())
        for control in BRINGING_ROUND[name]
    ]
    assert felt[-1] > 0
    assert felt[0] == 0


def test_starts_differ():
    kinds = {name.rpartition("-")[0] for name in SCENES}
    assert {"mug", "drill", "box"} <= kinds
    for kind in kinds:
        starts = torch.tensor([spec.start for name, spec in SCENES.items() if name.rpartition("-")[0] == kind])
        assert len(starts) == 1 or float(torch.pdist(starts).min()) > 0.1


def test_unknown_task_names_the_valid_ones():
    with pytest.raises(UsageError, match="mug-0, mug-1, mug-2"):
        find_task("mug-9")
    with pytest.raises(ValueError, match="no task 'cup'"):
        make_task("cup")


def test_tool_of_a_task(tmp_path):
    free = make_tool(SCENES["mug-0"], SimSettings(action_scale_m=0.05, action_scale_rad=0.4), free_flying=True)
    assert free.reach is None
    assert free.scale.tolist() == pytest.approx([0.05, 0.05, 0.4])
    assert free.height_m == SCENES["mug-0"].height_m


def test_reach_is_kept_on_disk(cache, arm_tool, monkeypatch):
    from rumi.robot import reach_table

    monkeypatch.setattr(reach_table, "solve_table", lambda settings: pytest.fail("solved again"))
    again = make_tool(SCENES["mug-1"], cache_dir=cache)
    assert torch.equal(again.reach.position, arm_tool.reach.position)


def test_tasks_load_no_simulator():
    code = "import sys, rumi.tasks.rummage.scenes\n"
    code += "print([m for m in ('mujoco', 'pytorch_kinematics') if m in sys.modules])"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]
        ).stdout
        == "[]\n"
    )


def test_arm_is_the_stated_one():
    """The base stands 0.45 m behind the workspace; the arm's links are an iiwa's."""
    assert all(spec.base == (-0.45, 0.0, 0.0) for name, spec in SCENES.items() if not name.startswith("shelf"))
    geometry = ArmGeometry()
    assert sum(geometry.offsets_m[2:4]) == pytest.approx(0.42) and sum(geometry.offsets_m[4:6]) == pytest.approx(0.40)
