"""Calibration of beliefs: coverage of credible regions, reliability of P(right), ranks of the truth.

Of many episodes whose truth was drawn from what the belief takes for granted, a region of 90 % holds the truth in 90 %,
of the times that a belief gives its best pose 0.7 it is right in 70 %, and the truth's rank among the particles is even
(simulation-based calibration; Talts, Betancourt, Simpson, Vehtari, Gelman 2018).
"""

import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.belief.particles import PoseBelief, subsample
from rumi.metrics.pose_error import pose_error
from sdf import se3, so3
from sdf.symmetry import Symmetries

SHARES = (0.5, 0.9, 0.95, 0.99)
"""Of the regions that are reported."""

_MOST = 400  # particles that neighbours are looked for among
_NEIGHBOURS = 12  # at most, and a tenth of the particles where these are few
_M, _RAD = 1e-3, math.radians(1.5)  # that count as equal distances where place and turn are one
_SAME = 1e-6  # metres or radians by which a coordinate that is held does not differ
_COORDINATES = ("x", "y", "z", "turn x", "turn y", "turn z")
_DRAWS = 200  # of who is right by chance
_LEAST, _MOST_NATS, _HALVES = 1e-3, 30.0, 60  # of a fit of odds: least P(right), log-odds, bisections


class CheckedBelief(NamedTuple):
    """A belief held against the truth.

    Attributes:
        p_right: its own probability that its best pose is right.
        right: whether it is.
        place, turn, both: shares of the belief at denser places than the truth's, by place, by turn and by both: a
            region of 90 % holds the truth where it is up to 0.9.
        ranks: by coordinate that is not held, the share of the belief below the truth.
    """

    p_right: float
    right: bool
    place: float
    turn: float
    both: float
    ranks: dict[str, float]


def checked(
    belief: PoseBelief, truth: Float[Tensor, "4 4"], symmetries: Symmetries, *, within_m: float, within_rad: float
) -> CheckedBelief:
    """Hold one scene's belief against the truth, modulo the object's symmetries.

    Density is that of the distance to a close neighbour (the twelfth, of 120 particles or more), 1 mm as 1.5 degrees.

    Args:
        belief: of one scene; of more than 400 particles, 400 that stand for equal shares.
        truth: world_T_object.
        symmetries: turns after which the object looks the same.
        within_m: metres from the truth that count as right, and
        within_rad: radians.
    """
    belief = subsample(belief, _MOST).to("cpu", torch.float64)
    truth, own = truth.detach().to("cpu", torch.float64), symmetries.to(torch.float64)
    p_right = belief.probability_right(own, within_m=within_m, within_rad=within_rad)
    metres, radians = pose_error(belief.mode(), truth, own)
    poses, weights = se3.renormalised(belief.world_T_object), belief.log_weights.softmax(-1)
    count = len(poses)
    every = torch.cat((poses, truth[None]))
    shape = (count + 1, count + 1, 4, 4)
    place, turn = pose_error(every[:, None].expand(shape), every[None].expand(shape), own)
    both = torch.hypot(place / _M, turn / _RAD)
    of_place, of_turn, of_both = (_level(part, weights) for part in (place, turn, both))
    right = float(metres) <= within_m and float(radians) <= within_rad
    return CheckedBelief(
        p_right, right, of_place, of_turn, of_both, _ranks(poses, weights, own.nearest(truth.expand_as(poses), poses))
    )


def covered(levels: Sequence[float], share: float) -> float:
    """Share of the truths that regions of a share hold; NaN of none."""
    return sum(level <= share for level in levels) / len(levels) if levels else math.nan


class ReliabilityBin(NamedTuple):
    """Beliefs of like P(right): how many, their mean P(right), and the share that is right."""

    beliefs: int
    p_right: float
    right: float


def reliability(p_right: Sequence[float], right: Sequence[bool], bins: int = 10) -> list[ReliabilityBin]:
    """Bins of even width in which there is something."""
    found = []
    for k in range(bins):
        own = [(p, good) for p, good in zip(p_right, right, strict=True) if k <= min(p * bins, bins - 1e-9) < k + 1]
        if own:
            sums = [sum(column) / len(own) for column in zip(*own, strict=True)]
            found.append(ReliabilityBin(len(own), *sums))
    return found


def calibration_error(p_right: Sequence[float], right: Sequence[bool], bins: int = 10) -> float:
    """Expected calibration error: mean difference between P(right) and the share that is right, over bins."""
    found = reliability(p_right, right, bins)
    return sum(own.beliefs * abs(own.p_right - own.right) for own in found) / max(1, len(p_right))


def chance_error(p_right: Sequence[float], *, groups: Sequence[Hashable] | None = None) -> float:
    """The calibration error that as many, perfectly calibrated, have by chance: mean over draws of who is right.

    Args:
        p_right: of the beliefs.
        groups: of each belief. Those of one group are right together, as those of an episode between two contacts
            are, which are the same belief looked at again; by default each is right by itself.
    """
    p, of = torch.tensor(p_right, dtype=torch.float64), _numbered(range(len(p_right)) if groups is None else groups)
    random = torch.Generator().manual_seed(0)
    total = 0.0
    for _ in range(_DRAWS):
        right = torch.rand(len(of.unique()), generator=random, dtype=torch.float64)[of] < p
        total += calibration_error(p_right, right.tolist())
    return total / _DRAWS


class OddsRatio(NamedTuple):
    """Odds of being right over those of P(right), and where they are a standard deviation lower and higher."""

    ratio: float
    low: float
    high: float


def fitted_odds(
    p_right: Sequence[float], right: Sequence[bool], *, groups: Sequence[Hashable] | None = None
) -> OddsRatio | None:
    """The one factor of the odds of P(right) by which it fits best who is right: Platt's scaling with a slope of 1.

    By maximum likelihood; the deviation is a sandwich estimate that takes groups, not beliefs, for independent.

    Args:
        p_right: of the beliefs; beyond .001 and .999 they count as these, since no odds would do.
        right: whether each is.
        groups: of each belief, such as its episode; by default each stands alone.

    Returns:
        None where all are right, or none.
    """
    if all(right) or not any(right):
        return None
    logit = torch.tensor(p_right, dtype=torch.float64).clamp(_LEAST, 1.0 - _LEAST).logit()
    good = torch.tensor(right, dtype=torch.float64)
    low, high = -_MOST_NATS, _MOST_NATS
    for _ in range(_HALVES):
        middle = 0.5 * (low + high)
        more = float((good - (logit + middle).sigmoid()).sum()) > 0
        low, high = (middle, high) if more else (low, middle)
    told = (logit + middle).sigmoid()
    of = _numbered(range(len(right)) if groups is None else groups)
    score = torch.zeros_like(good).index_add(0, of, good - told)  # of each group; there are no more than beliefs
    deviation = float(score.square().sum().sqrt() / (told * (1.0 - told)).sum())
    return OddsRatio(*(math.exp(min(middle + step, _MOST_NATS)) for step in (0.0, -deviation, deviation)))


def rank_test(ranks: Sequence[float], bins: int = 10) -> float:
    """P-value of Pearson's chi-squared test that ranks in [0, 1] are even; they must be independent, 5 a bin or more.

    Raises:
        ValueError: there are none.
    """
    if not ranks:
        raise ValueError("Expected one rank or more, got none")
    counts = torch.bincount((torch.tensor(ranks, dtype=torch.float64) * bins).long().clamp(0, bins - 1), minlength=bins)
    expected = len(ranks) / bins
    square = (counts.double() - expected).square().sum() / expected
    return float(torch.special.gammaincc(torch.tensor(0.5 * (bins - 1), dtype=torch.float64), 0.5 * square))


def _numbered(groups: Sequence[Hashable]) -> Int[Tensor, "N"]:
    """The group of each belief by a number, in the order in which they come."""
    place = {name: k for k, name in enumerate(dict.fromkeys(groups))}
    return torch.tensor([place[name] for name in groups], dtype=torch.long)


def _level(apart: Float[Tensor, "N1 N1"], weights: Float[Tensor, "N"]) -> float:
    """Weight of the particles that have their neighbours nearer than the truth, the last row, has its own.

    The truth is a neighbour as one particle is, so that all stand alike where it is drawn as they are.
    """
    count = len(weights)
    if count == 1:
        return float(apart[-1, 0] > _SAME)
    apart = apart.clone().fill_diagonal_(torch.inf)  # nothing is its own neighbour
    order = apart.argsort(-1)
    mass = torch.cat((weights, weights.square().sum()[None]))[order].cumsum(-1)
    wanted = min(_NEIGHBOURS, max(1, count // 10)) / count
    place = (mass >= wanted - 1e-12).to(torch.uint8).argmax(-1, keepdim=True)
    radius = apart.gather(-1, order).gather(-1, place)[:, 0]
    return float(weights[radius[:-1] < radius[-1]].sum())


def _ranks(
    poses: Float[Tensor, "N 4 4"], weights: Float[Tensor, "N"], truth: Float[Tensor, "N 4 4"]
) -> dict[str, float]:
    turned = so3.log(poses[:, :3, :3] @ truth[:, :3, :3].transpose(-1, -2))
    apart = torch.cat((poses[:, :3, 3] - truth[:, :3, 3], turned), -1)
    below = weights @ ((apart < -_SAME).double() + 0.5 * (apart.abs() <= _SAME).double())
    free = (apart.abs() > _SAME).any(0)
    return {name: float(below[k]) for k, name in enumerate(_COORDINATES) if bool(free[k])}
