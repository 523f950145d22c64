"""View of a run that rummages: points, tool, contacts and forces, and the plan with what it went for."""

import json
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.planning.policy import Plan
from rumi.records import StepRecord
from rumi.registration.pose_summary import PoseSummary
from rumi.runs.memory import memory
from rumi.runs.plain import plain
from rumi.runs.scene_geometry import SceneGeometry
from rumi.viz import style
from rumi.viz.outlines import object_outline, placed
from rumi.viz.primitives import Arrows, Lines, Points, Shape, at_height, rgb, shades
from rumi.viz.reasons import reason_of
from rumi.viz.task_view import ENTROPY, DecisionView, StepView
from sensors.contact_reading import ContactReading
from sensors.reading import FORCE, Reading
from sensors.semantics import Semantics

PLOTS = {
    "nll": "nats",
    "entropy": ENTROPY,
    "right": "P(right), by the belief",
    "faults": "probability of each fault",
    "fault": "nats for a fault",
}

_POINTS = 5000  # of a class
_WORTH = 0.05  # of the most information, below which a place is not drawn
_CLASSES = {
    "surface": (Semantics.SURFACE, style.SURFACE, 0.002),
    "free": (Semantics.FREE, style.FREE, 0.0006),
    "occupied": (Semantics.OCCUPIED, style.INK, 0.002),
}
_REACHED = 0.99  # of r(x), from which on a place counts as within reach
_FORCE_M = 0.01  # that an arrow is long for a newton
_NORMAL_M = 0.02  # the same of a normal


class RummagingView:
    """View of a task whose steps are `StepRecord`s.

    Args:
        geometry: of the scene; None where the task tells none.
    """

    plots: Mapping[str, str] = PLOTS

    def __init__(self, geometry: SceneGeometry | None) -> None:
        self._geometry = geometry
        self.bounds: Float[Tensor, "2 3"] | None = None
        if geometry is not None:
            places = geometry.workspace.points
            self.bounds = torch.stack((places.amin(0), places.amax(0)))

    def fixed(self) -> Mapping[str, Shape]:
        """The places that the robot does not reach, or only in part."""
        if self._geometry is None or self._geometry.reachability is None:
            return {}
        reach = self._geometry.reachability
        beyond = reach < _REACHED
        colours = shades(style.CONTACT, 0.35 * (1 - reach[beyond].clamp(0, 1)))
        return {"out_of_reach": Points(self._geometry.workspace.points[beyond], colours, 0.0015)}

    def body(self) -> Mapping[str, Shape]:
        """The object's surface."""
        if self._geometry is None:
            return {}
        return {"surface": Points(self._geometry.surface_points, rgb(style.NLL), 0.0014)}

    def outline(self, world_T_object: Float[Tensor, "4 4"]) -> list[np.ndarray]:
        """The object from above, on the floor."""
        if self._geometry is None:
            return []
        return [at_height(line, 0.0) for line in object_outline(self._geometry, world_T_object)]

    def step(self, records: Sequence[StepRecord], pose: PoseSummary | None) -> StepView:
        """What was sensed up to the last step, and where the tool went."""
        record, seen = records[-1], memory(records)
        scene: dict[str, Shape] = {}
        for name, (kind, colour, radius) in _CLASSES.items():
            points = seen.points[seen.of_class(kind)]
            scene[f"points/{name}"] = Points(points[:: max(1, len(points) // _POINTS)], rgb(colour), radius)
        tool = record.reading.tool_pose
        path = torch.cat([one.reading.tool_pose[:, :3, 3] for one in records])
        touched = torch.cat([one.reading.in_contact for one in records])
        scene["tool/path"] = Lines([path.numpy()], rgb(style.PATH), 0.0012)
        scene["contacts"] = Points(path[touched], rgb(style.CONTACT), 0.003)
        if self._geometry is not None:
            outline = [at_height(line, float(tool[-1, 2, 3])) for line in placed(self._geometry.tool, tool[-1])]
            scene["tool/outline"] = Lines(outline, rgb(style.TOOL), 0.0012)
        known = {"nll/true": record.nll, "nll/expected": record.expected_nll, "fault/evidence": record.lost}
        curves = {name: value for name, value in known.items() if value is not None and math.isfinite(value)}
        curves |= {f"faults/{name.replace(' ', '_')}": share for name, share in record.explanations.items()}
        if record.truth is not None:
            scene["truth"] = Lines(self.outline(record.truth.double()), rgb(style.TRUTH), 0.0008)
        remarks = [f"{remark.name}: {json.dumps(plain(remark))}" for remark in record.remarks]
        return StepView(scene | _forces(record.reading), curves, remarks)

    def decision(self, records: Sequence[StepRecord]) -> DecisionView | None:
        """The plan that was followed to the last step, the information that it went for, and its numbers."""
        plan, before = records[-1].plan, records[:-1]
        if plan is None:
            return None
        height = float(before[-1].reading.tool_pose[-1, 2, 3])
        scene: dict[str, Shape] = {"path": Lines([_in_space(plan.path, height)], rgb(style.EXPECTED), 0.002)}
        if plan.samples is not None:
            ways = [_in_space(path, height) for path in plan.samples.paths]
            scene["samples"] = Lines(ways, _by_cost(plan.samples.costs), 0.0006)
        if self._geometry is not None and "information" in plan.fields:
            scene["information"] = _information(self._geometry, plan.fields["information"])
        executed = sum(record.plan is plan for record in before)
        return DecisionView(scene, self._words(plan, executed))

    def _words(self, plan: Plan, executed: int) -> str:
        reasons = [f"- {line}" for line in reason_of(plan, executed, self._geometry).lines()]
        told = [f"- {name}: {_rounded(value)}" for name, value in (plan.info | {"skipped": plan.skipped}).items()]
        return "\n".join(["**The next action**", "", *reasons, "", "**The plan's numbers**", "", *told])


def _forces(reading: Reading) -> dict[str, Shape]:
    """Forces on the tool at each instant, and touches that a wrench told with the normals there."""
    found: dict[str, Shape] = {}
    force = reading.measurements.get(FORCE)
    if force is not None:
        known = force.isfinite().all(-1)
        at = reading.tool_pose[known][:, :3, 3]
        found["wrench/force"] = Arrows(at, _FORCE_M * force[known], rgb(style.INK))
    if isinstance(reading, ContactReading):
        touch = reading.wrench
        found["wrench/touches"] = Arrows(touch.points, _NORMAL_M * touch.normals, rgb(style.CONTACT))
    return found


def _information(geometry: SceneGeometry, field: Float[Tensor, "V"]) -> Points:
    """The places of most information, the brighter the more."""
    values = field.float() / field.float().max().clamp_min(1e-12)
    kept = values > _WORTH
    return Points(geometry.workspace.points[kept], shades(style.EXPECTED, values[kept]), 0.002)


def _in_space(path: Float[Tensor, "T Q"], z: float) -> np.ndarray:
    """Places (T, 3) of a path: of a tool that moves in the plane at a height."""
    heights = path[:, 2:3] if path.shape[-1] == 4 else path.new_full((len(path), 1), z)
    return torch.cat((path[:, :2], heights), -1).float().numpy()


def _by_cost(costs: Float[Tensor, "K"]) -> list[tuple[int, ...]]:
    """Colours of rejected samples, the fainter the more they cost."""
    beyond = (costs - costs.min()) / (costs.max() - costs.min()).clamp_min(1e-12)
    return shades(style.INK, 0.6 - 0.45 * beyond)


def _rounded(value: object) -> object:
    """A value with three digits of its numbers."""
    if isinstance(value, float):
        return f"{value:.3g}"
    return ", ".join(str(_rounded(one)) for one in value) if isinstance(value, list | tuple) else value
