"""The peg task's agent: lanes until the first touch, then touches that tell most, until the holes are known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.agent import Parts, StopReason
from rumi.belief.static_filter import ResampleMoveFilter, StaticBelief
from rumi.clock import Clock, SimulatedClock
from rumi.information.contact_gain import ContactKind
from rumi.information.state_rules import TargetEstimate
from rumi.seeding import split
from rumi.sim.fault import Fault
from rumi.task import StepResult
from rumi.tasks.peg.cell import Felt, TimedPath
from rumi.tasks.peg.records import RELIES_ON, PegRun, PegStep
from rumi.tasks.peg.search import Found, joined, lanes, start, taken_in
from rumi.tasks.peg.selection import Chooser, Thought, aim_of, block_filter, confirmed, evidence_of, sure, updated
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.peg.simulated import Insertion, PegTask
from sensors.touch.rectangle_touch import RectangleTouches


@dataclass(frozen=True, eq=False)
class PegState:
    """What is known after a step.

    Attributes:
        record: of the step.
        history: the records of all steps, this one last.
        now_s: on the run's clock.
        found: what the search has felt, with its belief.
        every: evidence of all readings, as of a rectangle; None while nothing was met.
        decisions: of the second stage, the last of which may have led to nothing.
        chooser: makes them, and learns how long that takes.
        random: of the belief.
        clock: takes the time of each stage.
    """

    record: PegStep
    history: tuple[PegStep, ...]
    now_s: float
    found: Found
    every: RectangleTouches | None
    decisions: tuple[Thought, ...]
    chooser: Chooser
    random: torch.Generator
    clock: Clock


@dataclass(frozen=True)
class PegAgent:
    """Finds the block, then its holes, on a clock that thinking and motion take time of.

    Attributes:
        settings: of the task and the robot.
        about: what a run's folder tells of the settings.
    """

    settings: PegSettings
    about: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @property
    def relies_on(self) -> str:
        """What a run takes for granted, in a line."""
        return RELIES_ON

    @cached_property
    def _filter(self) -> ResampleMoveFilter:
        return block_filter(self.settings)

    def begin(self, result: StepResult, *, seed: int, clock: Clock) -> PegState:
        """Believe that the block may be anywhere on the table's part."""
        assert result.truth is not None
        draws, felt = split(seed, "belief"), result.reading
        with clock("belief"):
            found = start(self.settings, generator=draws)
        chooser = Chooser(self.settings, SimulatedClock(felt.ended_s), split(seed, "choice"), [])
        record = PegStep(0, None, felt, found.belief, None, None, False, result.truth, clock.take())
        return PegState(record, (record,), felt.ended_s, found, None, (), chooser, draws, clock)

    def stop(self, state: PegState) -> StopReason | None:
        """Stop where the holes are known, or after so many touches."""
        if state.record.sure:
            return "sure"
        done = state.record.step - len(state.found.felt)
        return "steps" if state.every is not None and done >= self.settings.most_actions else None

    def act(self, state: PegState) -> tuple[PegState, TimedPath | None]:
        """The next lane, an open-loop action that needs no thinking (time allocation, IV-B); then what tells most.

        None where nothing was met on all lanes, or no motion is worth it.
        """
        tip, belief = state.record.felt.tip, state.record.belief
        if state.every is None:
            corners = lanes(self.settings)[1 + len(state.found.felt) :]
            if not len(corners):
                return state, None
            return state, TimedPath(torch.stack((tip, torch.cat((corners[0], tip[2:])))), state.now_s)
        chooser = replace(state.chooser, clock=SimulatedClock(state.now_s))
        with state.clock("plan"):
            thought = chooser.choose(belief, tip, _away(state.record.felt))
        state = replace(state, chooser=chooser, decisions=(*state.decisions, thought), now_s=chooser.clock())
        choice = thought.selection.candidate
        return state, None if choice is None else TimedPath(choice.action.path, state.now_s)

    def update(self, state: PegState, action: TimedPath, result: StepResult) -> PegState:
        """Take a motion's reading in; the first touch ends the search."""
        assert result.truth is not None
        own, felt, draws = self.settings, result.reading, state.random
        found, every, aim, probability, held = state.found, state.every, None, None, False
        now = SimulatedClock(felt.ended_s)
        with state.clock("belief"):
            if every is None:
                found = taken_in(found, felt, own, generator=draws)
                belief = found.belief
                now.advance(own.update_s)
                if felt.kind != ContactKind.NOTHING:
                    every = RectangleTouches.none(own.block.half(), own.noise, own.radius_m)
                    for one in found.felt:
                        every = every.joined(evidence_of(one, own))
                    belief = joined(found, self._filter, every, own, generator=draws)
            else:
                new = evidence_of(felt, own)
                every = every.joined(new)
                belief = updated(self._filter, state.record.belief, new, every, own, generator=draws)
                now.advance(own.update_s)
            if every is not None:
                aim = aim_of(belief, own)
                probability = aim.probability
                held = sure(belief, every, aim, own)
                if held and own.stop == "mass":
                    belief, aim = confirmed(belief, every, aim, own, generator=draws)
                    held = sure(belief, every, aim, own)
        thought = state.decisions[-1] if state.every is not None and state.decisions else None
        record = PegStep(
            state.record.step + 1, thought, felt, belief, aim, probability, held, result.truth, state.clock.take()
        )
        return replace(state, record=record, history=(*state.history, record), now_s=now(), found=found, every=every)

    def last(self, state: PegState) -> TimedPath | None:
        """Put the peg into the hole that is more probably where it is thought to be."""
        belief, aim, tip = state.record.belief, state.record.aim, state.record.felt.tip
        if aim is None:
            return None
        place = _better_hole(belief, aim, self.settings)
        lift = place.new_tensor([self.settings.lift_m])
        over = torch.stack((tip, torch.cat((tip[:2], lift)), torch.cat((place, lift))))
        return TimedPath(over, state.now_s)

    def result(self, state: PegState, stopped_by: StopReason, outcome: Insertion | None) -> PegRun:
        """How the run ended."""
        total_s = state.now_s if outcome is None else outcome.ended_s
        return PegRun(self.settings, state.history, state.decisions, stopped_by, outcome, total_s)


def build_peg(settings: PegSettings, faults: Sequence[Fault] = ()) -> Parts[PegTask, PegAgent]:
    """The cell and its agent."""
    return Parts(PegTask(settings, faults), PegAgent(settings))


def _away(felt: Felt) -> Float[Tensor, "2"] | None:
    """Normal of the side that the ball rests against."""
    return felt.normal if felt.kind == ContactKind.TOUCH else None


def _better_hole(belief: StaticBelief, aim: TargetEstimate, settings: PegSettings) -> Float[Tensor, "2"]:
    """The hole that is more probably where it is thought to be."""
    holes = settings.block.holes(belief.states)
    near = (holes[:, None] - aim.points[:, None]).norm(dim=-1).amin(-1) < settings.tolerance_m
    return aim.points[(near.to(holes) * belief.log_weights.exp()[:, None]).sum(0).argmax()]
