"""What a run of the handle task is made of."""

from collections.abc import Sequence
from pathlib import Path

from rumi.agent import Parts
from rumi.robot.tool import Tool
from rumi.sim.bodies import body_of
from rumi.sim.fault import Fault
from rumi.tasks.grasp_table import GraspTable
from rumi.tasks.handle.agent import HandleAgent, build_agent
from rumi.tasks.handle.grasp import handle_table
from rumi.tasks.handle.gripper import HandleGripper
from rumi.tasks.handle.settings import HandleSettings, task_of
from rumi.tasks.handle.simulated import HandleTask
from rumi.tasks.rummage.scenes import make_tool


def build_handle(
    settings: HandleSettings,
    *,
    cache_dir: Path | None = None,
    tool: Tool | None = None,
    table: GraspTable | None = None,
    faults: Sequence[Fault] = (),
) -> Parts[HandleTask, HandleAgent]:
    """Make the parts of a run.

    Args:
        settings: of the run.
        cache_dir: folder that keeps the arm's reach and the table of grasps; None works them out each time (a minute).
        tool: made before by `make_tool`; None makes one.
        table: made before by `handle_table`; None makes one.
        faults: what goes wrong.
    """
    spec = task_of(settings)
    tool, model = tool or make_tool(spec, cache_dir=cache_dir), spec.object_factory()
    task = HandleTask(settings, tool, model, cache_dir=cache_dir, faults=faults)
    if table is None:
        believed = task.gripper
        if task.model is not model:  # the agent knows the mug that it looks for, whatever a fault puts there
            body = body_of(model.exact, spec.physics, table=model.sdf, cache_dir=cache_dir)
            believed = HandleGripper(model.exact, body, spec.physics)
        table = handle_table(believed, cache_dir=cache_dir)
    return Parts(task, build_agent(settings, tool=tool, model=model, table=table))
