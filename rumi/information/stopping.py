"""Stopping rules: when a belief is sure enough.

By its covariance, its entropy, the mass of target points within a tolerance, or by what it expects of itself (RUMI).
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import torch
from annotated_types import Ge, Interval
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.information.entropy import Entropy
from rumi.registry import Table
from rumi.weights import check_weights
from sdf.bounds import Checked, Count, CountOr0, OneOf, Positive, Share, ShareAbove0
from sdf.check import check_shape
from sdf.so3 import wrap

_MOST_TARGETS = 4  # whose orders are all tried


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


@dataclass(frozen=True)
class EntropyRule:
    """Sure where the entropy is low.

    Attributes:
        entropy: how it is estimated; that of the weights alone falls to nothing where one particle is left.
        most_nats: that is allowed.
    """

    entropy: Entropy
    most_nats: float

    def holds(self, states: Float[Tensor, "N D"], log_weights: Float[Tensor, "N"]) -> bool:
        """Whether the belief is sure."""
        return float(self.entropy(states, log_weights)) <= self.most_nats


class TargetEstimate(NamedTuple):
    """Estimate of target points, with the probability that it is within the tolerance.

    Attributes:
        points: (K, D), metres; one point where any target will do.
        probability: that the guess is within the tolerance.
    """

    points: Float[Tensor, "K D"]
    probability: float


@dataclass(frozen=True)
class MassRule(Checked):
    """Sure where target points of the object are known within a tolerance with high probability.

    Attributes:
        tolerance_m: distance of a target from the guess.
        probability: that is asked for.
        which: "all" targets have to be near their guesses, or "any" one of them near a single guess.
        alike: targets may be taken for one another, such as the two holes of a symmetric object.
        tries: likeliest particles whose own targets are tried as guesses.
        refinements: steps from the best of them to the mean of the targets near it, as long as that is likelier.
    """

    tolerance_m: Positive
    probability: Annotated[float, Interval(gt=0.0, lt=1.0)] = 0.95
    which: Literal["all", "any"] = "all"
    alike: bool = True
    tries: Count = 200
    refinements: CountOr0 = 5

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
        if self.which == "all" and self.alike and kinds > _MOST_TARGETS:
            raise ValueError(f"Expected at most {_MOST_TARGETS} targets that are alike, got {kinds}: set alike=False")
        check_weights(log_weights)
        weights = log_weights.softmax(-1)
        likeliest = torch.argsort(log_weights, descending=True, stable=True)[: self.tries]
        orders = self._orders(targets)
        guesses = targets[likeliest]
        if self.which == "any":
            guesses = guesses.reshape(-1, 1, targets.shape[-1])
        mass = self._apart(guesses, orders).le(self.tolerance_m).amax(1).to(weights) @ weights
        first = int(mass.argmax())
        guess, best = guesses[first], float(mass[first])
        for _ in range(self.refinements):
            apart = self._apart(guess[None], orders)[0]
            nearest = apart.argmin(0)
            near = torch.where(apart.amin(0) <= self.tolerance_m, weights, 0.0)
            own = orders[nearest, torch.arange(count, device=nearest.device)]
            mean = (near[:, None, None] * own).sum(0) / near.sum()
            found = float(self._apart(mean[None], orders)[0].le(self.tolerance_m).amax(0).to(weights) @ weights)
            if found <= best:
                break
            guess, best = mean, found
        return TargetEstimate(guess, min(best, 1.0))

    def holds(self, targets: Float[Tensor, "N K D"], log_weights: Float[Tensor, "N"]) -> bool:
        """Whether the belief is sure."""
        return self.aim(targets, log_weights).probability >= self.probability

    def _orders(self, targets: Float[Tensor, "N K D"]) -> Float[Tensor, "P N J D"]:
        """The targets in each of the ways in which a guess may be held against them."""
        kinds = targets.shape[1]
        if self.which == "any":
            return targets.transpose(0, 1)[:, :, None]
        if not self.alike:
            return targets[None]
        return torch.stack([targets[:, list(order)] for order in itertools.permutations(range(kinds))])

    def _apart(self, guesses: Float[Tensor, "G J D"], orders: Float[Tensor, "P N J D"]) -> Float[Tensor, "G P N"]:
        """Greatest distance of a guess from its targets."""
        return (guesses[:, None, None] - orders).norm(dim=-1).amax(-1)


class StopEvidence(NamedTuple):
    """Evidence for a stopping rule; nothing of the truth.

    Attributes:
        expected_nll: that the belief expects of itself, nats.
        fit: least discrepancy of a particle.
        apc: average pairwise chamfer distance of the particles, metres (RUMI, Eq 33).
        diagonal: of the object's bounding box, metres.
        contacts: actions so far that touched the object.
        p_right: probability that the belief's best pose is within the task's tolerance, modulo symmetry, as its
            particles count it.
        chance: of readings as unlikely as these where the best particle is right, at most; 1 where nobody knows.
        draws: effective number of these particles.
        let_go: whether the belief was sure before the last action too, and the tool has let go of the object since.
    """

    expected_nll: float
    fit: float
    apc: float
    diagonal: float
    contacts: int
    p_right: float = math.nan
    chance: float = 1.0
    draws: float = math.inf
    let_go: bool = False

    @property
    def least_p_right(self) -> float:
        """Lower bound of `p_right`: less two standard errors of a count of so many draws.

        Whoever stops as soon as a noisy estimate is high enough stops by its noise.
        """
        return self.p_right - 2.0 * math.sqrt(max(0.0, self.p_right * (1.0 - self.p_right)) / self.draws)


StopRule = Callable[["StopSettings", StopEvidence], bool]
"""Whether the belief is sure enough to stop."""

STOP_RULES: Table[StopRule] = Table("stop rule", "rumi.stop_rules")
"""All rules by name."""


@dataclass(frozen=True)
class StopSettings(Checked, refusal=UsageError):
    """The stopping rule; it never sees the truth.

    Attributes:
        rule: "auto" is "probability" where objects are followed in space and nothing measures their motion, since
            points then ride with no one motion, else "self"; "self" stops where the expected nll is below
            `expected_nll` and some particle fits all observations (`fit`); "apc" is the paper's, APC below `apc_ratio`
            of the object's diagonal, which a mug of unknown yaw meets at once, since its handle is 6 % of its surface;
            "probability" stops where the best pose is right with a `probability`; "never" does not stop.
        expected_nll: nats over 500 points.
        fit: least discrepancy allowed, of the best particle.
        fit_a_contact: by which more is allowed for each action that touched the object: errors of its measured motion
            add up, so that what was felt before them no longer fits what is felt after them.
        contacts: actions that must have touched the object.
        apc_ratio: beta_t.
        probability: that the best pose is within the task's tolerance, as the belief has it: two standard errors of
            what its particles count have to be above it too.
        leeway: times the chance of being wrong by which "probability" may miss once the tool has let go of an object
            that the belief was sure of while they touched: what was right stays so then, what was wrong shows (tuning
            drills: of 71 with .9 and more all are right, of 3 with less one). 1 for none.
        most_nll: expected nll beyond which "probability" does not stop: poses that are all within the tolerance may lie
            too far apart for the object to count as found. None for what counts as found where the object is followed
            in space, else any.
        points_in_turn: of the points by which the belief compares itself with itself each particle takes one in so
            many, in turns, while the rule "probability" would not stop whatever came out: what is told then of a
            belief of 400 particles is off by .7 % (deviation; drills), in a quarter of the time. 1 for all of them.
        least_chance: p-value of the readings at the best particle below which no pose explains them, and no rule but
            "apc" stops; 0 asks for none.
    """

    rule: Annotated[str, OneOf(STOP_RULES)] = "auto"
    expected_nll: float = 5.0
    fit: float = 5.0
    fit_a_contact: float = 0.5
    contacts: int = 1
    apc_ratio: float = 0.03
    probability: ShareAbove0 = 0.95
    leeway: Annotated[float, Ge(1.0)] = 2.0
    most_nll: Annotated[float, Ge(0.0)] | None = None
    points_in_turn: Count = 8
    least_chance: Share = 0.01

    def probable(self, now: StopEvidence) -> float:
        """P(right) that "probability" asks for."""
        return 1.0 - (1.0 - self.probability) * (self.leeway if now.let_go else 1.0)


class Shortfall(NamedTuple):
    """A part of a stopping rule that does not hold.

    Attributes:
        part: "fit" and "chance", no pose explains the observations, by its discrepancy and by the p-value of the
            readings; "contacts", too few actions touched the object; "spread", poses that explain them differ too
            much; "nll", all are right, and differ too much; "rule", a rule without parts.
        value: of the belief.
        allowed: bound of it.
    """

    part: Literal["fit", "chance", "contacts", "spread", "nll", "rule"]
    value: float
    allowed: float


def shortfalls(settings: StopSettings, now: StopEvidence) -> tuple[Shortfall, ...]:
    """The parts of the rule of some settings that do not hold; none where it does."""
    unexplained = now.chance < settings.least_chance
    if unexplained and settings.rule in ("auto", "self", "probability"):
        return (Shortfall("chance", now.chance, settings.least_chance),)
    if settings.rule in ("auto", "self"):
        allowed = settings.fit + settings.fit_a_contact * now.contacts
        parts = (
            (now.fit < allowed, Shortfall("fit", now.fit, allowed)),
            (now.contacts >= settings.contacts, Shortfall("contacts", now.contacts, settings.contacts)),
            (now.expected_nll < settings.expected_nll, Shortfall("spread", now.expected_nll, settings.expected_nll)),
        )
        return tuple(part for holds, part in parts if not holds)
    if converged(settings, now):
        return ()
    if settings.rule == "probability":
        if now.contacts < settings.contacts:
            return (Shortfall("contacts", now.contacts, settings.contacts),)
        if now.least_p_right >= settings.probable(now):
            return (Shortfall("nll", now.expected_nll, math.inf if settings.most_nll is None else settings.most_nll),)
        return (Shortfall("spread", now.least_p_right, settings.probable(now)),)
    if settings.rule == "apc":
        return (Shortfall("spread", now.apc, settings.apc_ratio * now.diagonal),)
    return (Shortfall("rule", math.nan, math.nan),)


def _self_consistent(settings: StopSettings, now: StopEvidence) -> bool:
    return not shortfalls(settings, now)


STOP_RULES.add("auto", _self_consistent)
STOP_RULES.add("self", _self_consistent)
STOP_RULES.add("apc", lambda settings, now: now.apc < settings.apc_ratio * now.diagonal)
STOP_RULES.add(
    "probability",
    lambda settings, now: (
        now.least_p_right >= settings.probable(now)
        and (settings.most_nll is None or now.expected_nll <= settings.most_nll)
        and now.contacts >= settings.contacts
        and now.chance >= settings.least_chance
    ),
)
STOP_RULES.add("never", lambda settings, now: False)


def converged(settings: StopSettings, now: StopEvidence) -> bool:
    """Whether the rule of some settings holds."""
    return STOP_RULES[settings.rule](settings, now)


def turns(settings: StopSettings, best: StopEvidence) -> int:
    """By one of how many points each particle is compared: exactly where the stop may depend on it.

    Args:
        settings: of the rule.
        best: the evidence, were the belief to agree with itself in everything.
    """
    exact = settings.rule != "probability" or converged(settings, best)
    return 1 if exact else settings.points_in_turn
