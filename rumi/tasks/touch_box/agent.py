"""Touch alone: belief, choice of a poke, filter, until a grasp is likely to succeed."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.agent import StopReason
from rumi.belief.prior import PlanarPrior
from rumi.belief.trajectory_belief import TouchAction, TrajectoryBelief
from rumi.belief.trajectory_filter import TrajectoryFilter, TrajectorySettings
from rumi.clock import Clock
from rumi.dynamics.along_path import PathPush, push_along_path
from rumi.dynamics.sliding import Sliding
from rumi.information.entropy import SharedSupport
from rumi.information.neighbours import StateMetric, unique_states
from rumi.resampling import resample_systematic
from rumi.seeding import split
from rumi.task import StepResult
from rumi.tasks.grasp_table import Grasp, GraspTable, best_grasp
from rumi.tasks.touch_box.candidates import pokes
from rumi.tasks.touch_box.records import TouchRun, TouchStep
from rumi.tasks.touch_box.robot import Poke, Touched, TouchRobot
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.selection import Choice, Rollouts, Weighing, choose, expects_contact
from rumi.tasks.touch_box.settings import TouchSettings
from sensors.touch.contact_model import ContactModel

_DRAWS = 4  # rounds of candidates, until enough can be followed
_SUBSTEP_M = 0.0025  # motion of the tool at most, from one contact problem to the next
_BINARY_M = 2e-4  # up to which a step of a likelihood takes tool and object to touch
_TOUCH_M = 5e-4  # distance at which a particle counts as touched


@dataclass(frozen=True, eq=False)
class TouchState:
    """What is known after a step.

    Attributes:
        record: of the step.
        history: the records of all steps, this one last.
        belief: with how the box slides.
        actions: what was done and felt.
        random: streams, by what is drawn.
        clock: takes the time of each stage.
        candidates, choice: of the poke that is being carried out.
    """

    record: TouchStep
    history: tuple[TouchStep, ...]
    belief: TrajectoryBelief
    actions: tuple[TouchAction, ...]
    random: Mapping[str, torch.Generator]
    clock: Clock
    candidates: Float[Tensor, "C K1 3"] | None = None
    choice: Choice | None = None


@runtime_checkable
class Decide(Protocol):
    """Chooses among pokes."""

    def __call__(
        self, belief: TrajectoryBelief, *, generator: torch.Generator
    ) -> tuple[Float[Tensor, "C K1 3"], Choice]:
        """Candidates and the choice among them."""
        ...


class Toucher:
    """The agent that finds the box: filter, pokes, their choice, the grasp.

    Args:
        task: what is known of the scene.
        settings: of all of it.
        robot: that pokes; of it the tool's footprint and which paths it can follow are asked.
        table: of grasps' success.
        carrier: how a tool moves boxes; by the settings' push model if None.

    Attributes:
        about: what a run's folder tells of the settings.
        chooser: chooses among pokes; `decide`, or another such as `rumi.tasks.touch_box.budget.BudgetedChoice`.
    """

    def __init__(
        self,
        task: TouchTask,
        settings: TouchSettings,
        robot: TouchRobot,
        table: GraspTable,
        carrier: PathPush | None = None,
    ) -> None:
        self.task, self.settings, self.robot, self.table = task, settings, robot, table
        self.carrier = carrier or push_along_path
        self.chooser: Decide = self.decide
        self.about: Mapping[str, Any] = {}
        rates = getattr(robot, "rates", task.rates)
        model = ContactModel(rates[0], rates[1], settings.decay, tolerance=_BINARY_M)
        centre = torch.zeros(2, dtype=torch.float64)
        substeps = max(settings.filter.substeps, math.ceil(task.spacing_m / _SUBSTEP_M - 1e-9))
        own = replace(for_task(settings.filter, task), substeps=substeps)
        if settings.weigh_correlated:
            repeats = getattr(robot, "correlation", task.correlation)
            own = replace(own, temper=own.temper * (1.0 - repeats) / (1.0 + repeats))
        self.filter = TrajectoryFilter(task.outline, centre, robot.pusher, model, task.prior, own, carrier=self.carrier)
        self.hold = max(1, round(settings.poke.hold_m / task.spacing_m))
        self.support = SharedSupport(StateMetric.planar(0.06), settings.poke.neighbours, floor=1e-4)

    @property
    def relies_on(self) -> str:
        """What a run takes for granted, in a line."""
        motion = f"not measured, taken from the push model {self.settings.push_model} with noise"
        return f"motion: {motion}; reach: of the robot; push model: {self.settings.push_model}; sensors: binary contact"

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is not measured, and may make the belief sure and wrong."""
        return (
            f"the box's motion is not measured, but taken from the push model {self.settings.push_model}: the belief "
            "may end sure and wrong (96 of 100 runs on record lifted the box: scripts/docs/results/touch_box.md)",
        )

    def candidates(self, belief: TrajectoryBelief, *, generator: torch.Generator) -> Float[Tensor, "C K1 3"]:
        """Pokes that the robot can follow; some that it cannot where there are too few others."""
        task, own = self.task, self.settings.poke
        found: list[Tensor] = []
        able = 0
        for _ in range(_DRAWS):
            drawn = pokes(
                belief.pose[0],
                belief.log_weights[0],
                task.outline,
                task.half,
                self.robot.pusher,
                own.candidates,
                length_m=task.spacing_m * task.readings,
                readings=task.readings,
                bend=own.bend,
                generator=generator,
            )
            can = self.robot.feasible(drawn)
            found = [drawn[can], *found, drawn[~can]]  # those that it can follow come first
            able += int(can.sum())
            if able >= own.candidates:
                break
        return torch.cat(found)[: own.candidates]

    def rollouts(
        self, belief: TrajectoryBelief, paths: Float[Tensor, "C K1 3"], rows: Tensor
    ) -> tuple[Rollouts, Float[Tensor, "C T N"]]:
        """What candidates do to some particles, and how far the tool then is from each."""
        poses = belief.pose[0, rows]
        count, number = len(paths), len(rows)
        sliding = Sliding(torch.zeros(number, 2, dtype=poses.dtype), belief.lever[0, rows], belief.friction[0, rows])
        own = self.filter.settings
        carried = self.carrier(
            poses.repeat(count, 1),
            paths.repeat_interleave(number, 0),
            self.robot.pusher,
            self.task.outline,
            sliding.map(lambda part: part.repeat(count, *[1] * (part.ndim - 1))),
            substeps=own.substeps,
            passes=own.passes,
        )
        distance = carried.distance.view(count, number, -1).transpose(1, 2)
        track = carried.track.view(count, number, -1, 3).transpose(1, 2)
        states = torch.cat((poses.expand(count, 1, number, 3), track), 1)
        even = poses.new_zeros(number).log_softmax(-1)
        return Rollouts(states, self.filter.model(distance), distance <= _TOUCH_M, even), distance

    def decide(self, belief: TrajectoryBelief, *, generator: torch.Generator) -> tuple[Float[Tensor, "C K1 3"], Choice]:
        """Weigh candidates over some particles, drawn by weight."""
        own = self.settings.poke
        paths = self.candidates(belief, generator=generator)
        drawn = resample_systematic(belief.log_weights[0], generator=generator)
        rows = drawn[torch.linspace(0, len(drawn) - 1, own.particles).round().long()]
        alone = self.settings.method == "ml-observation"
        if alone:  # rolled out beside the others, whose weights leave it out
            rows = torch.cat((rows, rows.new_tensor([likeliest(belief, self.task.prior, self.support.metric)])))
        rollouts, _ = self.rollouts(belief, paths, rows)
        if alone:
            even = rollouts.log_weights.new_zeros(own.particles).log_softmax(-1)
            rollouts = rollouts._replace(
                log_weights=torch.nn.functional.pad(even, (0, 1), value=-math.inf), likeliest=own.particles
            )
        given = Weighing(rollouts, self.support, generator, self.hold, own.samples, own.every)
        return paths, choose(self.settings.method, given, funnel=own.funnel)

    def watch(self, belief: TrajectoryBelief, path: Float[Tensor, "K1 3"]) -> Callable[[Touched], bool]:
        """Whether to go on with a poke, asked after each reading: until the belief expects contact to have lasted.

        The particles are rolled along the path once; readings change their weights alone.
        """
        own = self.settings.poke
        rows = torch.arange(belief.pose.shape[1])
        rollouts, distance = self.rollouts(belief, path[None], rows)
        touching = rollouts.touching[0]
        log = [belief.log_weights[0]]

        def go_on(touched: Touched) -> bool:
            done = len(touched.contact)
            if len(log) <= done:  # once for every reading
                signal = touched.contact[-1]
                gained = self.filter.model.log_likelihood(distance[0, done - 1], signal)
                log.append(log[-1] + self.filter.settings.temper * gained)
            return float(expects_contact(touching[:done], log[-1], self.hold)[-1]) <= own.sure

        return go_on

    def grasp(self, belief: TrajectoryBelief) -> Grasp:
        """The best grasp of a belief."""
        return best_grasp(belief.pose[0], belief.log_weights[0], self.table)

    def begin(self, result: StepResult, *, seed: int, clock: Clock) -> TouchState:
        """Believe the prior: before the first poke nothing is felt."""
        random = {name: split(seed, name) for name in ("initial", "filter", "plan")}
        with clock("filter"):
            belief = self.filter.initial(1, self.settings.count, generator=random["initial"])
        record = self._record(0, belief, result, clock)
        return TouchState(record, (record,), belief, (), random, clock)

    def stop(self, state: TouchState) -> StopReason | None:
        """Stop where a grasp is likely enough to succeed, or after enough pokes."""
        if state.record.sure:
            return "sure"
        return "steps" if state.record.step >= self.settings.actions else None

    def act(self, state: TouchState) -> tuple[TouchState, Poke]:
        """The best poke, and until when to go on with it."""
        with state.clock("plan"):
            paths, choice = self.chooser(state.belief, generator=state.random["plan"])
            path = paths[choice.best, : int(choice.steps[choice.best]) + 1]
        with state.clock("watch"):
            go_on = self.watch(state.belief, path) if self.settings.stop_early else _always
        return replace(state, candidates=paths, choice=choice), Poke(path, go_on)

    def update(self, state: TouchState, action: object, result: StepResult) -> TouchState:
        """Take in what was done and felt."""
        touched: Touched = result.reading
        with state.clock("filter"):
            actions = (*state.actions, TouchAction(touched.path, touched.contact, touched.blocked))
            belief, _ = self.filter.step(state.belief, actions, generator=state.random["filter"])
        chosen = (state.candidates, state.choice)
        record = self._record(state.record.step + 1, belief, result, state.clock, *chosen)
        return replace(state, record=record, history=(*state.history, record), belief=belief, actions=actions)

    def last(self, state: TouchState) -> Grasp:
        """The best grasp."""
        return state.record.grasp

    def result(self, state: TouchState, stopped_by: StopReason, outcome: bool | None) -> TouchRun:
        """How the run ended."""
        return TouchRun(state.history, stopped_by, outcome, self.relies_on, self.warnings)

    def _record(
        self,
        step: int,
        belief: TrajectoryBelief,
        result: StepResult,
        clock: Clock,
        candidates: Tensor | None = None,
        choice: Choice | None = None,
    ) -> TouchStep:
        with clock("grasp"):
            grasp = self.grasp(belief)
        sure = not grasp.probability < self.settings.threshold
        kept = (belief.pose[0], belief.log_weights[0])
        assert result.truth is not None
        return TouchStep(step, candidates, choice, result.reading, kept, grasp, sure, result.truth, clock.take())


def for_task(settings: TrajectorySettings, task: TouchTask) -> TrajectorySettings:
    """The filter's priors, which settings give for the default task's box, for that of another task.

    The limit surface's range goes by the lever of even pressure; the tool's friction keeps its place relative to the
    task's range.
    """
    usual, (low, high) = TouchTask(), task.friction
    ratio = task.even_lever_m / usual.even_lever_m
    least, most = (ratio * end for end in settings.lever_m)
    friction = settings.friction
    if task.friction != usual.friction:
        begin, end = usual.friction
        share = (high - low) / (end - begin)
        friction = (max(0.0, low + share * (friction[0] - begin)), max(0.0, low + share * (friction[1] - begin)))
    return replace(settings, lever_m=(least, most), friction=friction)


def likeliest(belief: TrajectoryBelief, prior: PlanarPrior, metric: StateMetric) -> int:
    """The particle of one run with the most weight, copies taken together.

    Of those that weigh the same, as all do after a resampling but for copies, the one whose start and readings are
    likeliest.
    """
    weights = unique_states(belief.pose[0], belief.log_weights[0], metric).log_weights
    # sums of the same weights differ by rounding
    heaviest = weights >= weights.max() - 1e-9
    posterior = belief.log_likelihood[0] + prior.log_density(belief.start[0])
    return int(torch.where(heaviest, posterior, -math.inf).argmax())


def _always(touched: Touched) -> bool:
    return True
