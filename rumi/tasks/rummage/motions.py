"""Motion of the object in a task: which filter follows it, by which push model, and what suits the task."""

from dataclasses import replace
from typing import cast

from rumi.belief.island_filter import IslandFilter
from rumi.belief.motion import Motion, PushedMotion
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.prior import PosePrior
from rumi.belief.pushed_object import PushedObject
from rumi.belief.toppled_object import ToppledObject
from rumi.dynamics.push_posterior import PushPosterior, push_posterior
from rumi.dynamics.registry import AUTO, PUSH_MODELS, PushSettings, push_model
from rumi.errors import UsageError
from rumi.planning.rummaging_settings import RummagingSettings
from rumi.registration.descent import Search
from rumi.robot.gripper import gripper_of
from rumi.robot.tool import Tool
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.scene_spec import TaskSpec
from rumi.tasks.rummage.settings import Settings
from rumi.tasks.rummage.stated_errors import as_accurate, as_inexact
from sdf.object_model import ObjectModel
from sdf.primitives import Mug
from sensors.discrepancy import Discrepancy

_PLANAR = ("pushed", "corrected", "trajectory")  # motions of upright objects and a level tool; the last of others too
_FIRST_BY_PRIOR = 3000  # particles of a first touch where no view shows the object
# push model of plans of guarded moves in space, and what they weigh pushes and reach by
_CARRIED, _PUSH_SCALE, _REACH_SCALE = "displacement", 1.0, 0.5
_SHARPNESS = 300.0  # 1/m, of the sensor model that plans of guarded moves in space go by: as sharp as pads are
_FRESH_M = 0.003  # way of the tool in space after which its pads tell something new
_SURFACE_SPACING = 0.008  # metres between the points of a tool in space that push


def followed(spec: TaskSpec, settings: Settings) -> FilterSettings:
    """The filter's settings with the motion that something measures, or what takes its place."""
    following, possible = settings.filter, _no_trajectory(settings) is None
    if following.motion not in ("auto", "measured"):
        return following
    if spec.measures_motion and settings.simulator.measures_motion:
        apart = following.motion == "auto" and possible and spec.prior is not None and not is_planar(spec)
        return replace(following, motion="trajectory" if apart else "measured")
    motion = untracked(
        following.unmeasured,
        planar=is_planar(spec),
        seen=spec.camera is not None and spec.prior is None,
        trajectories=possible,
    )
    return replace(following, motion=motion)


def guarded(spec: TaskSpec, settings: Settings) -> SimSettings:
    """The simulator's settings with whether actions are guarded moves.

    What a long push does is the least that a belief of trajectories knows; a short one tells as much.
    """
    simulator = settings.simulator
    if simulator.guarded != "auto":
        return simulator
    return replace(simulator, guarded="always" if followed(spec, settings).motion == "trajectory" else "never")


def unsteady(pose_filter: PoseFilter) -> bool:
    """Whether an object that is followed by touch alone is soon toppled, as it stands at first."""
    model = pose_filter.model if isinstance(pose_filter, PoseTrajectoryFilter) else None
    return isinstance(model, ToppledObject) and model.unsteady


def planned(spec: TaskSpec, settings: Settings) -> RummagingSettings:
    """The planner's settings with what suits guarded moves in space, where nothing else is asked for.

    The next touch is chosen, unless plans by a push model are asked for. These count on actions that end where they
    touch, a push costs certainty, and reach is worth less: no action takes the object far. Information is as near to
    the surface as pads feel it, so that plans touch what is nearly known.
    """
    planner = settings.planner
    if is_planar(spec) and planner.next_touch:
        raise UsageError(
            f"Expected a tool that moves in space with --planner.next-touch True, got {spec.name}, whose tool keeps to "
            "a plane: leave it out there"
        )
    if is_planar(spec) or guarded(spec, settings).guarded != "always" or planner.push_model not in (AUTO, _CARRIED):
        return planner
    information = planner.information
    if information.sharpness is None:
        information = replace(information, sharpness=_SHARPNESS)
    return replace(
        planner,
        information=information,
        next_touch=planner.push_model == AUTO if planner.next_touch is None else planner.next_touch,
        push=replace(planner.push, guarded=True),
        push_scale=_PUSH_SCALE if planner.push_scale is None else planner.push_scale,
        sensed_here=planner.sensed_here is not False,
        reachability_scale=_REACH_SCALE if planner.reachability_scale is None else planner.reachability_scale,
    )


def untracked(asked: Motion | None, *, planar: bool, seen: bool, trajectories: bool) -> Motion:
    """The motion of an object that nothing measures: each particle's own, wherever these can start.

    Args:
        asked: by the settings; None for the most exact that there is.
        planar: whether the object stays upright and the tool level.
        seen: whether a camera sees the object at first; else a prior says where it is about.
        trajectories: whether nothing is sensed that trajectories do not take in.
    """
    if planar:
        return asked or ("trajectory" if seen and trajectories else "corrected")
    if asked is not None and asked not in _PLANAR:
        return asked
    return "trajectory" if not seen and trajectories and asked in (None, "trajectory") else "estimated"


def predicts_motion(following: FilterSettings) -> bool:
    """Whether the filter moves the object by the planner's push model."""
    return following.motion in ("pushed", "corrected")


def is_planar(spec: TaskSpec) -> bool:
    """Whether the object stays upright and the tool level."""
    return spec.search == "SE(2)" and not spec.spatial


def with_eye(spec: TaskSpec, settings: FilterSettings) -> FilterSettings:
    """The settings with the place of a task's camera, where they have none and the object is followed in the plane."""
    own = settings.trajectories
    if spec.camera is None or own.eye_m is not None or not is_planar(spec):
        return settings
    return replace(settings, trajectories=replace(own, eye_m=spec.camera.position))


def trajectory_filter(
    spec: TaskSpec,
    settings: FilterSettings,
    simulator: SimSettings,
    discrepancy: Discrepancy,
    tool: Tool,
    model: ObjectModel,
    resting_m: float,
) -> PoseTrajectoryFilter:
    """The filter whose particles each have their own motion.

    Args:
        spec: of the task.
        settings: of the filter.
        simulator: which states how exact its sensors are; the filter's are as wide.
        discrepancy: of the object.
        tool: the gripper.
        model: the object.
        resting_m: of an upright object's origin above the floor.
    """
    spacing = settings.trajectories.pad_spacing_m
    if is_planar(spec):
        own = settings.trajectories
        settings = replace(settings, trajectories=own.for_mugs() if isinstance(model.exact, Mug) else own.for_others())
    if spec.looks_again:
        settings = replace(settings, trajectories=settings.trajectories.seen_again())
    own, systematic = settings.trajectories, settings.stated_errors != "noise" and is_planar(spec)
    own = as_inexact(own, simulator, model.sdf.bounds, spec.camera) if systematic else as_accurate(own, simulator)
    prior = prior_of(spec, model)
    if is_planar(spec) and prior is not None:
        own = replace(own, first_particles=max(own.first_particles, _FIRST_BY_PRIOR))
    settings = replace(settings, trajectories=own)
    if is_planar(spec):
        pushed = PushedObject.of(
            discrepancy.sdf,
            tool.shape,
            height_m=spec.height_m,
            resting_m=resting_m,
            spacing_m=settings.trajectories.tool_spacing_m,
            pad_spacing_m=spacing,
        )
        if own.lone:  # a hard tool is felt at its surface, and a round one told by its axis
            settings = replace(settings, trajectories=replace(own, felt_m=pushed.round_m or 0.0))
        return PoseTrajectoryFilter(settings, discrepancy, pushed, prior)
    fresh_m = _FRESH_M if own.fresh_m is None else own.fresh_m
    own = replace(own, fresh_m=fresh_m, false=max(own.false, simulator.pads.false))
    settings = replace(settings, trajectories=own)
    if prior is None:
        raise UsageError(f"Expected a prior for --filter.motion trajectory in space, got none for {spec.name}")
    toppled = ToppledObject.of(
        discrepancy.sdf,
        gripper_of(tool.shape),
        prior.ways,
        model.symmetries,
        spacing_m=_SURFACE_SPACING,
        pad_spacing_m=spacing,
        felt_ahead_m=spec.felt_ahead_m,
        wide=own.unfitted,
    )
    return IslandFilter(settings, discrepancy, toppled, prior, cast(Search, spec.search))


def pushed_motion(
    planner: PushSettings, model: ObjectModel, tool: Tool, height_m: float, resting_m: float
) -> PushedMotion:
    """Motion of a pushed object that nothing measures, by the planner's push model ("auto": the quasi-static one).

    Args:
        planner: its settings.
        model: the object.
        tool: the gripper.
        height_m: of the level tool.
        resting_m: of the object's origin above the floor.

    Raises:
        UsageError: the push model does not predict motions.
    """
    name = "quasi-static" if planner.push_model == AUTO else planner.push_model
    return PushedMotion(push_model(name, "motion", planner).motion(model, tool.shape, height_m, resting_m))


def prior_of(spec: TaskSpec, model: ObjectModel) -> PosePrior | None:
    """What is known of the pose before anything is sensed, on the model's device; None where a camera sees it."""
    if spec.prior is None:
        return None
    return PosePrior.of(spec.prior.mean_m, spec.prior.spread_m, model.sdf.bounds, spec.up, spec.prior.yaw_rad)


def push_posterior_of(planner: PushSettings) -> PushPosterior | None:
    """What is believed of how an object slides before a run; None where that is fixed."""
    return push_posterior(planner.push_parameters, planner.quasi_static.friction)


def check_pushing(spec: TaskSpec, settings: Settings) -> None:
    """Refuse models that push upright objects, most of them with a level tool, where the task has others."""
    push_posterior_of(settings.planner)  # a file that is none is told before anything is done
    following = settings.filter
    systematic = following.stated_errors == "systematic" or following.trajectories.systematic
    for flag, asked, why in (
        ("simulator.sensors.wrist-force", settings.simulator.sensors.wrist_force, "nothing else takes in a force"),
        ("filter.stated-errors systematic", systematic, "no other particles have errors of their own"),
    ):
        if asked and not (is_planar(spec) and followed(spec, settings).motion == "trajectory"):
            raise UsageError(
                f"Expected --filter.motion trajectory, an upright object and a level tool with --{flag}: {why}"
            )
    simulator = settings.simulator
    if simulator.guarded == "always" and simulator.sensors.kind != "points":
        raise UsageError(
            "Expected --simulator.sensors.kind points with --simulator.guarded always: pads that feel points end an "
            f"action, got {simulator.sensors.kind}"
        )
    if settings.filter.motion == "trajectory":
        check_trajectory(settings)
    if is_planar(spec):
        return
    upright, name = spec.search == "SE(2)", settings.planner.push_model
    suited = ("any", "upright") if upright else ("any",)
    if name != AUTO and PUSH_MODELS[name].objects not in suited:
        fits = " or ".join(other for other in PUSH_MODELS if PUSH_MODELS[other].objects in suited)
        raise UsageError(_other_task(spec, f"planner.push-model {name}", fits))
    if settings.filter.motion in _PLANAR and not (settings.filter.motion == "trajectory" and spec.prior is not None):
        raise UsageError(
            _other_task(spec, f"filter.motion {settings.filter.motion}", "measured, sticking or estimated")
        )


def check_trajectory(settings: Settings) -> None:
    """Refuse what trajectories do not take in."""
    if (why := _no_trajectory(settings)) is not None:
        raise UsageError(why)


def _no_trajectory(settings: Settings) -> str | None:
    """What trajectories do not take in; None for nothing."""
    for flag, odd, fits in (
        ("simulator.sensors.kind", settings.simulator.sensors.kind != "points", "points"),
        ("filter.evidence", bool(settings.filter.evidence), "none"),
        ("filter.free-points", settings.filter.free_points != "ride", "ride"),
    ):
        if odd:
            return f"Expected --{flag} {fits} with --filter.motion trajectory, which takes in no other"
    return None


def _other_task(spec: TaskSpec, flag: str, fits: str) -> str:
    return f"--{flag} pushes upright objects with a level tool, and {spec.name} is another task: use {fits} there"
