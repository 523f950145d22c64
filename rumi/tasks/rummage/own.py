"""The rummager of a robot of one's own, live or recorded: nothing is simulated."""

import math
from dataclasses import replace

from rumi.belief.motion import Motion
from rumi.errors import UsageError
from rumi.fields.workspace import Workspace
from rumi.registration.descent import Search
from rumi.robot.gripper import GripperShape, gripper_of
from rumi.robot.reach import Reach
from rumi.robot.tool import Tool
from rumi.robot.tool_shape import ToolShape
from rumi.sim.conditions import under
from rumi.tasks.registry import OWN
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build_rummager
from rumi.tasks.rummage.motions import check_pushing, untracked
from rumi.tasks.rummage.objects import ObjectSettings
from rumi.tasks.rummage.scene_spec import PriorSpec, TaskSpec
from rumi.tasks.rummage.settings import PRESETS, Settings, preset, to_dict
from rumi.tasks.rummage.tool_height import check_slice
from sdf.object_model import ObjectModel


def rummager(
    model: ObjectModel,
    workspace: Workspace,
    *,
    tool: ToolShape | None = None,
    arm: Reach | None = None,
    motion: Motion | None = None,
    prior: PriorSpec | None = None,
    up: tuple[str, ...] = ("z",),
    search: Search | None = None,
    action_m: float = 0.08,
    action_rad: float = 0.5,
    looks_again: bool = False,
    plans: bool = True,
    settings: Settings | None = None,
) -> Rummager:
    """The agent that finds an object by pushing it, for a robot of one's own.

    Args:
        model: the object, such as `sdf.object_model` makes it.
        workspace: lattice over which the tool moves: planar at the height of the tool, or of several layers for a tool
            that moves in space.
        tool: its shape; by default the gripper of the paper.
        arm: what the arm reaches, such as `rumi.ArmReach.of_urdf` makes it; None for a tool that gets everywhere.
        motion: how the object's motion is known. "measured": every reading must have `object_motion`, and one that
            lacks it is refused. Otherwise nothing has to measure it: "trajectory" (each particle's own, of which an
            `object_motion` is evidence where a reading has one: in the plane after
            a first view or from a prior, in space from a prior and by the gripper), "corrected" or "pushed" (a push
            model, of upright objects and a tool in the plane), "estimated" or "sticking". "auto" is "trajectory" in
            space from a prior and by the gripper, else "measured". By default that of the settings, or without
            settings `unmeasured`.
        prior: where the object is about, if the robot does not look at it first.
        up: axes of the object one of which points up where it lies, if the robot does not look at it first.
        search: freedom of the object's pose; by default "SE(3)" for a tool that moves in space.
        action_m: metres that a control of 1 asks for; no more than the robot does in one action: its limit of speed
            times the seconds that an action lasts.
        action_rad: radians, likewise.
        looks_again: a camera sees the object after every action too.
        plans: False where a recording is followed: what only a plan needs is not asked for.
        settings: by default those of the preset `default`. How exact sensors, tool pose and mesh are said to be is
            that of their `conditions`.

    Raises:
        UsageError: a setting that nothing here can follow, or that does not suit the workspace, arm or tool.
    """
    spatial = not workspace.planar
    if settings is None:
        settings = preset("default")
        motion = motion or unmeasured(settings, workspace, tool=tool, prior=prior)
    _check_followed(settings)
    motion = motion or settings.filter.motion
    if motion == "auto" and not (tool is None or isinstance(tool, GripperShape)):
        motion = "measured"  # what topples is followed before a gripper alone
    settings = replace(settings, filter=replace(settings.filter, motion=motion))
    for name, value in (("action_m", action_m), ("action_rad", action_rad)):
        if not 0 < value < float("inf"):
            raise UsageError(f"Expected {name} to be a finite number above 0, got {value}")
    if arm is not None and bool(arm.heights_m) != spatial:
        where = "in space" if spatial else "in the plane"
        raise UsageError(f"Expected the reach of a tool that moves {where}, got another: make it for this workspace")
    (left, bottom, low), (right, top, high) = workspace.bounds.tolist()
    spec = TaskSpec(
        OWN,
        "an object before another robot",
        lambda: model,
        (0.0, 0.0, 0.0),
        up=up,
        prior=prior,
        bounds=((left, bottom), (right, top)),
        height_m=low,
        heights_m=(low, high) if spatial else None,
        search=search or ("SE(3)" if spatial else "SE(2)"),
        looks_again=looks_again,
    )
    check_pushing(spec, settings)
    if not spatial:
        check_slice(model.sdf, model.exact.bounds, low, "the workspace another planar_height")
    step = workspace.spacing
    made = Tool(
        workspace.bounds if spatial else workspace.bounds[:, :2],
        arm,
        shape=tool,
        height_m=low,
        action_scale_m=action_m,
        action_scale_rad=action_rad,
        **({"body_spacing_m": 0.6 * step, "info_spacing_m": 0.5 * step} if spatial else {}),
    )
    if plans:
        _check_plans(settings, made, low)
    # which expected nll counts as found is known of the tasks' objects alone
    any_nll = math.inf if settings.stop.most_nll is None else settings.stop.most_nll
    asked = replace(settings, stop=replace(settings.stop, most_nll=any_nll))
    found = build_rummager(spec, asked, model, made, workspace)
    told = {**to_dict(settings), "task": OWN}
    return replace(found, steps=settings.steps, senses_motion=False, about=told)  # readings will tell whether they do


def unmeasured(
    settings: Settings,
    workspace: Workspace,
    *,
    tool: ToolShape | None = None,
    prior: PriorSpec | None = None,
) -> Motion:
    """The motion by which an object is followed that nothing measures, as `rummager` takes it; arguments as of it.

    In the plane "trajectory", "corrected" where nothing is seen at first; in space "trajectory" from a prior and by the
    gripper, else "estimated". What the settings ask for instead comes first.
    """
    return untracked(
        settings.filter.unmeasured,
        planar=workspace.planar,
        seen=prior is None,
        trajectories=workspace.planar or tool is None or isinstance(tool, GripperShape),
    )


def _check_plans(settings: Settings, tool: Tool, low: float) -> None:
    """Refuse a tool that would scrape the table, and one that the push model has not."""
    under = low + float(tool.shape.solid(0.01)[:, 2].min())
    if under < 0:
        raise UsageError(
            f"Expected a tool above the table, z = 0, got one that reaches {-under:.3f} m below it with its frame at "
            f"{low:.3f} m: raise the workspace"
        )
    if settings.planner.push_model == "mujoco":
        gripper_of(tool.shape)


def _check_followed(settings: Settings) -> None:
    """Refuse settings of what a robot of one's own has not."""
    if settings.object != ObjectSettings():
        raise UsageError("Expected no object in the settings, since the model is given: leave settings.object out")
    if settings.fault:
        raise UsageError(
            f"Expected no faults in the settings, since nothing is simulated, got {', '.join(settings.fault)}: leave "
            "settings.fault out"
        )
    if settings.tool_height_m is not None:
        raise UsageError("Expected no tool_height_m in the settings, since the workspace has the tool's height")
    if settings.simulator != under(PRESETS[settings.preset]().simulator, settings.conditions):
        raise UsageError(
            "Expected no settings of the simulator, since nothing is simulated: leave settings.simulator out, say how "
            "exact the sensors are by `conditions`, and give the action scales as action_m and action_rad"
        )
