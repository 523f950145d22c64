"""Rummaging's agent: believe, plan a path of much information that stays in reach, follow it, until sure."""

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.agent import StopReason
from rumi.belief.frictions import frictions_of
from rumi.belief.reinitialise import redraw, verify
from rumi.belief.remarks import Remark, remarks
from rumi.belief.replicates import pooled
from rumi.clock import Clock
from rumi.dynamics.outline import Base, base_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import PushedBody
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.records import RunResult, StepRecord
from rumi.seeding import split
from rumi.task import StepResult
from rumi.tasks.rummage.answer import relies_on, warnings
from rumi.tasks.rummage.approach import shortened
from rumi.tasks.rummage.evaluation import evaluate_step, summarise
from rumi.tasks.rummage.fault_state import Watch
from rumi.tasks.rummage.first_belief import first_belief
from rumi.tasks.rummage.last_word import last_word
from rumi.tasks.rummage.learnt_pushes import learnt_pushes
from rumi.tasks.rummage.lost import SLIDES, sensed_now, told, unseated, watch
from rumi.tasks.rummage.parts import RummagerParts
from rumi.tasks.rummage.recovery import searched_again
from rumi.tasks.rummage.retreat import holds, leans, way_back
from sensors.observation import Observation
from sensors.reading import Reading

_PADS_M = 0.004  # between the points of the pads by which remarks tell where they feel
_STREAMS = ("initialise", "filter", "plan", "renewal", "warm_up", "lost", "faults", "pushes")  # of random, by use
_TOLD = ("measured", "corrected", "estimated")  # motions that tell of the push, not of the push model
_RETREATS = 4  # on end: a pad that is stuck feels wherever it is
_HOLDS = "the tool touches the object, which may lean on it"
_ONCE = "it was sure, and no further touch has borne that out"
_PARTS = 8  # of an action, in which its free path is worked out again


@dataclass(frozen=True, eq=False)
class RummageState:
    """What is known after a step.

    Attributes:
        record: of the step, with the belief and the reading.
        history: the records of all steps, this one last.
        memory: points so far, in the frame that rides with the object.
        random: streams, by what is drawn.
        clock: takes the time of each stage.
        plan: that is being followed.
        executed: controls of it that were carried out.
        surprised: whether the reading calls for a new plan.
        retreated: actions on end, the last one among them, that took the tool back from the object.
        watch: for faults.
        pushes: what was learnt of how the object slides; None where that is fixed.
    """

    record: StepRecord
    history: tuple[StepRecord, ...]
    memory: Observation
    random: Mapping[str, torch.Generator]
    clock: Clock
    plan: Plan | None = None
    executed: int = 0
    surprised: bool = False
    retreated: int = 0
    watch: Watch = field(default_factory=Watch)
    pushes: PushPosterior | None = None


@dataclass(frozen=True)
class Rummager(RummagerParts):
    """The agent of RUMI (Alg 1): redraws, replans and stops as its settings say; it holds no state."""

    def begin(self, result: StepResult | Reading, *, seed: int, clock: Clock) -> RummageState:
        """Believe what the first view shows (Alg 1, lines 1-3)."""
        result = StepResult.of(result)
        random = {name: split(seed, name) for name in _STREAMS}
        with clock("belief"):
            belief, memory = first_belief(self, result.reading, generator=random["initialise"])
        record = evaluate_step(self, clock, (), result, belief, memory)
        return RummageState(record, (record,), memory, random, clock, pushes=self.pushes)

    def stop(self, state: RummageState) -> StopReason | None:
        """Stop where the belief is sure and nothing speaks for a fault, or after as many actions as there may be.

        An object that may lean on the tool is let go of first: what leans is elsewhere once it stands. Where the object
        may have tipped, and nothing but touches tell, there is nothing to do about it.
        """
        if state.watch.doubt() is None and self._borne_out(state.history) and not self._lets_go(state):
            return "sure"
        if state.record.converged and state.watch.unseated == "tips":
            return "nothing to do"
        return "steps" if self.steps is not None and state.record.step >= self.steps else None

    def act(self, state: RummageState) -> tuple[RummageState, Float[Tensor, "A"]]:
        """Follow the plan, or one made anew: a contact is not where the plan had it.

        With a budget a plan is made first that nobody follows, since the first one of a process loads compiled code.
        What leans on the tool is let back first, once, without a plan; and what may, before the run ends.
        """
        plan, executed = state.plan, state.executed
        leant_on = self.retreats and not state.retreated and leans(self.filter, state.record.belief)
        if leant_on or self._lets_go(state):
            back = self._way_back(state)
            if back is not None:
                return replace(state, plan=None, executed=0, retreated=state.retreated + 1), back
        if plan is None or state.surprised or executed >= min(self.replan_every, len(plan.controls)):
            belief, scene, random = state.record.belief, self.scene(state), state.random
            if self.budget_s is not None and state.record.step == 0:
                with state.clock("warm_up"):
                    self.policy.act(PlanRequest(belief, scene, budget_s=0.0, generator=random["warm_up"]))
            with state.clock("plan"):
                plan = self.policy.act(
                    PlanRequest(
                        belief, scene, plan, executed=executed, budget_s=self.budget_s, generator=random["plan"]
                    )
                )
            executed = 0
        control = plan.controls[executed]
        if self.approach_m > 0:
            here, belief = state.record.reading.configuration, state.record.belief
            with state.clock("plan"):
                control = shortened(control, self.tool, here, belief, self.model.sdf, self.approach_m)
        return replace(state, plan=plan, executed=executed, retreated=0), control

    def update(self, state: RummageState, control: Float[Tensor, "A"], result: StepResult | Reading) -> RummageState:
        """Take a reading in; after the first touch, and where sure, draw poses anew that might fit as well."""
        result = StepResult.of(result)
        last, clock, random = state.record, state.clock, state.random
        touched = bool(result.reading.in_contact.any())
        unseen, pose_filter = self.filter.prior is not None, state.watch.following or self.filter
        with clock("belief"):
            belief, memory, info = pose_filter(last.belief, state.memory, result.reading, generator=random["filter"])
            if unseen and self.renewal.at_contact and last.contacts == 0 and touched:
                belief = redraw(self.filter, belief, memory, self.renewal, generator=random["renewal"])
        done = (control, state.plan, bool(info.resampled))
        record = evaluate_step(self, clock, state.history, result, belief, info.added, *done)
        if record.converged:
            with clock("belief"):
                pool = pooled(pose_filter, last.belief, result.reading, belief, generator=random["filter"])
                if unseen and self.renewal.challenge:
                    pool = verify(self.filter, pool, memory, self.renewal, generator=random["renewal"])
            if pool is not belief:
                belief = pool
                clock.put_back(record.timings_s)
                record = evaluate_step(self, clock, state.history, result, belief, info.added, *done)
        now, alarm = state.watch, None
        if self.remarks:
            said = {remark.name for step in state.history for remark in step.remarks}
            odd = self._odd(state, control, record, said)
            record = replace(record, remarks=tuple(remark for remark in odd if remark.name not in said))
            now, alarm = watch(
                state.watch,
                last,
                record,
                pose_filter,
                self.model,
                self.misfit,
                generator=random["faults"],
                history=state.history,
                looks_again=self.looks_again,
            )
            unknown = result.reading.object_motion is None and not self.looks_again
            if self.upright and unknown and self.filter.settings.motion in SLIDES and self.misfit.alpha > 0:
                now = replace(now, unseated=unseated(state.watch.unseated, odd, touched))
            record = told(record, now, alarm)
        if now.set_aside or (alarm is not None and (not now.lost or now.unfelt_since is not None)):
            with clock("belief"):
                steps = (*state.history, record)
                belief, memory = searched_again(
                    steps, memory, pose_filter, self.misfit, now, before=state.memory, generator=random["lost"]
                )
            again = evaluate_step(self, clock, state.history, result, belief, info.added, *done)
            timings = {stage: record.timings_s.get(stage, 0.0) + s for stage, s in again.timings_s.items()}
            record = replace(told(again, now), remarks=record.remarks, timings_s=record.timings_s | timings)
        history, pushes = (*state.history, record), state.pushes
        if self.pushes is not None and touched and self.filter.settings.motion in _TOLD:
            with clock("pushes"):
                pushes = learnt_pushes(self.pushes, history, self._body, generator=random["pushes"])
        after = replace(
            state,
            record=record,
            history=history,
            memory=memory,
            executed=state.executed + 1,
            surprised=bool(info.moved) or touched or alarm is not None,
            watch=now,
            pushes=pushes,
        )
        if self.remarks and record.step == self.steps and self.stop(after) == "steps":
            now, record = last_word(now, record, self.filter, self.misfit)
            after = replace(after, record=record, history=(*state.history, record), watch=now)
        return after

    def _borne_out(self, history: Sequence[StepRecord]) -> bool:
        """Whether the belief is sure, and has stayed so through as many further touches as the stop rule asks for."""
        sure = list(itertools.takewhile(lambda step: step.converged, reversed(history)))
        further = sum(bool(step.reading.in_contact.any()) for step in sure[:-1])
        return bool(sure) and further >= (self.stop_rule.further or 0)

    def _lets_go(self, state: RummageState) -> bool:
        """Whether the belief is sure of an object that may lean on the tool, and there is a way to let go of it."""
        sure = self.retreats and state.record.converged and state.retreated < _RETREATS
        return sure and holds(state.record.reading) and self._way_back(state) is not None

    def _way_back(self, state: RummageState) -> Float[Tensor, "A"] | None:
        return way_back([step.reading for step in state.history], self.tool.scale)

    def _odd(
        self, state: RummageState, control: Float[Tensor, "A"], record: StepRecord, said: set[str]
    ) -> tuple[Remark, ...]:
        """What the action told that is at odds with the belief."""
        start, moved = state.record.reading.configuration, None
        if bool(control.any()):  # a recording may not tell where the tool was to go
            moved = start, self.tool.free_path(start, control[None].clamp(-1.0, 1.0), _PARTS)[-1]
        return remarks(
            record.step,
            record.reading,
            record.belief,
            sensed_now(record, self.filter.settings.motion),
            self.model,
            moved=moved,
            upright=self.upright,
            pads=None if self.filter.settings.trajectories.lone else self._pads,
            base=self._base if self.upright else None,
            frictions=frictions_of(record.belief, self.filter.settings.trajectories) if self.upright else None,
            body=self._body if self.upright and not self.tool.spatial else None,
            before=said,
        )

    @functools.cached_property
    def _pads(self) -> Float[Tensor, "P 3"]:
        """Points of the pads, tool frame."""
        return self.tool.shape.pad_shell(_PADS_M)

    @functools.cached_property
    def _body(self) -> PushedBody:
        """The object and the tool, at its height."""
        return PushedBody.of(self.model.sdf, self.tool.height_m - self.height_m, self.tool.shape)

    @functools.cached_property
    def _base(self) -> Base:
        """What the object stands on."""
        return base_of(self.model.sdf)

    def last(self, state: RummageState) -> None:
        """Nothing is done at the end."""

    def result(self, state: RummageState, stopped_by: StopReason, outcome: object) -> RunResult:
        """How the run ended."""
        doubt = state.watch.doubt() or (_HOLDS if self._lets_go(state) else None)
        if doubt is None and state.record.converged and not self._borne_out(state.history):
            doubt = _ONCE
        ended = summarise(self, state.history, stopped_by, doubt)
        return replace(ended, lost=state.watch.lost, explanations=dict(state.watch.explanations))

    @property
    def relies_on(self) -> str:
        """What a run takes for granted, in a line."""
        return relies_on(self)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is not measured, and may make the belief sure and wrong."""
        return warnings(self)

    def scene(self, state: RummageState) -> Scene:
        """What a plan has to know beside the belief."""
        reading = state.record.reading
        return Scene(
            self.model,
            self.workspace,
            self.tool,
            reading.configuration,
            observed=state.memory,
            reading=reading,
            pushes=state.pushes,
        )
