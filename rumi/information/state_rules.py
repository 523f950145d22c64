"""Stopping rules on the states of particles: by their covariance, or by the mass of target points."""

import itertools
import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from rumi.weights import check_weights
from sdf.bounds import Checked, Positive
from sdf.check import check_shape
from sdf.so3 import wrap

_MOST_TARGETS = 4  # whose orders are all tried
_TRIES, _REFINEMENTS = 200, 5
"""Likeliest particles whose own targets are tried; steps from the best of them to the mean of the targets near it."""


def covariance(
    states: Float[Tensor, "N D"], log_weights: Float[Tensor, "N"], periods: tuple[float | None, ...] | None = None
) -> Float[Tensor, "D D"]:
    """Weighted covariance about the mean, in the states' units squared.

    Args:
        states: of the particles.
        log_weights: normalised or not.
        periods: after which a dimension repeats, None for one that does not: 2 pi for an angle, pi for that of an
            object that looks the same half a turn on. Such a dimension is centred at its circular mean.

    Raises:
        ValueError: see `rumi.weights.check_weights`.
    """
    check_weights(log_weights)
    weights = log_weights.softmax(-1)
    mean = weights @ states
    away = states - mean
    for dim, period in enumerate(periods or ()):
        if period is not None:
            turns = states[:, dim] * (2.0 * math.pi / period)
            centre = torch.atan2(weights @ turns.sin(), weights @ turns.cos()) * (period / (2.0 * math.pi))
            apart = states[:, dim] - centre
            away[:, dim] = wrap(apart, period)
    return away.mT @ (weights[:, None] * away)


@dataclass(frozen=True)
class CovarianceRule(Checked):
    """Sure where no direction of the states spreads beyond an ellipsoid: a threshold on eigenvalues, free of units.

    Attributes:
        most: standard deviation that is allowed along each dimension, in its unit.
        periods: see `covariance`.
    """

    most: tuple[Positive, ...]
    periods: tuple[float | None, ...] | None = None

    def __post_init__(self) -> None:
        """Refuse spreads that are none."""
        super().__post_init__()
        if self.periods is not None and len(self.periods) != len(self.most):
            raise ValueError(f"Expected one period for each of {len(self.most)} dimensions, got {len(self.periods)}")

    def spread(self, states: Float[Tensor, "N D"], log_weights: Float[Tensor, "N"]) -> float:
        """Largest standard deviation in any direction, as a share of what is allowed there."""
        check_shape("states", states, "(N, D)", last=(len(self.most),))
        scale = states.new_tensor(self.most)
        scaled = covariance(states, log_weights, self.periods) / (scale[:, None] * scale)
        return math.sqrt(max(float(torch.linalg.eigvalsh(scaled.double())[-1]), 0.0))

    def holds(self, states: Float[Tensor, "N D"], log_weights: Float[Tensor, "N"]) -> bool:
        """Whether the belief is sure."""
        return self.spread(states, log_weights) <= 1.0


class TargetEstimate(NamedTuple):
    """Estimate of target points, with the probability that it is within the tolerance.

    Attributes:
        points: (K, D), metres.
        probability: that the guess is within the tolerance.
    """

    points: Float[Tensor, "K D"]
    probability: float


@dataclass(frozen=True)
class MassRule(Checked):
    """Sure where target points of the object are known within a tolerance with high probability.

    Targets are alike: they may be taken for one another, such as the two holes of a symmetric object.

    Attributes:
        tolerance_m: distance of a target from the guess.
        probability: that is asked for.
    """

    tolerance_m: Positive
    probability: Annotated[float, Interval(gt=0.0, lt=1.0)] = 0.95

    def aim(self, targets: Float[Tensor, "N K D"], log_weights: Float[Tensor, "N"]) -> TargetEstimate:
        """The best guess.

        Args:
            targets: where each particle has them, metres.
            log_weights: of the particles, normalised or not.

        Raises:
            ValueError: no particles or targets, or weights as `rumi.weights.check_weights` refuses them.
        """
        count, kinds = targets.shape[:2]
        if count == 0 or kinds == 0:
            raise ValueError(f"Expected at least one particle and one target, got shape {tuple(targets.shape)}")
        if kinds > _MOST_TARGETS:
            raise ValueError(f"Expected at most {_MOST_TARGETS} targets that are alike, got {kinds}")
        check_weights(log_weights)
        weights = log_weights.softmax(-1)
        likeliest = torch.argsort(log_weights, descending=True, stable=True)[:_TRIES]
        # each of the ways in which a guess may be held against them: (P, N, K, D)
        orders = torch.stack([targets[:, list(order)] for order in itertools.permutations(range(kinds))])
        guesses = targets[likeliest]
        mass = _apart(guesses, orders).le(self.tolerance_m).amax(1).to(weights) @ weights
        first = int(mass.argmax())
        guess, best = guesses[first], float(mass[first])
        for _ in range(_REFINEMENTS):
            apart = _apart(guess[None], orders)[0]
            nearest = apart.argmin(0)
            near = torch.where(apart.amin(0) <= self.tolerance_m, weights, 0.0)
            own = orders[nearest, torch.arange(count, device=nearest.device)]
            mean = (near[:, None, None] * own).sum(0) / near.sum()
            found = float(_apart(mean[None], orders)[0].le(self.tolerance_m).amax(0).to(weights) @ weights)
            if found <= best:
                break
            guess, best = mean, found
        return TargetEstimate(guess, min(best, 1.0))

    def holds(self, targets: Float[Tensor, "N K D"], log_weights: Float[Tensor, "N"]) -> bool:
        """Whether the belief is sure."""
        return self.aim(targets, log_weights).probability >= self.probability


def _apart(guesses: Float[Tensor, "G K D"], orders: Float[Tensor, "P N K D"]) -> Float[Tensor, "G P N"]:
    """Greatest distance of a guess from its targets."""
    return (guesses[:, None, None] - orders).norm(dim=-1).amax(-1)
