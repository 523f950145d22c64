"""How well deadlines are kept by every planner on a real clock, and what more time is worth."""

import copy
import gc
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch

from rumi import loop
from rumi.agent import Parts
from rumi.belief.particles import PoseBelief
from rumi.belief.trajectory_belief import TrajectoryBelief
from rumi.cache import cache_folder
from rumi.clock import Now
from rumi.fields.information import information_field
from rumi.planning.anytime import select
from rumi.planning.duration_model import DurationModel
from rumi.planning.policy import Plan, PlanRequest, Policy, Scene
from rumi.planning.registry import POLICIES
from rumi.planning.rummaging import RummagingPolicy
from rumi.robot.motion_time import SpeedLimits
from rumi.seeding import split
from rumi.task import Task
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.budget import BudgetedChoice
from rumi.tasks.touch_box.build import build_touch_box
from rumi.tasks.touch_box.robot import TouchBox
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.selection import Choice
from rumi.tasks.touch_box.settings import TouchSettings
from scripts.bench.touch_choice import TouchChoice
from scripts.store import Figures, Store

REAL_BUDGETS_S = (0.05, 0.2, 1.0)
TOUCH_BUDGETS_S = (0.02, *REAL_BUDGETS_S)
PIECE = 50
"""Decisions of one measurement."""

_MEASURED = 500
_JUDGE_ROLLOUTS = 64
_FAST = SpeedLimits(50.0, 1e5)  # so that a motion fits into milliseconds
_CLOCKS: dict[str, Now] = {"wall": time.perf_counter, "cpu": time.process_time}


@dataclass(eq=False)
class Situations:
    """What one method was asked along a run: beliefs and scenes to decide on again.

    Attributes:
        task: whose run.
        method: that made it.
        seed: of it.
        steps: actions of it.
    """

    task: str
    method: str
    seed: int = 1001
    steps: int = 8

    @cached_property
    def parts(self) -> Parts[Task, Rummager]:
        """Task and rummager, without a budget."""
        settings = preset(task=self.task, method=self.method, seed=self.seed, steps=self.steps)
        return build(settings, cache_dir=cache_folder())

    @cached_property
    def given(self) -> list[tuple[PoseBelief, Scene]]:
        """The situations, in order."""
        watched = _Watched(self.parts.agent.policy)
        loop.run_to_end(self.parts.task, replace(self.parts.agent, policy=watched), seed=self.seed, steps=self.steps)
        self.parts.task.close()
        return watched.given

    def policy(self, clock: str) -> Policy:
        """The method, with budgets held against a clock."""
        policy = self.parts.agent.policy
        if isinstance(policy, RummagingPolicy):
            policy.now = _CLOCKS[clock]
        return policy


class _Watched:
    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.given: list[tuple[PoseBelief, Scene]] = []

    def act(self, request: PlanRequest) -> Plan:
        self.given.append((request.belief, request.scene))
        return self.policy.act(request)


def decisions(where: Situations, budget_s: float, clock: str, piece: int) -> Figures:
    """Plans along a run, each from the one before, over and over: how long each took.

    The pace that a plan hands on is measured under the same load; the first plan of each run starts without any.
    """
    policy, now = where.policy(clock), _CLOCKS[clock]
    random = split(piece, "deadlines")
    plan: Plan | None = None
    # compiled code is loaded, and the processor is awake
    for belief, scene in where.given[:2]:
        plan = policy.act(PlanRequest(belief, scene, plan, executed=1, budget_s=budget_s, generator=random))
    gc.freeze()  # as `rumi run` does
    took, first, kept, samples = [], [], 0, []
    for index in range(PIECE):
        belief, scene = where.given[(piece * PIECE + index) % len(where.given)]
        if (piece * PIECE + index) % len(where.given) == 0:
            plan = None
        begun = now()
        plan_of = policy.act(PlanRequest(belief, scene, plan, executed=1, budget_s=budget_s, generator=random))
        took.append(now() - begun)
        first.append(plan is None)
        plan = plan_of
        kept += plan.info.get("iterations") == 0
        samples.append(plan.info.get("samples", 0))
    return {"took_s": took, "first": first, "carried_on": kept, "samples": samples, "load": os.getloadavg()[0]}


def touch_decisions(budget_s: float, clock: str, piece: int) -> Figures:
    """Choices of the next touch, motions scaled to milliseconds: how long thinking and motion take together."""
    now = _CLOCKS[clock]
    gc.freeze()  # as `rumi run` does
    took, gains, evaluated = [], [], []
    work, seconds = _measured(TouchChoice.drawn(1000, limits=_FAST), now, 100)
    making = _making(TouchChoice.drawn(1000, limits=_FAST), now, 1200)
    for index in range(PIECE):
        choice = TouchChoice.drawn(1000 + piece * PIECE + index, limits=_FAST)
        evaluation = DurationModel.fit(work[-_MEASURED:], seconds[-_MEASURED:], 0.99)
        begun = now()
        made = select(
            choice.candidates(),
            choice.gain,
            budget_s,
            evaluation=evaluation,
            generation=making,
            doublings=0,
            now=now,
        )
        thinking = now() - begun
        took.append(thinking + (made.candidate.execution_s if made.candidate is not None else 0.0))
        gains.append(made.gain)
        evaluated.append(made.evaluated)
        work += [each for each, _ in made.measured]
        seconds += [each for _, each in made.measured]
    return {"took_s": took, "gains": gains, "evaluated": evaluated, "load": os.getloadavg()[0]}


@dataclass(eq=False)
class Pokes:
    """What `rumi run touch-box` was asked along runs: beliefs to choose a poke for again.

    Attributes:
        seeds: of the runs.
    """

    seeds: tuple[int, ...] = (1001, 1002)

    @cached_property
    def parts(self) -> Parts[TouchBox, Toucher]:
        """All of the run but its budget."""
        return build_touch_box(TouchTask(), TouchSettings(), "gripper", cache_dir=cache_folder())

    @cached_property
    def given(self) -> list[TrajectoryBelief]:
        """The beliefs, in order."""
        given: list[TrajectoryBelief] = []

        def watched(belief: TrajectoryBelief, *, generator: torch.Generator) -> tuple[torch.Tensor, Choice]:
            given.append(belief)
            return self.parts.agent.decide(belief, generator=generator)

        agent = copy.copy(self.parts.agent)
        agent.chooser = watched
        for seed in self.seeds:
            loop.run_to_end(self.parts.task, agent, seed=seed)
        return given


def poke_decisions(where: Pokes, budget_s: float, clock: str, piece: int) -> Figures:
    """Choices of a poke of `touch-box`, one after the other: how long each took, and of how many candidates."""
    now = _CLOCKS[clock]
    random = split(piece, "deadlines")
    choose = BudgetedChoice(where.parts.agent, budget_s, now)
    choose(where.given[0], generator=random)
    gc.freeze()  # as `rumi run` does
    took, evaluated = [], []
    for index in range(PIECE):
        belief = where.given[(piece * PIECE + index) % len(where.given)]
        begun = now()
        _, choice = choose(belief, generator=random)
        took.append(now() - begun)
        evaluated.append(len(choice.value))
    return {"took_s": took, "samples": evaluated, "load": os.getloadavg()[0]}


def _measured(choice: TouchChoice, now: Now, count: int) -> tuple[list[float], list[float]]:
    """Work and seconds of some evaluations."""
    work, seconds = [], []
    for _, candidate in zip(range(count), choice.candidates(), strict=False):
        begun = now()
        choice.gain(candidate.action)
        seconds.append(now() - begun)
        work.append(candidate.work)
    return work, seconds


def _making(choice: TouchChoice, now: Now, count: int) -> DurationModel:
    """How long the next candidate takes to come."""
    seconds, source = [], choice.candidates()
    for _ in range(count):
        begun = now()
        next(source)
        seconds.append(now() - begun)
    return DurationModel.fit([1.0] * count, seconds, 0.99)


def value_found(where: Situations, budget_s: float | None, seed: int) -> Figures:
    """What first plans are worth, judged with all particles and many rollouts by what the method plans for.

    On the processor's clock, so that others who share it do not cost a plan its time.
    """
    policy = where.policy("cpu")
    assert isinstance(policy, RummagingPolicy)
    values, still = [], []
    policy.act(PlanRequest(*where.given[0], budget_s=0.0, generator=split(seed, "warm")))
    for belief, scene in where.given:
        made = policy.act(PlanRequest(belief, scene, budget_s=budget_s, generator=split(seed, "plan")))
        judge = _judge(policy, belief, scene)
        both = torch.stack((made.controls, torch.zeros_like(made.controls)))
        cost = judge(both)
        values.append(-float(cost[0]))
        still.append(-float(cost[1]))
    return {"values": values, "still": still}


def _judge(policy: RummagingPolicy, belief: PoseBelief, scene: Scene) -> Callable[[torch.Tensor], torch.Tensor]:
    poses, log_weights = belief.world_T_object, belief.log_weights
    fields = information_field(scene.model.sdf, poses, log_weights, scene.workspace.points, policy.settings.information)
    model = policy.push_models.rollouts(scene.model, poses, log_weights, scene.tool, scene.workspace, fields)
    objective = policy.objective(belief, scene, fields, None)
    configuration = scene.configuration.to(fields.information)

    def judge(controls: torch.Tensor) -> torch.Tensor:
        random = split(0, "judge")
        return objective.cost(model.rollout(configuration, controls, rollouts=_JUDGE_ROLLOUTS, generator=random))

    return judge


def touch_value(budget_s: float, seed: int) -> Figures:
    """What choices of the next touch find, on the processor's clock: the same ones at every budget."""
    now = _CLOCKS["cpu"]
    evaluation = DurationModel.fit(*_measured(TouchChoice.drawn(seed, limits=_FAST), now, 100), 0.99)
    values = []
    for index in range(20):
        choice = TouchChoice.drawn(seed + 1000 * index, limits=_FAST)
        made = select(choice.candidates(), choice.gain, budget_s, evaluation=evaluation, doublings=0, now=now)
        values.append(made.gain)
    return {"values": values, "still": [0.0] * len(values)}


def measure_real(
    store: Store, *, clock: str, pieces: int, planners: tuple[str, ...], task: str = "mug-1"
) -> Iterator[bool]:
    """Do what is missing of the real decisions, `pieces` of 50 for each planner and budget."""
    threads = torch.get_num_threads()
    for planner in planners:
        work, of = _real_work(planner, task)
        for budget in TOUCH_BUDGETS_S if planner in ("touch", "pokes") else REAL_BUDGETS_S:
            for piece in range(pieces):
                about = {"part": "real", "planner": planner, "budget_s": budget, "clock": clock, "piece": piece}
                yield store.measure(about | {"threads": threads, "task": of}, partial(work, budget, clock, piece))


def _real_work(planner: str, task: str) -> tuple[Callable[[float, str, int], Figures], str]:
    """What measures a planner at a budget, and whose situations it is asked about."""
    if planner == "touch":
        return touch_decisions, "touch"
    if planner == "pokes":
        return partial(poke_decisions, Pokes()), "touch-box"
    return partial(decisions, Situations(task, planner)), task


def measure_value(store: Store, *, seeds: range, planners: tuple[str, ...], task: str = "mug-1") -> Iterator[bool]:
    """Do what is missing of what plans are worth by budget."""
    threads = torch.get_num_threads()
    for planner in planners:
        if planner in ("slide", "pokes"):
            continue
        where = None if planner == "touch" else Situations(task, planner)
        budgets: tuple[float | None, ...] = TOUCH_BUDGETS_S if where is None else (*REAL_BUDGETS_S, None)
        for seed in seeds:
            for budget in budgets:
                about = {"part": "value", "planner": planner, "budget_s": budget, "seed": seed}
                about |= {"threads": threads, "task": "touch" if where is None else task}
                work = (
                    partial(touch_value, budget or 0.0, seed)
                    if where is None
                    else partial(value_found, where, budget, seed)
                )
                yield store.measure(about, work)


PLANNERS = ("touch", "pokes", *POLICIES)
"""All that decide: on the next touch, on a poke of `touch-box`, on a push."""
