"""Comparison of planners with and without proposed plans: situations of recorded runs, costs, whole runs, a test."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rumi import build, preset
from rumi.belief.particles import PoseBelief
from rumi.cache import cache_folder
from rumi.clock import Clock
from rumi.fields.information import information_field
from rumi.loop import run
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

    def turned(self, base: Tensor, angle: float) -> "Moment":
        """The same with object and tool turned about the arm's base, radians."""
        there = se3.from_planar(torch.cat((base[:2], base.new_zeros(1))))
        motion = there @ se3.from_planar(base.new_tensor([0.0, 0.0, angle])) @ se3.inverse(there)
        tool = se3.to_planar(motion @ se3.from_planar(self.configuration))
        return self._replace(world_T_object=motion @ self.world_T_object, configuration=tool)


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
        iterations: of KMPPI.
    """

    network: bool
    iterations: int

    @property
    def name(self) -> str:
        """For people."""
        return f"{'network and ' if self.network else ''}KMPPI x {self.iterations}"


def judge(
    agent: Rummager, network: ProposalNetwork, moment: Moment, method: Method, samples: int, *, warm: bool
) -> dict[str, Any]:
    """Cost of a method's plan of a belief, by more poses than it is planned by, and its time.

    Args:
        agent: whose scene, costs and push model they are.
        network: of the proposals.
        moment: what is planned from.
        method: of planning.
        samples: of an iteration.
        warm: whether the plan before is gone on with; else it starts from noise.
    """
    own = policy_of(agent)
    planner = replace(own.settings.mppi, samples=samples, iterations=method.iterations)
    settings = replace(own.settings, mppi=replace(planner, warmup_iterations=method.iterations))
    policy = RummagingPolicy(own.reachability, settings, proposals=network.propose if method.network else None)
    policy.push_models = own.push_models  # what it keeps of the shape is no part of a plan
    belief, scene, previous = moment.belief, scene_of(agent, moment), None
    if warm and moment.knots is not None:
        before = network.planner.from_knots(moment.knots)
        previous = Plan(before.controls, moment.configuration[None], warm_start=before)
    random = torch.Generator().manual_seed(moment.seed)
    request = PlanRequest(belief, scene, previous, executed=moment.executed, generator=random)
    begun = clock()
    plan = policy.act(request)
    taken = clock() - begun
    return {"cost": plan_cost(agent, belief, scene, plan.controls), "seconds": taken}


def scene_of(agent: Rummager, moment: Moment) -> Scene:
    """What a plan has to know beside the belief."""
    return Scene(agent.model, agent.workspace, agent.tool, moment.configuration)


@torch.no_grad()
def plan_cost(agent: Rummager, belief: PoseBelief, scene: Scene, controls: Tensor) -> float:
    """The planner's cost of some controls, the mean over 32 poses of the belief."""
    own = policy_of(agent)
    poses, log_weights = belief.world_T_object, belief.log_weights
    fields = information_field(agent.model.sdf, poses, log_weights, agent.workspace.points, own.settings.information)
    model = own.push_models.rollouts(agent.model, poses, log_weights, agent.tool, agent.workspace, fields)
    rolled = model.rollout(
        scene.configuration, controls[None], rollouts=JUDGES, generator=torch.Generator().manual_seed(0)
    )
    return float(own.objective(belief, scene, fields, None).cost(rolled)[0])


def whole_run(task: Task, agent: Rummager, network: ProposalNetwork | None, seed: int) -> dict[str, Any]:
    """How a run of the agent comes out, its policy with or without proposals."""
    own = policy_of(agent)
    proposals = None if network is None else network.propose
    policy = RummagingPolicy(own.reachability, own.settings, proposals=proposals)
    begun = clock()
    result = run(task, replace(agent, policy=policy), seed=seed)
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
