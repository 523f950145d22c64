"""A policy as a package from outside would bring it: found by an entry point, in no row of the table."""

import torch
from torch import Tensor

from rumi.planning.policy import Plan, PlanRequest, Policy
from rumi.planning.registry import PolicySettings


class WanderingPolicy:
    """Goes where chance has it."""

    def act(self, request: PlanRequest) -> Plan:
        now, tool = request.scene.configuration, request.scene.tool
        drawn = 2.0 * torch.rand(len(now), generator=request.generator, dtype=now.dtype) - 1.0
        reached, _ = tool.free_step(now, drawn)
        return Plan(drawn[None], torch.stack((now, reached)))


def wandering(settings: PolicySettings, reach: Tensor) -> Policy:
    return WanderingPolicy()
