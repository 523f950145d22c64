"""How an object is found in an imported recording: the parts of a run that its mapping describes."""

from dataclasses import asdict, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.contact_evidence import Feeling, SignalSettings
from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.robot.tool import Tool
from rumi.rosbag.mapping import BagMap
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build_rummager
from rumi.tasks.rummage.objects import with_object
from rumi.tasks.rummage.scenes import PriorSpec, TaskSpec, large_handled_mug
from rumi.tasks.rummage.settings import Settings, from_dict
from sdf.base import SDF
from sdf.drill import drill_model
from sdf.object_model import box_model

_BUILTIN = {"mug": large_handled_mug, "box": box_model, "drill": drill_model}
_MARGIN = 0.1  # metres about where the object and the tool are, for the workspace


def settings_of(mapping: BagMap) -> Settings:
    """The settings that a mapping asks for.

    Raises:
        UsageError: it has some that there are not.
    """
    return replace(from_dict({"task": "recording", **mapping.settings}), object=mapping.object)


def rummager_of_map(
    mapping: BagMap, settings: Settings, places: Float[Tensor, "n 3"], cache_dir: Path | None = None
) -> Rummager:
    """All that a replay of an imported recording needs beside its readings.

    Args:
        mapping: of the recording.
        settings: of the replay; their object takes the place of the mapping's.
        places: where the tool is or was, which the workspace has to hold.
        cache_dir: folder that keeps tables of distances.

    Raises:
        UsageError: no object is named, or it cannot be used.
    """
    scene = mapping.scene
    if settings.object.mesh is None and scene.builtin is None:
        raise UsageError("Expected an object: a mesh in the mapping's table [object], or scene.builtin; or --mesh FILE")
    corners = torch.cat((places.float(), torch.tensor(scene.within)))
    low, high = ((corners.amin(0) - _MARGIN).tolist(), (corners.amax(0) + _MARGIN).tolist())
    spatial = scene.search == "SE(3)"
    spec = TaskSpec(
        "recording",
        "a recording",
        _BUILTIN[scene.builtin or "mug"],
        (0.0, 0.0, 0.0),
        prior=None if scene.prior_mean_m is None else PriorSpec(scene.prior_mean_m, scene.prior_spread_m),
        bounds=((low[0], low[1]), (high[0], high[1])),
        height_m=float(places[:, 2].mean()),
        heights_m=(max(0.0, low[2]), high[2]) if spatial else None,
        workspace_top_m=high[2],
        field_spacing_m=0.02 if spatial else 0.01,
        search=scene.search,
        camera=None,
        measures_motion=False,
    )
    spec, model = with_object(spec, settings.object, cache_dir=cache_dir)
    bounds = torch.tensor([low, high]) if spatial else torch.tensor(spec.bounds)
    tool = Tool(bounds, shape=GripperShape(**asdict(mapping.tool)), height_m=spec.height_m)
    planner = replace(settings.planner, push_model="displacement")
    rummager = build_rummager(spec, replace(settings, method="rumi", planner=planner), model, tool)
    feeling = feeling_of(mapping, rummager.filter.discrepancy.sdf)
    return rummager if feeling is None else replace(rummager, filter=rummager.filter.feeling(feeling))


def feeling_of(mapping: BagMap, sdf: SDF) -> Feeling | None:
    """What a mapping has count beside points; None where nothing does.

    Args:
        mapping: of the recording.
        sdf: of the object.
    """
    if not (mapping.touches_count or mapping.signals_count):
        return None
    signals = SignalSettings() if mapping.torques is None else mapping.torques.signals()
    surface = GripperShape(**asdict(mapping.tool)).surface(signals.spacing_m).float()
    if mapping.wrench is None:
        return Feeling(sdf, surface, signals=signals)
    told = mapping.wrench
    return Feeling(sdf, surface, told.point_m, told.normal_rad, told.outlier, signals)
