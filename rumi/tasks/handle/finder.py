"""How the mug of a fused run is found: all that a belief needs beside its readings; nothing here simulates."""

from dataclasses import dataclass, replace
from pathlib import Path

from rumi.belief.contact_evidence import ContactPointModel, ContactSignalModel
from rumi.robot.tool import Tool
from rumi.tasks.handle.settings import FusedSettings, task_of
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build_rummager
from rumi.tasks.rummage.scenes import make_tool
from rumi.tasks.rummage.settings import preset
from sdf.object_model import ObjectModel


@dataclass(frozen=True)
class Finder:
    """The same for a live run and for one from a log, and for all sensors.

    Attributes:
        settings: of the run.
        rummager: whose filter counts the evidence of contact.
    """

    settings: FusedSettings
    rummager: Rummager


def build_finder(
    settings: FusedSettings,
    *,
    cache_dir: Path | None = None,
    tool: Tool | None = None,
    model: ObjectModel | None = None,
) -> Finder:
    """Make it of settings.

    Args:
        settings: of the run.
        cache_dir: folder that keeps the arm's reach; None works it out each time (half a minute).
        tool: made before by `make_tool`; None makes one.
        model: of the mug; None makes it.
    """
    spec, plain = task_of(settings), preset(settings.preset, task="mug-0")
    tool, model = tool or make_tool(spec, cache_dir=cache_dir), model or spec.object_factory()
    rummager = build_rummager(spec, plain, model, tool)
    # a camera feels nothing that a belief could wait for; touches that are none cost what no pose explains
    contacts = 0 if settings.sensors == ("camera",) else settings.contacts
    stop = replace(plain.stop, fit_a_contact=settings.fit_a_contact, contacts=contacts)
    wrist, surface = settings.wrist, tool.shape.surface(settings.signals.spacing_m).float()
    pose_filter = rummager.filter.with_evidence(
        ContactPointModel(model.sdf, wrist.point_m, wrist.normal_rad, wrist.outlier),
        ContactSignalModel(model.sdf, surface, settings.signals),
    )
    return Finder(settings, replace(rummager, filter=pose_filter, stop=stop))
