"""The handle task's agent: follow the mug by all sensors at once, under a budget of time, and grasp it."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.agent import StopReason
from rumi.belief.contact_evidence import ContactPointModel, ContactSignalModel
from rumi.belief.particles import PoseBelief
from rumi.belief.reinitialise import verify
from rumi.clock import Clock
from rumi.errors import UsageError
from rumi.planning.policy import PlanRequest
from rumi.records import RunResult
from rumi.robot.tool import Tool
from rumi.seeding import split
from rumi.sim.settings import SimSettings
from rumi.task import StepResult
from rumi.tasks.grasp_primitive import GRASP_S
from rumi.tasks.grasp_table import Grasp, GraspTable
from rumi.tasks.handle.grasp import best_grasp
from rumi.tasks.handle.settings import HandleSettings, task_of
from rumi.tasks.rummage.agent import Rummager, RummageState
from rumi.tasks.rummage.build import build_rummager
from rumi.tasks.rummage.evaluation import evaluate_step, summarise
from rumi.tasks.rummage.first_belief import first_belief, seen_belief
from rumi.tasks.rummage.scenes import make_tool
from rumi.tasks.rummage.settings import preset
from rumi.weights import boltzmann
from sdf.object_model import ObjectModel
from sensors.contact_reading import ContactReading
from sensors.evidence import EvidenceSet
from sensors.observation import Observation
from sensors.semantics import Semantics

_LEAST_PLAN_S = 0.05
_MOTION_S = SimSettings().action_s + SimSettings().hold_s  # of an action


@dataclass(frozen=True, eq=False)
class HandleState(RummageState):
    """What is known after a step, and what time it is.

    Attributes:
        spent_s: on the run's clock.
        updating_s: of that, for the last update of the belief, where thinking takes what it takes.
    """

    spent_s: float = 0.0
    updating_s: float = 0.0


@dataclass(frozen=True)
class HandleResult(RunResult):
    """How a run ended.

    Attributes:
        lifted: whether the mug was.
        believed: chance of lifting it; None where it was not grasped.
        grasp: (x, y, yaw) at which the mug was taken to stand; None where it was not grasped.
        nll: (RUMI, Eq 36) after the first view and each action.
        total_nll: nll summed up over the first view and as many actions as the settings say; after the last action the
            belief stays as it is.
        total_s: on the run's clock, the grasp included.
    """

    lifted: bool = False
    believed: float | None = None
    grasp: tuple[float, float, float] | None = None
    nll: tuple[float, ...] = ()
    total_nll: float = math.nan
    total_s: float = 0.0


@dataclass(frozen=True)
class HandleAgent:
    """Follows the mug, the same with all sensors or some, live or from a log; nothing here simulates.

    Attributes:
        settings: of the run.
        rummager: whose filter counts the evidence of contact, and which plans.
        table: chance that a grasp lifts the mug, by how far off the mug is; None to grasp nothing.
        about: what a run's folder tells of the settings.
    """

    settings: HandleSettings
    rummager: Rummager
    table: GraspTable | None = None
    about: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @property
    def relies_on(self) -> str:
        """What a run takes for granted, in a line."""
        return self.rummager.relies_on

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is not measured, and may make the belief sure and wrong."""
        return self.rummager.warnings

    def begin(self, result: StepResult, *, seed: int, clock: Clock) -> HandleState:
        """Believe what the first view shows, and the prior."""
        random = {name: split(seed, name) for name in ("initialise", "filter", "renewal", "plan")}
        began = time.perf_counter()
        with clock("belief"):
            belief, memory = first_belief(self.rummager, result.reading, generator=random["initialise"])
            belief = _seen(self.rummager, belief, memory, generator=random["initialise"])
            belief = replace(belief, evidence=EvidenceSet())
        spent_s = self._thought(began)
        record = evaluate_step(self.rummager, clock, (), result, belief, memory)
        return HandleState(record, (record,), memory, random, clock, spent_s=spent_s)

    def stop(self, state: HandleState) -> StopReason | None:
        """Stop where the belief is sure, or where no time is left for a plan, its motion and the grasp."""
        if state.record.converged:
            return "sure"
        if state.record.step >= self.settings.steps:
            return "steps"
        return "budget" if self._left_s(state) < (self.settings.thinking_s or _LEAST_PLAN_S) else None

    def act(self, state: HandleState) -> tuple[HandleState, Float[Tensor, "A"]]:
        """Plan anew, and do the first part of it."""
        began, belief = time.perf_counter(), state.record.belief
        with state.clock("plan"):
            request = PlanRequest(
                belief,
                self.rummager.scene(state),
                state.plan,
                executed=min(state.record.step, 1),
                budget_s=None if self.settings.thinking_s is not None else self._left_s(state),
                generator=state.random["plan"],
            )
            plan = self.rummager.policy.act(request)
        spent_s = state.spent_s + (_MOTION_S + self._thought(began))
        return replace(state, plan=plan, spent_s=spent_s), plan.controls[0]

    def update(self, state: HandleState, control: Float[Tensor, "A"], result: StepResult) -> HandleState:
        """Take a reading in, and where that makes the belief sure, draw rivals anew beside it.

        Raises:
            UsageError: a reading of another kind of run.
        """
        began = time.perf_counter()
        rummager, settings, reading, last = self.rummager, self.settings, result.reading, state.record
        if not isinstance(reading, ContactReading) or reading.object_motion is None:
            raise UsageError(
                f"Expected readings of the handle task, with the object's motion, got a {type(reading).__name__}"
            )
        renewal, clock, generator = rummager.renewal, state.clock, state.random["renewal"]
        with clock("belief"):
            belief, memory, info = rummager.filter(last.belief, state.memory, reading, generator=state.random["filter"])
            located = last.contacts >= settings.renewals and bool(memory.of_class(Semantics.SURFACE).any())
            if bool(reading.in_contact.any()) and not located:
                belief = verify(rummager.filter, belief, memory, renewal, generator=generator)
        done = (control, state.plan, bool(info.resampled))
        record = evaluate_step(rummager, clock, state.history, result, belief, info.added, *done)
        if record.converged:
            clock.put_back(record.timings_s)
            with clock("belief"):
                belief = verify(rummager.filter, belief, memory, renewal, generator=generator)
            record = evaluate_step(rummager, clock, state.history, result, belief, info.added, *done)
        # where it is stated, it is part of the decision's time
        updating_s = self._thought(began) if settings.thinking_s is None else 0.0
        return replace(
            state,
            record=record,
            history=(*state.history, record),
            memory=memory,
            spent_s=state.spent_s + updating_s,
            updating_s=updating_s,
        )

    def last(self, state: HandleState) -> Grasp | None:
        """The best grasp of the belief."""
        belief = state.record.belief
        return None if self.table is None else best_grasp(belief.world_T_object, belief.log_weights, self.table)

    def result(self, state: HandleState, stopped_by: StopReason, outcome: bool | None) -> HandleResult:
        """How the run ended."""
        found = summarise(self.rummager, state.history, stopped_by)
        nll = tuple(math.nan if record.nll is None else record.nll for record in state.history)
        own: dict[str, Any] = {"nll": nll, "total_nll": total_nll(nll, self.settings.steps), "total_s": state.spent_s}
        grasp = None if outcome is None else self.last(state)
        if outcome is not None and grasp is not None:
            x, y, yaw = grasp.pose.tolist()
            own |= {"lifted": outcome, "believed": grasp.probability, "grasp": (x, y, yaw)}
            own["total_s"] = state.spent_s + GRASP_S
        return HandleResult(**{part.name: getattr(found, part.name) for part in fields(found)}, **own)

    def _left_s(self, state: HandleState) -> float:
        """Seconds for a plan, beside what has to come after it."""
        return self.settings.run_budget_s - state.spent_s - _MOTION_S - state.updating_s - GRASP_S

    def _thought(self, began: float) -> float:
        """Seconds on the run's clock for what was thought since."""
        return time.perf_counter() - began if self.settings.thinking_s is None else self.settings.thinking_s


def build_agent(
    settings: HandleSettings,
    *,
    cache_dir: Path | None = None,
    tool: Tool | None = None,
    model: ObjectModel | None = None,
    table: GraspTable | None = None,
) -> HandleAgent:
    """Make it of settings.

    Args:
        settings: of the run.
        cache_dir: folder that keeps the arm's reach; None works it out each time (half a minute).
        tool: made before by `make_tool`; None makes one.
        model: of the mug; None makes it.
        table: of grasps; None to grasp nothing.
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
    sensors = ", ".join(settings.sensors)
    return HandleAgent(settings, replace(rummager, filter=pose_filter, stop_rule=stop, sensors=sensors), table)


def total_nll(nll: Sequence[float], steps: int) -> float:
    """Nll summed up over the first view and `steps` actions, the last one's for those that were not needed."""
    return math.fsum(nll) + nll[-1] * max(0, steps + 1 - len(nll))


def _seen(rummager: Rummager, belief: PoseBelief, memory: Observation, *, generator: torch.Generator) -> PoseBelief:
    """All poses that a first view leaves, weighed by the prior too; the belief itself where nothing was seen."""
    if not bool(memory.of_class(Semantics.SURFACE).any()):
        return belief
    found = seen_belief(rummager, memory, generator=generator)
    total = rummager.filter.total(found, memory)
    return replace(found, discrepancy=total).reweighted(boltzmann(total, rummager.filter.settings.peakiness))
