"""Paths of some of the samples that a plan was weighed from, for figures."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import Rollouts
from rumi.robot.tool import Tool

_KEPT = 16  # samples whose paths are kept with a plan


@dataclass(frozen=True)
class SampledPaths:
    """Paths of some of the samples that a plan was weighed from, in the order of their costs.

    Attributes:
        found: works the paths out: it takes as long as a fifth of a plan, and most plans are never drawn.
        costs: (K,), finite, the least first.
    """

    found: Callable[[], Float[Tensor, "K T1 Q"]]
    costs: Float[Tensor, "K"]

    @cached_property
    def paths(self) -> Float[Tensor, "K T1 Q"]:
        """Configurations (K, T+1, Q) if nothing is in the way, the present one first."""
        return self.found()


def sampled_paths(
    tool: Tool, configuration: Float[Tensor, "Q"], samples: Rollouts, costs: Float[Tensor, "K"]
) -> SampledPaths:
    """Paths of samples from the best to the worst, evenly through their ranks.

    Args:
        tool: that takes them.
        configuration: where it is now.
        samples: of the planner.
        costs: of them, on the host.
    """
    finite = costs.isfinite().nonzero()[:, 0]
    ranked = finite[costs[finite].argsort()]
    ranks = torch.linspace(0, len(ranked) - 1, min(_KEPT, len(ranked)), device=ranked.device).round().long()
    kept = ranked[ranks]

    @torch.no_grad()
    def found() -> Float[Tensor, "K T1 Q"]:
        controls = samples.controls[kept.to(samples.controls.device)].to(configuration)
        free = tool.free_path(configuration.expand(len(kept), -1), controls, 1)
        return torch.cat((configuration.expand(len(kept), 1, -1), free), 1)

    return SampledPaths(found, costs[kept])
