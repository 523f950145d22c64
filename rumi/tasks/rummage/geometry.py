"""Geometry of a run's scene, for its figures."""

import torch

from rumi.runs.scene_geometry import SceneGeometry, make_geometry
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import reachability

_OUTLINE_SPACING = 0.002  # metres between the tool's points that its outline is drawn from


def geometry_of(agent: object) -> SceneGeometry | None:
    """What figures need to know of the scene; None where the agent neither rummages nor has one that does."""
    rummager = getattr(agent, "rummager", agent)
    return scene_geometry(rummager) if isinstance(rummager, Rummager) else None


def scene_geometry(rummager: Rummager) -> SceneGeometry:
    """What figures need to know of the scene."""
    section = rummager.tool.shape.section(_OUTLINE_SPACING)
    return make_geometry(
        rummager.model.to("cpu"),
        rummager.workspace.to("cpu"),
        torch.cat((section, torch.zeros_like(section[:, :1])), -1),
        height_m=rummager.height_m,
        reachability=reachability(rummager.tool, rummager.workspace).cpu(),
        thresholds={
            "nll": rummager.nll_threshold,
            "expected_nll": rummager.stop_rule.expected_nll,
            "apc": rummager.stop_rule.apc_ratio * rummager.model.diagonal,
        },
        tolerance={"within_m": rummager.position_tolerance_m, "within_rad": rummager.rotation_tolerance_rad},
    )
