"""Find the pose of an object by touching and pushing it (RUMI, arXiv 2408.10450).

The loop is `rumi.loop.run`; the parts it is made of lie in `rumi.belief`, `rumi.registration`, `rumi.fields`,
`rumi.dynamics` and `rumi.planning`, and each can be used alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rumi.agent import Agent
    from rumi.api import build, plot, replay, run
    from rumi.fields.workspace import Workspace
    from rumi.planning.policy import PlanRequest
    from rumi.robot.arm_reach import ArmReach
    from rumi.robot.tool_shape import SolidTool
    from rumi.runs.folder import load_run
    from rumi.task import Task
    from rumi.tasks.presets import preset
    from rumi.tasks.rummage.own import rummager
    from sensors.reading import Reading

__version__ = "0.1.0"
__all__ = [
    "Agent",
    "ArmReach",
    "PlanRequest",
    "Reading",
    "SolidTool",
    "Task",
    "Workspace",
    "build",
    "load_run",
    "plot",
    "preset",
    "replay",
    "rummager",
    "run",
]

_HOMES = {
    **dict.fromkeys(("build", "plot", "replay", "run"), "rumi.api"),
    "Agent": "rumi.agent",
    "ArmReach": "rumi.robot.arm_reach",
    "PlanRequest": "rumi.planning.policy",
    "Reading": "sensors.reading",
    "SolidTool": "rumi.robot.tool_shape",
    "Task": "rumi.task",
    "Workspace": "rumi.fields.workspace",
    "load_run": "rumi.runs.folder",
    "preset": "rumi.tasks.presets",
    "rummager": "rumi.tasks.rummage.own",
}


def __getattr__(name: str) -> object:
    """The public functions, loaded when they are first asked for: `import rumi` alone stays light."""
    if name not in _HOMES:
        raise AttributeError(f"module 'rumi' has no attribute {name!r}; it has {', '.join(__all__)}")
    found = getattr(import_module(_HOMES[name]), name)
    globals()[name] = found
    return found
