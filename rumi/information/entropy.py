"""Differential entropy of a weighted set of states, by several estimators behind one interface.

The spatially aware one (touch-only localisation, Eq 5) is a sum of a weights term, which readings change, and the log
volume of a support that all states share, which motion changes.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor

from rumi.information.neighbours import StateMetric, UniqueStates, neighbours, unique_states
from rumi.weights import check_weights
from sdf.bounds import Checked, Positive
from sdf.check import check_shape
from sdf.numbers import refuse_trained


@runtime_checkable
class Entropy(Protocol):
    """Estimates the differential entropy of weighted sets, nats."""

    def __call__(self, states: Float[Tensor, "*b N D"], log_weights: Float[Tensor, "*#b N"]) -> Float[Tensor, "*b"]:
        """Entropy of each set: (*b, N, D) states and (*b, N) log-weights, which need not be normalised."""
        ...


def weights_entropy(log_weights: Float[Tensor, "*b N"]) -> Float[Tensor, "*b"]:
    """-sum w log w of weights that need not be normalised; 0 log 0 is 0. At most log N.

    Raises:
        ValueError: see `rumi.weights.check_weights`.
    """
    check_weights(log_weights)
    log = log_weights.log_softmax(-1)
    held = log > -math.inf
    safe = torch.where(held, log, 0.0)  # or autograd would take the slope of 0 log 0
    return -torch.where(held, safe.exp() * safe, 0.0).sum(-1)


class Support(NamedTuple):
    """The box that all states of a set share.

    Attributes:
        sides: (*b, D).
        log_volume: (*b), log of their product.
    """

    sides: Float[Tensor, "*b D"]
    log_volume: Float[Tensor, "*b"]


@dataclass(frozen=True)
class SharedSupport(Checked):
    """The shared support of a set: mean box about the nearest, scaled to the share of one state (App A, corrected).

    On a lattice of m points a side, `neighbours` = m^D nearest (itself among them) span m - 1 spacings, so that the
    mean box divided by neighbours^(1/D) - 1 is a lattice cell; the printed scale is garbled. Duplicates count once; a
    set with fewer states than neighbours uses all of them; one state alone has the least sides.

    Attributes:
        metric: of the states.
        neighbours: how many nearest make up a state's box (rho).
        include_self: whether a state is among its own nearest.
        floor: least side of the mean box, one for each dimension, or one for all: a resolution at which the states
            are told apart, without which a collapsed dimension has the entropy -inf.
        mean: of the boxes' sides: "arithmetic", the paper's, or "geometric", which far states do not dominate.
    """

    metric: StateMetric
    neighbours: Annotated[int, Ge(2)] = 5
    include_self: bool = True
    floor: Positive | tuple[Positive, ...] = 1e-9
    mean: Literal["arithmetic", "geometric"] = "arithmetic"

    def __post_init__(self) -> None:
        """Refuse what has no volume."""
        refuse_trained(self)
        super().__post_init__()
        floors = self.floor if isinstance(self.floor, tuple) else (self.floor,)
        if len(floors) not in (1, self.metric.dims):
            raise ValueError(f"Expected one floor or one for each of {self.metric.dims} dimensions, got {len(floors)}")

    def __call__(
        self, states: Float[Tensor, "*b N D"], log_weights: Float[Tensor, "*#b N"], unique: UniqueStates | None = None
    ) -> Support:
        """Support of each set; `unique` may be given where `unique_states` was asked before."""
        check_shape("states", states, "(*b, N, D)", last=(self.metric.dims,))
        unique = unique_states(states, log_weights, self.metric) if unique is None else unique
        near = neighbours(states, unique, self.metric, self.neighbours, include_self=self.include_self)
        floor = states.new_tensor(self.floor)
        count = unique.states.clamp_min(1).to(states.dtype)[..., None]
        if self.mean == "arithmetic":
            mean = torch.maximum(near.sides.sum(-2) / count, floor)
        else:
            log = torch.where(unique.first[..., None], torch.maximum(near.sides, floor).log(), 0.0)
            mean = (log.sum(-2) / count).exp()
        # a state alone has no box to scale
        span = near.used.to(states.dtype) ** (1.0 / self.metric.dims) - 1.0
        sides = torch.where((span > 0)[..., None], mean / torch.where(span > 0, span, 1.0)[..., None], floor)
        return Support(sides, sides.log().sum(-1))


@dataclass(frozen=True)
class SpatialEntropy:
    """Weights term plus log volume of the shared support (Eq 5).

    An upper bound on the entropy of the mixture of boxes about the states (Eq 12), equal where they do not overlap.
    """

    support: SharedSupport

    def __call__(self, states: Float[Tensor, "*b N D"], log_weights: Float[Tensor, "*#b N"]) -> Float[Tensor, "*b"]:
        """Entropy of each set."""
        unique = unique_states(states, log_weights, self.support.metric)
        return weights_entropy(unique.log_weights) + self.support(states, log_weights, unique).log_volume


@dataclass(frozen=True)
class NeighbourEntropy:
    """Kozachenko and Leonenko's estimate from the distance to the k-th neighbour, for weighted sets.

    With equal weights it is theirs, psi(N) - psi(k) + log c_D + D mean log(distance). With others, the share of the
    neighbours' weight takes the place of k / (N - 1), and the effective sample size that of N.

    Attributes:
        metric: of the states; the ball is round in its units.
        neighbours: k.
        floor: least distance, in units of the scales.
    """

    metric: StateMetric
    neighbours: int = 4
    floor: float = 1e-9

    def __post_init__(self) -> None:
        """Refuse what would drop a gradient."""
        refuse_trained(self)

    def __call__(self, states: Float[Tensor, "*b N D"], log_weights: Float[Tensor, "*#b N"]) -> Float[Tensor, "*b"]:
        """Entropy of each set."""
        check_shape("states", states, "(*b, N, D)", last=(self.metric.dims,))
        dims, dtype = self.metric.dims, states.dtype
        # in float64: weights of 1e-300 are weights, and of a state that has nearly all the others' share is divided by
        states, log_weights = states.double(), log_weights.double()
        unique = unique_states(states, log_weights, self.metric)
        near = neighbours(states, unique, self.metric, self.neighbours, include_self=False)
        weights = unique.log_weights.exp()
        tiny = torch.finfo(states.dtype).tiny
        k = near.used.clamp_min(1).to(states.dtype)
        effective = 1.0 / weights.square().sum(-1)
        log_share = near.mass.clamp_min(tiny).log() - _others(weights).clamp_min(tiny).log()
        alone = near.used == 0
        log_share = torch.where(alone[..., None], 0.0, log_share)
        each = dims * near.distance.clamp_min(self.floor).log() - log_share
        # with equal weights the share is k / (N - 1)
        size = effective.clamp_min(1.0 + 1e-6)
        counted = torch.where(alone, 0.0, torch.digamma(size) - (size - 1.0).log() + k.log() - torch.digamma(k))
        ball = 0.5 * dims * math.log(math.pi) - math.lgamma(0.5 * dims + 1.0)
        scale = sum(math.log(s) for s in self.metric.scales)
        return (torch.where(unique.first, weights * each, 0.0).sum(-1) + counted + ball + scale).to(dtype)


def _others(weights: Float[Tensor, "*b N"]) -> Float[Tensor, "*b N"]:
    """Weight of all but each state: 1 less its own, of the heaviest the sum of the rest, which may be far below 1."""
    heaviest = torch.zeros_like(weights).scatter(-1, weights.argmax(-1, keepdim=True), 1.0) > 0
    rest = torch.where(heaviest, 0.0, weights).sum(-1, keepdim=True)
    return torch.where(heaviest, rest, 1.0 - weights)
