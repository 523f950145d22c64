"""How a step becomes named arrays of a trace, and how it comes back."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kmppi import ControlPlan
from rumi.belief.particles import PoseBelief
from rumi.belief.remarks import Remark
from rumi.fields.workspace import Workspace
from rumi.planning.policy import Plan
from rumi.planning.sampled_paths import SampledPaths
from rumi.records import StepRecord
from rumi.runs.plain import plain
from rumi.runs.scene_geometry import OutlineMap, SceneGeometry
from rumi.runs.trace import TraceWriter
from rumi.runs.values import read_value, record_classes, write_value
from sdf.symmetry import Symmetries
from sensors.contact_reading import ContactReading, WrenchTouch
from sensors.observation import Observation
from sensors.reading import Reading

# numbers of a step that are kept as JSON; a missing or non-finite one is null there
_NUMBERS = ("step", "expected_nll", "fit", "apc", "ess", "contacts", "resampled", "converged", "nll", "lost", "p_value")
_LIGHT = (bool, int, float, str, list, tuple, type(None))
_POINTS = ("points", "semantics", "attached", "valid")
_WRENCH = ("points", "normals", "point_sd", "normal_sd", "instant")
_READING = ("instant", "tool_pose", "in_contact", "object_motion", "configuration", "clipped")
# what was felt is in the readings: a trace keeps what the belief came to
_BELIEF = ("world_T_attached", "attached_T_object", "log_weights", "discrepancy")


def numbers(step: StepRecord) -> dict[str, Any]:
    """The plain numbers of a step, ready for JSON."""
    told = {"stamp": step.reading.stamp, "remarks": step.remarks, "explanations": step.explanations}
    return plain({name: getattr(step, name) for name in _NUMBERS} | told)


def line(step: Any) -> dict[str, Any]:  # noqa: ANN401  (a record of any task)
    """The plain numbers of a step of any task, its seconds and marks."""
    if not isinstance(step, StepRecord):
        return plain({"step": step.step, **step.numbers(), "timings_s": step.timings_s})
    touched = step.control is not None and bool(step.reading.in_contact.any())
    return numbers(step) | {"sure": step.converged, "contact": touched, "timings_s": plain(step.timings_s)}


def write_step(trace: TraceWriter, step: Any, previous: Any) -> None:  # noqa: ANN401
    """Add a step; a plan that it shares with the previous step is not written again."""
    at = f"step_{step.step:05d}"
    if not isinstance(step, StepRecord):
        trace.json(f"{at}/numbers", {"kind": step.kind, "record": write_value(trace, at, step)})
        return
    _write(trace, at, {"control": step.control, "truth": step.truth})
    _write(trace, f"{at}/reading", {name: getattr(step.reading, name) for name in _READING})
    _write_points(trace, f"{at}/reading", step.reading.observation)
    if step.reading.measurements:
        trace.json(f"{at}/reading/sensors", list(step.reading.measurements))
        _write(trace, f"{at}/reading/measurements", step.reading.measurements)
    if isinstance(step.reading, ContactReading):
        _write(trace, f"{at}/reading", {"signals": step.reading.signals})
        _write(trace, f"{at}/reading/wrench", {name: getattr(step.reading.wrench, name) for name in _WRENCH})
    _write_points(trace, f"{at}/added", step.added)
    _write(trace, f"{at}/belief", {name: getattr(step.belief, name) for name in _BELIEF})
    plan, about = step.plan, None
    if plan is not None:
        info = {name: value for name, value in plan.info.items() if isinstance(value, _LIGHT)}
        about = {"skipped": plan.skipped, "info": info, "fields": list(plan.fields)}
        if previous is None or previous.plan is not plan:
            warm = plan.warm_start
            arrays = {"controls": plan.controls, "path": plan.path}
            _write(
                trace, f"{at}/plan", arrays if warm is None else arrays | {"knots": warm.knots, "warm": warm.controls}
            )
            # half precision: maps are for figures; what is decided from them is decided before
            _write(trace, f"{at}/plan/fields", {name: values.half() for name, values in plan.fields.items()})
            if plan.samples is not None:
                kept = {"paths": plan.samples.paths.float(), "costs": plan.samples.costs.float()}
                _write(trace, f"{at}/plan/samples", kept)
    # written last: a step without it was cut short
    trace.json(f"{at}/numbers", numbers(step) | {"plan": plain(about)})


def read_steps(members: Mapping[str, Any], timings_s: Mapping[int, dict[str, float]]) -> list[Any]:
    """All whole steps of a trace, in order.

    Args:
        members: what `read_trace` gave.
        timings_s: seconds by stage of each step, as far as they are known.
    """
    steps: list[Any] = []
    plan: Plan | None = None
    while (at := f"step_{len(steps):05d}") + "/numbers" in members:
        about = dict(members[f"{at}/numbers"])
        if "kind" in about:
            record = read_value(members, about["record"], record_classes(about["kind"]))
            steps.append(replace(record, timings_s=timings_s.get(len(steps), {})))
            continue
        stamp, plan_about = about.pop("stamp"), about.pop("plan")
        if plan_about is None:
            plan = None
        elif f"{at}/plan/controls" in members:
            plan = _read_plan(members, f"{at}/plan", plan_about)
        for name in ("expected_nll", "fit", "apc", "ess"):
            about[name] = math.nan if about[name] is None else about[name]
        remarks = tuple(Remark(**remark) for remark in about.pop("remarks", ()))
        # which older runs lack
        about |= {"lost": about.get("lost") or 0.0, "p_value": about.get("p_value", 1.0)}
        record = StepRecord(
            remarks=remarks,
            control=_get(members, f"{at}/control"),
            reading=_read_reading(members, f"{at}/reading", stamp),
            added=_read_points(members, f"{at}/added"),
            belief=_read_belief(members, f"{at}/belief"),
            plan=plan,
            truth=_get(members, f"{at}/truth"),
            timings_s=timings_s.get(len(steps), {}),
            **about,
        )
        steps.append(record)
    return steps


_OUTLINES = ("silhouette", "section", "tool")


def write_geometry(trace: TraceWriter, geometry: SceneGeometry) -> None:
    """Add what figures need beside the steps."""
    arrays = {"surface_points": geometry.surface_points, "reachability": geometry.reachability}
    _write(trace, "scene", arrays | {"workspace_origin": geometry.workspace.origin})
    outlines: dict[str, OutlineMap] = {name: getattr(geometry, name) for name in _OUTLINES}
    for name, outline in outlines.items():
        _write(trace, f"scene/{name}", {"values": outline.values, "origin": outline.origin})
    about = {
        "workspace_spacing": geometry.workspace.spacing,
        "workspace_shape": geometry.workspace.shape,
        "outline_spacing": {name: outline.spacing for name, outline in outlines.items()},
        "thresholds": geometry.thresholds,
        "symmetries": geometry.symmetries,
        "tolerance": geometry.tolerance,
    }
    trace.json("scene/about", plain(about))


def read_geometry(members: Mapping[str, Any]) -> SceneGeometry | None:
    """What `write_geometry` wrote, None if it wrote nothing."""
    if "scene/about" not in members:
        return None
    about = members["scene/about"]
    outlines = {
        name: OutlineMap(
            _need(members, f"scene/{name}/values"),
            _need(members, f"scene/{name}/origin"),
            about["outline_spacing"][name],
        )
        for name in _OUTLINES
    }
    return SceneGeometry(
        workspace=Workspace(
            _need(members, "scene/workspace_origin"), about["workspace_spacing"], tuple(about["workspace_shape"])
        ),
        surface_points=_need(members, "scene/surface_points"),
        reachability=_get(members, "scene/reachability"),
        thresholds=about["thresholds"],
        symmetries=_read_symmetries(about.get("symmetries")),
        tolerance=about.get("tolerance", {}),
        **outlines,
    )


def _read_symmetries(about: Mapping[str, Any] | None) -> Symmetries | None:
    if about is None:
        return None
    axis = None if about["axis"] is None else torch.tensor(about["axis"])
    return Symmetries(torch.tensor(about["rotations"]), torch.tensor(about["center"]), axis, about["ball"])


def _write(trace: TraceWriter, at: str, arrays: Mapping[str, Tensor | None]) -> None:
    for name, values in arrays.items():
        if values is not None:
            trace.array(f"{at}/{name}", values.detach().cpu().numpy())


def _write_points(trace: TraceWriter, at: str, points: Observation) -> None:
    # coordinates do not compress, labels do
    trace.array(f"{at}/points", points.points.detach().cpu().numpy(), compress=False)
    trace.array(f"{at}/semantics", points.semantics.cpu().numpy().astype(np.int8))
    _write(trace, at, {"attached": points.attached, "valid": points.valid})


def _read_points(members: Mapping[str, Any], at: str) -> Observation:
    points, semantics, attached, valid = (_need(members, f"{at}/{name}") for name in _POINTS)
    return Observation(points, semantics.long(), attached, valid)


def _read_reading(members: Mapping[str, Any], at: str, stamp: float) -> Reading:
    reading = Reading(
        observation=_read_points(members, at),
        instant=_need(members, f"{at}/instant").long(),
        tool_pose=_need(members, f"{at}/tool_pose"),
        in_contact=_need(members, f"{at}/in_contact"),
        object_motion=_get(members, f"{at}/object_motion"),
        configuration=_need(members, f"{at}/configuration"),
        clipped=_need(members, f"{at}/clipped"),
        stamp=stamp,
        measurements={name: _need(members, f"{at}/measurements/{name}") for name in members.get(f"{at}/sensors", ())},
    )
    if f"{at}/wrench/points" not in members:
        return reading
    wrench = WrenchTouch(**{name: _need(members, f"{at}/wrench/{name}") for name in _WRENCH})
    return replace(ContactReading.of(reading), wrench=wrench, signals=_get(members, f"{at}/signals"))


def _read_belief(members: Mapping[str, Any], at: str) -> PoseBelief:
    frame, poses, log_weights, discrepancy = (_need(members, f"{at}/{name}") for name in _BELIEF)
    return PoseBelief(frame, poses, log_weights, discrepancy)


def _read_plan(members: Mapping[str, Any], at: str, about: Mapping[str, Any]) -> Plan:
    knots, warm = _get(members, f"{at}/knots"), _get(members, f"{at}/warm")
    paths, costs = _get(members, f"{at}/samples/paths"), _get(members, f"{at}/samples/costs")
    return Plan(
        controls=_need(members, f"{at}/controls"),
        path=_need(members, f"{at}/path"),
        warm_start=None if knots is None or warm is None else ControlPlan(knots, warm),
        fields={name: _need(members, f"{at}/fields/{name}").float() for name in about["fields"]},
        skipped=about["skipped"],
        info=about["info"],
        samples=None if paths is None or costs is None else SampledPaths(lambda: paths, costs),  # older runs lack them
    )


def _get(members: Mapping[str, Any], name: str) -> Tensor | None:
    return torch.from_numpy(members[name]) if name in members else None


def _need(members: Mapping[str, Any], name: str) -> Tensor:
    return torch.from_numpy(members[name])
