"""What a fused run is made of."""

from dataclasses import dataclass
from pathlib import Path

from rumi.robot.tool import Tool
from rumi.tasks.handle.finder import Finder, build_finder
from rumi.tasks.handle.grasp import HandleTable, handle_table
from rumi.tasks.handle.gripper import HandleGripper
from rumi.tasks.handle.settings import FusedSettings, task_of
from rumi.tasks.handle.simulated import FusedTask
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.scenes import make_tool


@dataclass(frozen=True)
class FusedParts:
    """Everything that a run needs beside its seed; may be used for many.

    Attributes:
        task: the scene with its sensors.
        finder: how the mug is found.
        gripper: grasps it.
        table: chance that it does, by how far off the mug is.
    """

    task: FusedTask
    finder: Finder
    gripper: HandleGripper
    table: HandleTable

    @property
    def settings(self) -> FusedSettings:
        """Of the run."""
        return self.finder.settings

    @property
    def rummager(self) -> Rummager:
        """The finder's."""
        return self.finder.rummager


def build_fused(
    settings: FusedSettings,
    *,
    cache_dir: Path | None = None,
    tool: Tool | None = None,
    table: HandleTable | None = None,
) -> FusedParts:
    """Make the parts of a run.

    Args:
        settings: of the run.
        cache_dir: folder that keeps the arm's reach and the table of grasps; None works them out each time (a minute).
        tool: made before by `make_tool`; None makes one.
        table: made before by `handle_table`; None makes one.
    """
    spec = task_of(settings)
    tool, model = tool or make_tool(spec, cache_dir=cache_dir), spec.object_factory()
    task = FusedTask(settings, tool, model, cache_dir=cache_dir)
    finder = build_finder(settings, tool=tool, model=model)
    gripper = HandleGripper(model.exact, task.world.body, spec.physics)
    return FusedParts(task, finder, gripper, table or handle_table(gripper, cache_dir=cache_dir))
