"""What a run leaves behind: one record a step, one result at the end."""

from dataclasses import dataclass, field, fields
from typing import Any

from jaxtyping import Float
from torch import Tensor

from rumi.agent import StopReason
from rumi.belief.particles import PoseBelief
from rumi.belief.remarks import Remark
from rumi.planning.policy import Plan
from rumi.registration.pose_summary import PoseSummary
from sensors.observation import Observation
from sensors.reading import Reading


@dataclass(frozen=True)
class StepRecord:
    """The state after one action; step 0 is the first view.

    Attributes:
        step: number of actions carried out so far.
        control: (A,) the action that led here, None at step 0.
        reading: what the sensors reported.
        added: the points that were new to the memory (object-attached frame).
        belief: after the update.
        plan: the plan that the action came from, None at step 0.
        expected_nll: the nll that the belief expects of itself.
        fit: least discrepancy of a particle.
        apc: average pairwise chamfer distance, metres (RUMI, Eq 33).
        ess: effective sample size.
        contacts: number of actions so far that touched the object.
        resampled: whether the filter resampled here.
        converged: whether the stopping rule held here.
        truth: (4, 4) true world_T_object, None where unknown.
        nll: negative log-likelihood of the true surface (RUMI, Eq 36), None where the truth is unknown.
        timings_s: seconds by stage of this step.
        remarks: what is odd about it and was not so before.
        lost: evidence against "no fault so far", nats (`rumi.belief.change_test`).
        p_value: of the reading under the belief, an upper bound: the inverse of its own evidence for any fault.
        explanations: probability of "no fault" and of each fault (`rumi.tasks.rummage.lost`); those of the last alarm
            from it on, at the end those of a last word; none where nothing is asked.
    """

    step: int
    control: Float[Tensor, "A"] | None
    reading: Reading
    added: Observation
    belief: PoseBelief
    plan: Plan | None
    expected_nll: float
    fit: float
    apc: float
    ess: float
    contacts: int
    resampled: bool = False
    converged: bool = False
    truth: Float[Tensor, "4 4"] | None = None
    nll: float | None = None
    timings_s: dict[str, float] = field(default_factory=dict)
    remarks: tuple[Remark, ...] = ()
    lost: float = 0.0
    p_value: float = 1.0
    explanations: dict[str, float] = field(default_factory=dict)

    @property
    def stamp(self) -> float:
        """Seconds since the start of the run."""
        return float(self.reading.stamp)

    @property
    def poses(self) -> tuple[Float[Tensor, "P 4 4"], Float[Tensor, "P"]]:
        """The belief's particles, world_T_object and log-weights."""
        return self.belief.world_T_object, self.belief.log_weights


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """How a run ended; figures that need the truth are None without it.

    Attributes:
        right: at the stop, nll within the task's threshold and the best mode within its pose tolerance.
        paper_success: nll within the threshold at any step, as the paper counts.
        paper_success_at_start: the same at step 0, before anything was touched.
        min_nll, final_nll, cumulative_nll: over the steps 0..steps.
        steps: actions carried out.
        stopped_by: why it ended.
        apc: at the end, metres.
        expected_nll: at the end.
        position_error_mm, rotation_error_deg: of the best-weighted mode, modulo the declared symmetries.
        contacts: actions that touched the object.
        clipped: actions whose command the reach refused in part.
        timings_s: seconds by stage, in all.
        belief: at the end; not in `as_dict`.
        pose: what it knows of the object's pose.
        why_not: why it is not sure; None where it is.
        wrong_by: what of it is not right, by the truth; None where all is, or nobody knows.
        relies_on: what the run took for granted.
        warnings: what was not measured, and may have made the belief sure and wrong.
        remarks: what was odd, in the order of the steps.
        lost: whether no pose that was believed fitted, and the object was not searched for again.
        explanations: probability of "no fault" and of each fault, at the last alarm or else at the end.
    """

    right: bool | None = None
    paper_success: bool | None = None
    paper_success_at_start: bool | None = None
    min_nll: float | None = None
    final_nll: float | None = None
    cumulative_nll: float | None = None
    steps: int
    stopped_by: StopReason
    apc: float
    expected_nll: float
    position_error_mm: float | None = None
    rotation_error_deg: float | None = None
    contacts: int
    clipped: int
    timings_s: dict[str, float] = field(default_factory=dict)
    belief: PoseBelief | None = field(default=None, repr=False, compare=False)
    pose: PoseSummary | None = field(default=None, compare=False)
    why_not: str | None = None
    wrong_by: str | None = None
    relies_on: str = ""
    warnings: tuple[str, ...] = ()
    remarks: tuple[Remark, ...] = ()
    lost: bool = False
    explanations: dict[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        values = {part.name: getattr(self, part.name) for part in fields(self) if part.name != "belief"}
        return values | {"pose": None if self.pose is None else self.pose.as_dict()}
