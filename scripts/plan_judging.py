"""Comparison of planners with and without proposed plans: situations of recorded runs, costs, whole runs, a test."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kmppi import MPPI
from rumi import build, preset
from rumi.belief.particles import PoseBelief
from rumi.cache import cache_folder
from rumi.clock import Clock
from rumi.fields.information import information_field
from rumi.loop import run_to_end
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.rummaging import RummagingPolicy
from rumi.task import Task
from rumi.tasks.rummage.agent import Rummager
from scripts.plan_proposals import ProposalNetwork, policy_of
from scripts.store import clock
from sdf import se3

JUDGES = 32  # poses that a plan is judged by


class Moment(NamedTuple):
    """Situation before an action of a run: what a plan is made from."""

    seed: int
    step: int
    world_T_object: Tensor
    log_weights: Tensor
    configuration: Tensor
    knots: Tensor | None  # of the plan before
    executed: int

    @property
    def belief(self) -> PoseBelief:
        """The belief."""
        return PoseBelief.uniform(self.world_T_object).reweighted(self.log_weights)

    def turned(self, angle: float) -> "Moment":
        """The same with the object turned about where it is believed, radians."""
        place = self.belief.weights @ self.world_T_object[:, :2, 3]
        there = se3.from_planar(torch.cat((place, place.new_zeros(1))))
        motion = there @ se3.from_planar(place.new_tensor([0.0, 0.0, angle])) @ se3.inverse(there)
        return self._replace(world_T_object=motion @ self.world_T_object)


def parts(samples: int, iterations: int, warm_up: int) -> tuple[Task, Rummager]:
    """Task and agent, with a planner of some samples."""
    planner = {"samples": samples, "iterations": iterations, "warmup_iterations": warm_up}
    task, agent = build(preset(task="mug", planner={"mppi": planner}), cache_dir=cache_folder())
    return task, replace(agent, remarks=False)


@torch.no_grad()
def moments(task: Task, agent: Rummager, seed: int) -> Iterator[Moment]:
    """Situations of a run, until it is sure."""
    state = agent.begin(task.reset(seed), seed=seed, clock=Clock())
    while agent.stop(state) is None:
        belief, plan = state.record.belief, state.plan
        knots = None if plan is None or plan.warm_start is None else plan.warm_start.knots
        place = state.record.reading.configuration
        yield Moment(seed, state.record.step, belief.world_T_object, belief.log_weights, place, knots, state.executed)
        state, action = agent.act(state)
        state = agent.update(state, action, task.step(action))


def one_of(task: Task, agent: Rummager, seed: int) -> Moment:
    """The situation of a run after 0 to 4 actions, as the seed says, or its last."""
    last = None
    for last in moments(task, agent, seed):
        if last.step == seed % 5:
            break
    assert last is not None, f"the run of seed {seed} was sure at once"
    return last


class Method(NamedTuple):
    """Planner to compare.

    Attributes:
        network: whether it has proposals.
        samples: of an iteration.
        iterations: of KMPPI.
        narrow: whether samples are drawn closer about the plan (variance .15 for 1.5) and weighed by their costs alone.
    """

    network: bool
    samples: int
    iterations: int
    narrow: bool

    @property
    def family(self) -> str:
        """What it shares with those of other numbers of iterations, for people."""
        return f"{'network and ' if self.network else ''}KMPPI {self.samples}{' narrow' if self.narrow else ''}"

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.family} x {self.iterations}"

    def policy(self, agent: Rummager, network: ProposalNetwork | None, first: int | None = None) -> RummagingPolicy:
        """An agent's policy that plans so, its first plan by a number of iterations of its own."""
        own = policy_of(agent)
        planner = replace(own.settings.mppi, samples=self.samples, iterations=self.iterations)
        planner = replace(planner, warmup_iterations=first or self.iterations)
        if self.narrow:
            planner = replace(planner, noise_variance=0.15, perturbation_cost=False)
        settings = replace(own.settings, mppi=planner)
        policy = RummagingPolicy(
            own.reachability, settings, proposals=network.propose if self.network and network else None
        )
        policy.push_models = own.push_models  # what it keeps of the shape is no part of a plan
        return policy


def judge(agent: Rummager, network: ProposalNetwork, moment: Moment, method: Method, *, warm: bool) -> dict[str, float]:
    """Cost of a method's plan of a belief, by more poses than it is planned by, and its time.

    Args:
        agent: whose scene, costs and push model they are.
        network: of the proposals.
        moment: what is planned from.
        method: of planning.
        warm: whether the plan before is gone on with; else it starts from noise.
    """
    policy = method.policy(agent, network)
    begun = clock()
    plan = planned(agent, policy, moment, warm=warm)
    taken = clock() - begun
    return {"cost": plan_cost(agent, moment, plan.controls), "seconds": taken}


def planned(agent: Rummager, policy: RummagingPolicy, moment: Moment, *, warm: bool) -> Plan:
    """A policy's plan, from the plan before or from noise."""
    previous = None
    if warm and moment.knots is not None:
        before = MPPI(policy.settings.mppi, 3).from_knots(moment.knots)
        previous = Plan(before.controls, moment.configuration[None], warm_start=before)
    random = torch.Generator().manual_seed(moment.seed)
    scene = scene_of(agent, moment)
    return policy.act(PlanRequest(moment.belief, scene, previous, executed=moment.executed, generator=random))


def scene_of(agent: Rummager, moment: Moment) -> Scene:
    """What a plan has to know beside the belief."""
    return Scene(agent.model, agent.workspace, agent.tool, moment.configuration)


@torch.no_grad()
def plan_cost(agent: Rummager, moment: Moment, controls: Tensor) -> float:
    """The planner's cost of some controls, the mean over 32 poses of the belief."""
    own, belief, scene = policy_of(agent), moment.belief, scene_of(agent, moment)
    poses, log_weights = belief.world_T_object, belief.log_weights
    fields = information_field(agent.model.sdf, poses, log_weights, agent.workspace.points, own.settings.information)
    model = own.push_models.rollouts(agent.model, poses, log_weights, agent.tool, agent.workspace, fields)
    rolled = model.rollout(
        scene.configuration, controls[None], rollouts=JUDGES, generator=torch.Generator().manual_seed(0)
    )
    return float(own.objective(belief, scene, fields, None).cost(rolled)[0])


def whole_run(task: Task, agent: Rummager, policy: RummagingPolicy, seed: int) -> dict[str, Any]:
    """How a run of an agent comes out by some policy."""
    begun = clock()
    result = run_to_end(task, replace(agent, policy=policy), seed=seed)
    return {
        "right": result.right,
        "actions": result.steps,
        "sure": result.stopped_by == "sure",
        "seconds": clock() - begun,
    }


def paired(differences: Sequence[float], draws: int = 20_000) -> dict[str, float]:
    """Mean of paired differences, its 95 % interval (bootstrap), and p of no difference (random signs, two-sided)."""
    values = torch.tensor(differences, dtype=torch.float64)
    random = torch.Generator().manual_seed(0)
    again = values[torch.randint(len(values), (draws, len(values)), generator=random)].mean(1)
    signs = 2.0 * torch.randint(2, (draws, len(values)), generator=random).double() - 1.0
    as_far = int(((signs * values).mean(1).abs() >= values.mean().abs() - 1e-15).sum())
    low, high = torch.quantile(again, again.new_tensor([0.025, 0.975])).tolist()
    return {"mean": float(values.mean()), "low": low, "high": high, "p": (as_far + 1) / (draws + 1)}
