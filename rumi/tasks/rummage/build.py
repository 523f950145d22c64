"""From settings to the parts of a run."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.agent import Parts
from rumi.belief.contact_evidence import SignalSettings
from rumi.belief.evidence import make_evidence
from rumi.belief.island_filter import IslandFilter
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.reinitialise import ReinitialiseSettings
from rumi.dynamics.registry import AUTO, PushSettings
from rumi.errors import UsageError
from rumi.fields.workspace import Workspace
from rumi.planning.on_device import PolicyOnDevice
from rumi.planning.policy import Policy
from rumi.planning.registry import POLICIES
from rumi.registration.descent import Search
from rumi.robot.tool import Tool
from rumi.sim.conditions import words as conditions_of
from rumi.sim.fault import Fault
from rumi.sim.faults import parse_fault
from rumi.sim.robot_arm import RobotArm
from rumi.sim.sensor_faults import Stale
from rumi.sim.settings import SimSettings
from rumi.task import Task, TaskOnDevice
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.approach import APPROACH_M
from rumi.tasks.rummage.motions import (
    check_pushing,
    check_trajectory,
    followed,
    guarded,
    is_planar,
    planned,
    predicts_motion,
    prior_of,
    push_posterior_of,
    pushed_motion,
    trajectory_filter,
    unsteady,
    with_eye,
)
from rumi.tasks.rummage.objects import with_object
from rumi.tasks.rummage.scene_spec import TaskSpec
from rumi.tasks.rummage.scenes import find_task, make_tool
from rumi.tasks.rummage.sensed import SensedTask
from rumi.tasks.rummage.settings import Settings
from rumi.tasks.rummage.simulated import SimTask
from rumi.tasks.rummage.tool_height import at_tool_height
from sdf.object_model import ObjectModel
from sensors.discrepancy import Discrepancy
from sensors.evidence import EvidenceModel


def build(settings: Settings, *, cache_dir: Path | None = None) -> Parts[Task, Rummager]:
    """Make the parts of a run.

    Args:
        settings: of the run.
        cache_dir: folder that keeps what takes seconds to work out; None keeps nothing.

    Raises:
        UsageError: there is no such task or device, or the object cannot be used or does not suit the task.
    """
    spec, dtype = find_task(settings.task), settings.torch_dtype
    check_pushing(spec, settings)
    if settings.steps is not None:
        spec = replace(spec, steps=settings.steps)
    spec, model = with_object(spec, settings.object, cache_dir=cache_dir)
    spec = at_tool_height(spec, model.sdf, model.exact, settings.tool_height_m)
    tool = make_tool(spec, settings.simulator, cache_dir=cache_dir)
    faults = faults_of(spec, settings)
    task: Task = make_task(spec, guarded(spec, settings), cache_dir=cache_dir, tool=tool, model=model, faults=faults)
    if dtype != torch.float32:
        task = TaskOnDevice(task, torch.device("cpu"), dtype)
    said = conditions_of(settings.simulator, settings.conditions)
    settings = replace(settings, filter=with_eye(spec, settings.filter))
    return Parts(task, replace(build_rummager(spec, settings, model, tool), steps=spec.steps, conditions=said))


def make_task(
    spec: TaskSpec | str,
    settings: SimSettings | None = None,
    *,
    cache_dir: Path | None = None,
    tool: Tool | None = None,
    model: ObjectModel | None = None,
    faults: Sequence[Fault] = (),
    arm: RobotArm | None = None,
) -> SimTask:
    """Simulate a task; needs MuJoCo.

    Args:
        spec: the task or its name.
        settings: of the simulator and its sensors.
        cache_dir: folder that keeps the arm's reach and convex pieces of meshes; None works them out each time.
        tool: made before by `make_tool`; None makes one.
        model: made before by the task's `object_factory`; None makes one.
        faults: what goes wrong.
        arm: that carries the gripper; None for that of `settings.robot`.
    """
    spec = find_task(spec) if isinstance(spec, str) else spec
    settings = settings or SimSettings()
    tool = tool if tool is not None else make_tool(spec, settings, cache_dir=cache_dir)
    model = model if model is not None else spec.object_factory()
    if settings.sensors.kind != "points":
        return SensedTask(spec, settings, tool, model, cache_dir=cache_dir, faults=faults, arm=arm)
    return SimTask(spec, settings, tool, model, cache_dir=cache_dir, faults=faults, arm=arm)


def build_rummager(
    spec: TaskSpec, settings: Settings, model: ObjectModel, tool: Tool, workspace: Workspace | None = None
) -> Rummager:
    """How an object is found: filter and stopping rule, on the CPU, and policy, on the settings' device.

    Args:
        spec: of the task.
        settings: of the run.
        model: the object.
        tool: the gripper.
        workspace: lattice of the fields; by default the task's.
    """
    dtype = settings.torch_dtype
    model, tool = model.to(dtype), copy.deepcopy(tool).to(dtype)
    workspace = (workspace or workspace_of(spec)).to(dtype)
    discrepancy = Discrepancy(
        model.sdf, model.radius, free_scale=settings.filter.free_scale, tolerance=settings.filter.tolerance_m
    )
    prior = prior_of(spec, model)
    following, stop = followed(spec, settings), settings.stop
    if spec.apc_ratio is not None:
        stop = replace(stop, apc_ratio=spec.apc_ratio)
    if settings.simulator.sensors.kind == "camera":  # which feels nothing
        stop = replace(stop, contacts=0)
    standing = 0.0 - float(model.exact.bounds[0, 2])
    renewal = settings.renewal
    if following.motion == "trajectory":
        check_trajectory(settings)
        pose_filter: PoseFilter = trajectory_filter(
            spec, following, settings.simulator, discrepancy, tool, model, standing
        )
        if stop.rule == AUTO and isinstance(pose_filter, IslandFilter):
            most_nll = spec.nll_threshold if stop.most_nll is None else stop.most_nll
            stop = replace(stop, rule="probability", most_nll=most_nll)
        renewal = ReinitialiseSettings.never()  # its particles come from the prior, and are moved under all evidence
    else:
        pushed = None
        if predicts_motion(following):
            pushed = pushed_motion(settings.planner, model, tool, spec.height_m, standing)
        further: tuple[EvidenceModel, ...] = ()
        if following.evidence:
            surface = tool.shape.surface(SignalSettings().spacing_m).to(dtype)
            further = make_evidence(following.evidence, model.sdf, surface)
        pose_filter = PoseFilter(following, [discrepancy, *further], cast(Search, spec.search), prior, pushed)
    careful = unsteady(pose_filter) and guarded(spec, settings).guarded == "always"
    retreats, planner = careful if settings.retreats is None else settings.retreats, planned(spec, settings)
    if stop.further is None and planner.next_touch and not retreats:
        stop = replace(stop, further=1)
    return Rummager(
        model,
        pose_filter.to(dtype),
        _policy_of(replace(settings, planner=planner), reachability(tool, workspace)),
        workspace,
        tool,
        initialise=settings.initialise,
        renewal=renewal,
        stop_rule=stop,
        misfit=settings.misfit,
        height_m=standing,
        replan_every=settings.replan_every,
        budget_s=settings.plan_budget_s,
        nll_threshold=spec.nll_threshold,
        position_tolerance_m=spec.position_tolerance_m,
        rotation_tolerance_rad=spec.rotation_tolerance_rad,
        # trajectories in space topple from one resting pose to the next, whatever the search for poses has
        upright=spec.search == "SE(2)" and not isinstance(pose_filter, IslandFilter),
        looks_again=_looks_again(spec, settings),
        senses_motion=spec.measures_motion and settings.simulator.measures_motion,
        approach_m=(APPROACH_M if careful else 0.0) if settings.approach_m is None else settings.approach_m,
        retreats=retreats,
        sensors=_sensors(spec, settings),
        pushes=push_posterior_of(settings.planner) if _slides(spec, settings.planner) else None,
    )


def faults_of(spec: TaskSpec, settings: Settings) -> tuple[Fault, ...]:
    """What goes wrong in a run.

    Raises:
        UsageError: something that cannot be, or not in this task.
    """
    steps = spec.steps if settings.steps is None else settings.steps
    found = tuple(parse_fault(text, steps=steps, seed=settings.seed) for text in settings.fault)
    if any(isinstance(fault, Stale) for fault in found) and not _looks_again(spec, settings):
        raise UsageError(
            f"Expected a camera that looks again for --fault stale: {spec.name} looks once (or not at all)"
        )
    return found


def _looks_again(spec: TaskSpec, settings: Settings) -> bool:
    """Whether a camera sees the object after every action too."""
    return spec.looks_again or settings.simulator.sensors.kind in ("camera", "both")


def _sensors(spec: TaskSpec, settings: Settings) -> str:
    """What the robot senses by, for people."""
    felt = {"points": "felt points", "bubbles": "bubbles", "both": "bubbles", "camera": ""}
    view = "no view" if spec.prior is not None else "a first view"
    seen = "a camera that looks after every action" if _looks_again(spec, settings) else view
    further = (felt[settings.simulator.sensors.kind], *settings.filter.evidence)
    return ", ".join(filter(None, (seen, *further)))


def _slides(spec: TaskSpec, planner: PushSettings) -> bool:
    """Whether plans are made by the quasi-static model."""
    return is_planar(spec) and planner.push_model in (AUTO, "quasi-static")


def workspace_of(spec: TaskSpec) -> Workspace:
    """The lattice of a task: planar at the height of its tool, or from the floor up where that moves in space."""
    (left, bottom), (right, top) = spec.bounds
    if spec.spatial:
        box = torch.tensor([[left, bottom, 0.0], [right, top, spec.workspace_top_m]])
        return Workspace.from_bounds(box, spec.field_spacing_m)
    bounds = torch.tensor([[left, bottom, spec.height_m], [right, top, spec.height_m]])
    return Workspace.from_bounds(bounds, spec.field_spacing_m, planar_height=spec.height_m)


def reachability(tool: Tool, workspace: Workspace) -> Float[Tensor, "V"]:
    """r(x) of every point of the workspace; 1 everywhere for a tool that flies freely."""
    points = workspace.points
    return torch.ones_like(points[:, 0]) if tool.reach is None else tool.reach.field(points)


def _policy_of(settings: Settings, reach: Float[Tensor, "V"]) -> Policy:
    """The policy of the settings' method, on their device; one that chooses the next touch is for the CPU."""
    chosen = settings.method == "rumi" and bool(settings.planner.next_touch)
    device = torch.device("cpu") if chosen else settings.torch_device
    policy = make_policy(settings, reach.to(device))
    return policy if device.type == "cpu" else PolicyOnDevice(policy, device)


def make_policy(settings: Settings, reach: Float[Tensor, "V"]) -> Policy:
    """The policy of the settings' method.

    Raises:
        UsageError: the method needs a package that is not installed.
    """
    return POLICIES[settings.method](settings, reach)
