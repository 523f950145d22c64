"""Training of plan proposals: imitation of long plans, then descent of the soft cost through pushing."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from rumi.tasks.rummage.agent import Rummager
from scripts.plan_proposals import ProposalNetwork, Scenes, SoftCost


class Imitation:
    """Imitation loss: squared distance of long plans' paths from the nearest plan of a set, the best counting most.

    Only the nearest plan follows (the set spreads over what there is to follow); the others do a little.

    Args:
        agent: whose tool it is.
        network: whose planner makes controls of knots.
    """

    def __init__(self, agent: Rummager, network: ProposalNetwork) -> None:
        self.scale, self.planner = agent.tool.scale / torch.tensor([0.03, 0.03, 0.4]), network.planner

    def __call__(self, knots: Float[Tensor, "B P K 3"], scenes: Scenes, others: float) -> Tensor:
        """Mean over scenes, with a weight of the others."""
        own, good = self._paths(knots)[:, :, None], self._paths(scenes.knots)[:, None]
        apart = (own - good).square().mean((-2, -1))  # (B, P, T)
        share = (-scenes.costs / 0.15).softmax(-1)
        return (share * apart.amin(1)).sum(-1).mean() + others * apart.mean()

    def _paths(self, knots: Float[Tensor, "B n K 3"]) -> Float[Tensor, "B n H 3"]:
        return self.planner.controls(knots).cumsum(-2) * self.scale


def drawn(scenes: Scenes, batch: int, random: torch.Generator) -> Scenes:
    """Some of the scenes, drawn with replacement."""
    return scenes.at(torch.randint(len(scenes.configuration), (batch,), generator=random))


def imitate(agent: Rummager, network: ProposalNetwork, scenes: Scenes, steps: int, random: torch.Generator) -> None:
    """Train towards the long plans of scenes."""
    imitation = Imitation(agent, network)

    def loss(progress: float) -> Tensor:
        some = drawn(scenes, 64, random)
        return imitation(network.plans(some.seen), some, 0.05 * (1.0 - progress))

    optimise(network, loss, steps, 1e-3)


def descend(
    agent: Rummager, network: ProposalNetwork, scenes: Scenes, fresh: Scenes, steps: int, random: torch.Generator
) -> None:
    """Train by the gradient of the soft cost of fresh scenes, whose width shrinks, and a little by imitation still."""
    imitation, soft = Imitation(agent, network), SoftCost(agent)

    def loss(progress: float) -> Tensor:
        some, followed = drawn(fresh, 20, random), drawn(scenes, 64, random)
        width = max(0.008, 0.03 * 0.25 ** min(1.0, progress / 0.7))
        poses = some.poses[:, torch.randperm(some.poses.shape[1], generator=random)[:2]]
        cost = best_cost(soft, network, some, poses, width)
        return cost + 0.3 * imitation(network.plans(followed.seen), followed, 0.0)

    optimise(network, loss, steps, 3e-4)


def best_cost(
    soft: SoftCost,
    network: ProposalNetwork,
    scenes: Scenes,
    poses: Float[Tensor, "B M 3"],
    width: float,
    *,
    kept: int = 4,
    temperature: float = 0.05,
) -> Tensor:
    """Soft minimum of the cost over a set's plans, whose gradient is that of the few that are best by one pose."""
    knots = network.plans(scenes.seen)
    with torch.no_grad():
        rough = soft(network.planner.controls(knots), scenes, poses[:, :1], width)
    best = rough.topk(min(kept, rough.shape[1]), largest=False).indices
    controls = network.planner.controls(knots.take_along_dim(best[..., None, None], 1))
    costs = soft(controls, scenes, poses, width)
    return (-temperature * (-costs / temperature).logsumexp(-1)).mean()


def optimise(network: ProposalNetwork, loss_of: Callable[[float], Tensor], steps: int, rate: float) -> None:
    """Adam steps at a rate that falls to 0 by a cosine; a loss is told the progress, from 0 to 1."""
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(1, steps))
    network.train()
    late = 0.0
    for step in range(steps):
        loss = loss_of(step / steps)
        optimiser.zero_grad()
        loss.backward()
        norm = clip_grad_norm_(network.parameters(), 1.0)
        if bool(norm.isfinite()):  # an object that is wedged has slopes without end
            optimiser.step()
        schedule.step()
        late = 0.95 * late + 0.05 * float(loss.detach()) if step else float(loss.detach())
        if step % 50 == 49:
            print(f"step {step + 1}: loss {late:.3f}", flush=True)
