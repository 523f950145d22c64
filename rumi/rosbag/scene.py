"""Parts of a run on an imported recording, as its mapping describes them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.contact_evidence import ContactPointModel, ContactSignalModel, SignalSettings
from rumi.belief.motion import Motion
from rumi.belief.pushed_prior import as_believed
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.outline import support_of
from rumi.errors import UsageError
from rumi.fields.workspace import Workspace
from rumi.rosbag.mapping import BagMap, SceneMap
from rumi.tasks.registry import IMPORTED
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.objects import OBJECTS, ObjectSettings, own_model
from rumi.tasks.rummage.own import rummager
from rumi.tasks.rummage.scene_spec import PriorSpec
from rumi.tasks.rummage.settings import Settings, from_dict, preset, to_dict
from sdf.base import SDF
from sensors.evidence import EvidenceModel
from sensors.reading import Reading

# trajectories by a wrench on a hard rod: what it feels it feels at its surface, while it is on the way, and not always
_OF_ROD: dict[str, Any] = {"lone": True, "fresh_m": 0.003, "pad_m": 0.0, "pad_slope_m": 0.001, "missed": 0.2}
_DRIFT_N = 0.1  # of a mean force, at least: its zero is off by what the tool was held with while it was tared
_MARGIN = 0.1  # metres about where the object and the tool are, for the workspace
_BELOW_TOP = 0.95  # of an object's height, above which a tool cannot meet it


def settings_of(mapping: BagMap) -> Settings:
    """The settings that a mapping asks for, on top of those of its preset.

    Where the mapping names no motion, the object's is "measured" if a frame rides with it; else it is that of
    `filter.unmeasured`, else "trajectory" where a prior is followed by the touches of an upright rod with a force
    sensor, else "corrected", or in space "estimated".

    Raises:
        UsageError: it has some that there are not, or that a recording has no use for, or says how far the tool may be
            off where the belief is followed in a way that does not ask.
    """
    asked = mapping.settings
    for name, use in (("task", "the recording is the task"), ("object", "the table [object] says it")):
        if name in asked:
            raise UsageError(f"Expected no {name} in the mapping's [settings], since {use}: leave it out")
    start = to_dict(preset(str(asked.get("preset", "default"))))
    settings = from_dict({**_merged(start, asked), "task": IMPORTED})
    if asked.get("filter", {}).get("motion", "auto") == "auto":
        motion = _unmeasured(mapping, settings) if mapping.frames.motion is None else "measured"
        settings = replace(settings, filter=replace(settings.filter, motion=motion))
    settings = replace(settings, filter=replace(settings.filter, trajectories=_trajectories(mapping, settings)))
    return replace(settings, object=mapping.object)


def _unmeasured(mapping: BagMap, settings: Settings) -> Motion:
    """The motion by which an object is followed that no frame rides with."""
    if mapping.scene.search != "SE(2)":
        return "estimated"
    if settings.filter.unmeasured is not None:
        return settings.filter.unmeasured
    scene, further = mapping.scene, mapping.signals_count or bool(settings.filter.evidence)
    felt = mapping.wrench is not None and mapping.wrench.level and not further
    unseen = scene.prior_mean_m is not None and not scene.looks_again
    return "trajectory" if felt and unseen else "corrected"


def _trajectories(mapping: BagMap, settings: Settings) -> PoseTrajectorySettings:
    """The settings of trajectories: for those at defaults what the mapping says of the tool's place, and a rod's own.

    A rod has its own where its wrench alone tells of touches.
    """
    own, wrench, motion = settings.filter.trajectories, mapping.wrench, settings.filter.motion
    if motion != "trajectory":
        if mapping.tool.off_m:
            raise UsageError(
                f"Expected tool.off_m = 0 in the mapping with filter.motion {motion!r}, got {mapping.tool.off_m:g}: "
                "leave it out, only 'trajectory' has the tool off its place"
            )
        return own
    new = replace(own, tool_off_m=mapping.tool.off_m)
    if wrench is not None and wrench.level:
        new = replace(new, **_OF_ROD, force_n=max(wrench.force_n, _DRIFT_N))
    return own.where_default(vars(new))


def rummager_of_map(
    mapping: BagMap,
    settings: Settings,
    places: Float[Tensor, "n 3"],
    cache_dir: Path | None = None,
    *,
    touching_m: float | None = None,
) -> Rummager:
    """`rumi.rummager` of what a mapping says: all that a replay of a recording needs beside its readings.

    Args:
        mapping: of the recording.
        settings: of the replay; their object takes the place of the mapping's.
        places: where the tool is or was, which the workspace has to hold.
        cache_dir: folder that keeps tables of distances.
        touching_m: height of the tool where it touches (`touching_height`), where the settings name none; by default
            the mean of the places'. What is lower than that is touched just below its top.

    Raises:
        UsageError: no object is named, or it or a setting cannot be used.
    """
    scene = mapping.scene
    if settings.object.mesh is not None:
        model = own_model(settings.object, cache_dir=cache_dir)
    elif scene.builtin is not None:
        model = OBJECTS[scene.builtin]()
    else:
        raise UsageError("Expected an object: a mesh in the mapping's table [object], or scene.builtin; or --mesh FILE")
    corners = torch.cat((places.float(), torch.tensor(scene.within)))
    bounds = torch.stack((corners.amin(0) - _MARGIN, corners.amax(0) + _MARGIN))
    spatial = scene.search == "SE(3)"
    if spatial:
        bounds[0, 2] = bounds[0, 2].clamp_min(0.0)
        workspace = Workspace.from_bounds(bounds, 0.02)
    else:
        low, high = model.exact.bounds[:, 2].tolist()
        height = float(places[:, 2].mean()) if touching_m is None else touching_m
        height = settings.tool_height_m or height
        workspace = Workspace.from_bounds(bounds, 0.01, planar_height=min(height, _BELOW_TOP * (high - low)))
    if settings.filter.trajectories.lone and not spatial:
        own = settings.filter.trajectories
        own = own.where_default(vars(as_believed(own, support_of(model.sdf).spread)))
        settings = replace(settings, filter=replace(settings.filter, trajectories=own))
    made = rummager(
        model,
        workspace,
        tool=mapping.tool.shape(),
        prior=_prior(scene),
        search=scene.search,
        looks_again=scene.looks_again,
        plans=False,
        settings=replace(settings, object=ObjectSettings(), tool_height_m=None),
    )
    if made.filter.settings.motion == "trajectory":
        if mapping.touches_count or mapping.signals_count:
            made.filter.with_evidence()
        return made
    models = contact_models(mapping, made.filter.discrepancy.sdf)
    # contacts count as the mapping says, other sensors as the settings do
    contacts = (ContactPointModel, ContactSignalModel)
    others = [model for model in made.filter.further if not isinstance(model, contacts)]
    return replace(made, filter=made.filter.with_evidence(*models, *others))


def _prior(scene: SceneMap) -> PriorSpec | None:
    if scene.prior_mean_m is None:
        return None
    yaw = None
    if scene.prior_yaw_deg is not None:
        yaw = math.radians(scene.prior_yaw_deg), math.radians(scene.prior_yaw_spread_deg)
    return PriorSpec(scene.prior_mean_m, scene.prior_spread_m, yaw)


def touching_height(readings: Sequence[Reading]) -> float | None:
    """Median height of the tool where it touched, metres; None where it never did."""
    touching = torch.cat([one.tool_pose[one.in_contact, 2, 3] for one in readings])
    return float(touching.median()) if len(touching) else None


def contact_models(mapping: BagMap, sdf: SDF) -> tuple[EvidenceModel, ...]:
    """Measurement models of the contacts that count by a mapping; none where no contact counts.

    Args:
        mapping: of the recording.
        sdf: of the object.
    """
    if not (mapping.touches_count or mapping.signals_count):
        return ()
    signals = SignalSettings() if mapping.torques is None else mapping.torques.signals()
    surface = mapping.tool.shape().surface(signals.spacing_m).float()
    points, wrench = ContactPointModel(sdf), mapping.wrench
    if wrench is not None:
        points = ContactPointModel(sdf, wrench.point_m, wrench.normal_rad, wrench.outlier)
    return points, ContactSignalModel(sdf, surface, signals)


def _merged(start: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings with others in the place of some."""
    found = dict(start)
    for name, value in asked.items():
        inner = found.get(name)
        found[name] = _merged(inner, value) if isinstance(inner, Mapping) and isinstance(value, Mapping) else value
    return found
