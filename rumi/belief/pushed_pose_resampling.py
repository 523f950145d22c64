"""Resampling of a pushed object's particles, whose ways of sliding and tool places drift about their priors."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pushed_pose_reading import PushedPoseBelief
from rumi.dynamics.outline import Support
from rumi.dynamics.push_parameters import sliding_of
from rumi.dynamics.sliding import Sliding
from rumi.resampling import systematic
from rumi.seeding import uniform
from sdf import backend, compiled


@dataclass(frozen=True, eq=False)
class Drift:
    """Autoregressive drift at a resampling, that leaves the priors as they are; particles are never used up by it.

    Attributes:
        mean: (8), of the parameters of sliding.
        deviation: (8), of them.
        tool_m: (3), standard deviation of the tool's place, metres.
        keep: share of what a particle has that it keeps.
        support: of the object.
    """

    mean: Float[Tensor, "8"]
    deviation: Float[Tensor, "8"]
    tool_m: Float[Tensor, "3"]
    keep: float
    support: Support

    @property
    def fresh(self) -> float:
        """Share of the prior's deviation that is drawn."""
        return math.sqrt(1.0 - self.keep**2)

    @cached_property
    def arrays(self) -> tuple[Any, ...]:
        """The same as the compiled version takes it."""
        own = self.support
        numbers = (*own.centre.tolist(), own.spread, *own.elongation.tolist(), self.keep, self.fresh)
        return (self.mean.numpy(), self.deviation.numpy(), self.tool_m.numpy(), np.array(numbers))


class Resampled(NamedTuple):
    """Equally likely particles; as in `PushedPoseBelief`."""

    pose: Float[Tensor, "N 3"]
    log_weights: Float[Tensor, "N"]
    parameters: Float[Tensor, "N 8"]
    sliding: Sliding
    tool: Float[Tensor, "N 3"]


def resampled(belief: PushedPoseBelief, drift: Drift, *, generator: torch.Generator) -> PushedPoseBelief:
    """The belief by equally likely particles (`systematic`), drifted."""
    offset = uniform((), generator=generator, dtype=torch.float64)
    normal, moved = (
        torch.randn(part.shape, generator=generator, dtype=torch.float64) for part in (belief.parameters, belief.tool)
    )
    version = backend.dispatch("resample_pushed", belief.pose)
    found: Resampled = version(belief, drift, offset, normal, moved)
    return belief._replace(**found._asdict())


@backend.register("resample_pushed")
def _resampled(belief: PushedPoseBelief, drift: Drift, offset: Tensor, normal: Tensor, moved: Tensor) -> Resampled:
    rows = systematic(belief.log_weights, offset)
    parameters = drift.mean + drift.keep * (belief.parameters[rows] - drift.mean)
    parameters = parameters + drift.fresh * drift.deviation * normal
    return Resampled(
        belief.pose[rows],
        torch.zeros_like(belief.log_weights).log_softmax(-1),
        parameters,
        sliding_of(parameters, drift.support),
        drift.keep * belief.tool[rows] + drift.fresh * drift.tool_m * moved,
    )


@backend.register("resample_pushed", "numba", compiled.supports)
def _resampled_numba(
    belief: PushedPoseBelief, drift: Drift, offset: Tensor, normal: Tensor, moved: Tensor
) -> Resampled:
    from rumi.belief.pushed_pose_resampling_numba import resample as kernel

    count = len(belief.pose)
    held = (belief.log_weights, belief.pose, belief.parameters, belief.tool, normal, moved)
    before = tuple(part.numpy() for part in held)
    found = [np.empty((count, size)) for size in (3, 8, 3, 2, 5)]
    lever, friction = np.empty((2, count))
    kernel(before, drift.arrays, np.array((float(offset),)), (*found, lever, friction))
    pose, parameters, tool, centre, quartic = (torch.from_numpy(part) for part in found)
    sliding = Sliding(centre, torch.from_numpy(lever), torch.from_numpy(friction), quartic)
    even = torch.full((count,), -math.log(count), dtype=torch.float64)
    return Resampled(pose, even, parameters, sliding, tool)
