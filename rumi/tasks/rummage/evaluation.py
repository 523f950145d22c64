"""What a belief and a run come to: what a belief expects of itself, and, apart from that, against the truth."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.agent import StopReason
from rumi.belief.particles import PoseBelief
from rumi.clock import Clock
from rumi.information.stopping import StopEvidence, converged, turns
from rumi.metrics.likelihood import negative_log_likelihood, self_agreement
from rumi.metrics.pose_error import pose_error
from rumi.planning.policy import Plan
from rumi.records import RunResult, StepRecord
from rumi.task import StepResult
from rumi.tasks.rummage.answer import relies_on, warnings, why_not
from rumi.tasks.rummage.parts import RummagerParts
from rumi.tasks.rummage.retreat import holds
from sensors.observation import Observation


def evaluate_step(
    rummager: RummagerParts,
    clock: Clock,
    history: Sequence[StepRecord],
    result: StepResult,
    belief: PoseBelief,
    added: Observation,
    control: Float[Tensor, "A"] | None = None,
    plan: Plan | None = None,
    resampled: bool = False,
) -> StepRecord:
    """Measure the belief: what it expects of itself, and, apart from that, against the truth."""
    model, sensor = rummager.model, rummager.model.surface_points
    with clock("score"):
        nll = None
        if result.truth is not None:
            truth = result.truth.to(belief.log_weights)
            nll = float(negative_log_likelihood(belief.world_T_object, belief.log_weights, truth, sensor, model.judge))
    touched = bool(result.reading.in_contact.any()) and control is not None
    contacts = (history[-1].contacts if history else 0) + touched
    fit = float(belief.discrepancy.min())
    p_right = belief.probability_right(
        model.symmetries, within_m=rummager.position_tolerance_m, within_rad=rummager.rotation_tolerance_rad
    )
    chance, ess = math.exp(rummager.filter.log_chance(belief)), float(belief.ess())
    held = rummager.retreats and bool(history) and history[-1].converged and holds(history[-1].reading)
    let_go = held and not holds(result.reading)
    best = StopEvidence(0.0, fit, 0.0, model.diagonal, contacts, p_right, chance, ess, let_go)
    with clock("agree"):
        every = turns(rummager.stop_rule, best)
        expected, apc = _agreement(rummager, history[-1] if history else None, belief, every)
    evidence = best._replace(expected_nll=expected, apc=apc)
    return StepRecord(
        step=len(history),
        control=control,
        reading=result.reading,
        added=added,
        belief=belief,
        plan=plan,
        expected_nll=expected,
        fit=fit,
        apc=apc,
        ess=ess,
        contacts=contacts,
        resampled=resampled,
        converged=converged(rummager.stop_rule, evidence),
        truth=result.truth,
        nll=nll,
        timings_s=clock.take(),
    )


def _agreement(rummager: RummagerParts, last: StepRecord | None, belief: PoseBelief, every: int) -> tuple[float, float]:
    """Expected nll and APC, each particle's by one of so many points.

    Those of the last step where the particles and their weights are still the same, and they are not to be more exact.
    """
    if (
        last is not None
        and (every > 1 or last.converged or rummager.stop_rule.rule != "probability")
        and torch.equal(last.belief.attached_T_object, belief.attached_T_object)
        and torch.equal(last.belief.log_weights, belief.log_weights)
    ):
        return last.expected_nll, last.apc
    points = rummager.model.surface_points
    stride = max(1, len(points) // rummager.agreement_points)
    agreement = self_agreement(belief, points[::stride], rummager.model.sdf, nll_points=len(points), every=every)
    return float(agreement.expected_nll), float(agreement.apc)


def summarise(
    rummager: RummagerParts, history: Sequence[StepRecord], stopped_by: StopReason, doubt: str | None = None
) -> RunResult:
    """How the run ended, from its records, and what speaks against being sure."""
    records, last = history, history[-1]
    nll = [r.nll for r in records if r.nll is not None]
    errors: tuple[float, float] | None = None
    if last.truth is not None:
        metres, radians = pose_error(
            last.belief.mode(), last.truth.to(last.belief.log_weights), rummager.model.symmetries
        )
        errors = float(metres), float(radians)
    timings: dict[str, float] = {}
    for record in records:
        for stage, seconds in record.timings_s.items():
            timings[stage] = timings.get(stage, 0.0) + seconds
    wrong_by = _wrong_by(rummager, nll[-1], errors) if nll and errors is not None else None
    pose = last.belief.summary(
        rummager.model.symmetries, within_m=rummager.position_tolerance_m, within_rad=rummager.rotation_tolerance_rad
    )
    return RunResult(
        right=not wrong_by if nll and errors is not None else None,
        paper_success=min(nll) <= rummager.nll_threshold if nll else None,
        paper_success_at_start=nll[0] <= rummager.nll_threshold if nll else None,
        min_nll=min(nll) if nll else None,
        final_nll=nll[-1] if nll else None,
        cumulative_nll=sum(nll) if nll else None,
        steps=last.step,
        stopped_by=stopped_by,
        apc=last.apc,
        expected_nll=last.expected_nll,
        position_error_mm=errors[0] * 1e3 if errors else None,
        rotation_error_deg=errors[1] * 180.0 / torch.pi if errors else None,
        contacts=last.contacts,
        clipped=sum(float(r.reading.clipped) > 1e-4 for r in records),
        timings_s=timings,
        belief=last.belief,
        pose=pose,
        why_not=why_not(rummager, last, pose, stopped_by, doubt),
        wrong_by=wrong_by,
        relies_on=relies_on(rummager),
        warnings=warnings(rummager, history),
        remarks=tuple(remark for record in records for remark in record.remarks),
    )


def _wrong_by(rummager: RummagerParts, nll: float, errors: tuple[float, float]) -> str | None:
    """What is not within the task's tolerances; None where all is."""
    metres, radians = errors
    said = (
        (nll <= rummager.nll_threshold, f"nll {nll:.1f} above {rummager.nll_threshold:g}"),
        (metres <= rummager.position_tolerance_m, f"place beyond {1e3 * rummager.position_tolerance_m:g} mm"),
        (
            radians <= rummager.rotation_tolerance_rad,
            f"turn beyond {math.degrees(rummager.rotation_tolerance_rad):.3g} degrees",
        ),
    )
    return ", ".join(words for holds, words in said if not holds) or None
