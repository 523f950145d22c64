"""Parts of a run on an imported recording, as its mapping describes them."""

from dataclasses import asdict, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.contact_evidence import ContactPointModel, ContactSignalModel, SignalSettings
from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.robot.tool import Tool
from rumi.rosbag.mapping import BagMap
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build_rummager
from rumi.tasks.rummage.objects import OBJECTS, with_object
from rumi.tasks.rummage.scenes import PriorSpec, TaskSpec
from rumi.tasks.rummage.settings import Settings, from_dict
from sdf.base import SDF
from sensors.evidence import EvidenceModel

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
        OBJECTS[scene.builtin or "mug"],
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
    models = contact_models(mapping, rummager.filter.discrepancy.sdf)
    # contacts count as the mapping says, other sensors as the settings do
    contacts = (ContactPointModel, ContactSignalModel)
    others = [model for model in rummager.filter.further if not isinstance(model, contacts)]
    return replace(rummager, filter=rummager.filter.with_evidence(*models, *others))


def contact_models(mapping: BagMap, sdf: SDF) -> tuple[EvidenceModel, ...]:
    """Measurement models of the contacts that count by a mapping; none where no contact counts.

    Args:
        mapping: of the recording.
        sdf: of the object.
    """
    if not (mapping.touches_count or mapping.signals_count):
        return ()
    signals = SignalSettings() if mapping.torques is None else mapping.torques.signals()
    surface = GripperShape(**asdict(mapping.tool)).surface(signals.spacing_m).float()
    points, wrench = ContactPointModel(sdf), mapping.wrench
    if wrench is not None:
        points = ContactPointModel(sdf, wrench.point_m, wrench.normal_rad, wrench.outlier)
    return points, ContactSignalModel(sdf, surface, signals)
