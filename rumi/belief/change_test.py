"""Sequential change detection by e-values: has something gone wrong since some earlier reading, and what.

Every reading brings, for each of K alternatives, a log-likelihood ratio log q_k(reading | past) - log p(reading | past)
of its predictive densities with the fault and without. If p is right, each ratio has a conditional mean of at most 1,
whatever q is: so has any power of it in (0, 1], and so has a ratio that is capped. Sums over unknown onsets of products
of ratios are then (super)martingales, and their bounds hold at every reading at once, however long one looks:

- "run": onsets have the prior 1 / (n (n + 1)), and Ville's inequality has a faultless run raise an alarm, ever, with
  probability `alpha` at most (Ville 1939; Ramdas, Grunwald, Vovk, Shafer 2023).
- "rate": every onset counts 1 (Shiryaev-Roberts), and the mean number of faultless readings to an alarm is at least
  1 / alpha (Shin, Ramdas, Rinaldo 2023, e-detectors). CUSUM, their greatest term, is at most this sum.

Both need p alone to be right: a p that is too narrow (belief or sensor surer than they should be) raises alarms. All in
float64 and log-space.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

Bound = Literal["run", "rate"]
MOST = 1e6
"""Nats of one ratio, at most: a reading that p rules out; lowering a ratio keeps every bound."""


class ChangeEvidence(NamedTuple):
    """Evidence of some runs, each reading taken in.

    Attributes:
        log_sum: (*b, K), log of the sum over onsets of prior times product of ratios, for each alternative.
        log_moment: (*b, K), the same with every onset's number as a factor.
        readings: (*b), how many.
    """

    log_sum: Float[Tensor, "*b K"]
    log_moment: Float[Tensor, "*b K"]
    readings: Int[Tensor, "*b"]


@dataclass(frozen=True)
class ChangeTest:
    """A test of "no fault so far" against K alternatives, each with an unknown onset; holds no evidence.

    Attributes:
        weights: prior share of each alternative, above 0; taken as shares of their sum.
        alpha: of "run", the chance that a faultless run ever raises an alarm; of "rate", the inverse of the mean number
            of faultless readings to one.
        bound: which of the two is held.
    """

    weights: tuple[float, ...] = (1.0,)
    alpha: float = 0.01
    bound: Bound = "run"

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        if not self.weights or not all(0 < weight < math.inf for weight in self.weights):
            raise ValueError(f"Expected a weight above 0 for each of one alternative or more, got {self.weights}")
        if not 0 < self.alpha < 1:
            raise ValueError(f"Expected alpha between 0 and 1, got {self.alpha}")
        if self.bound not in get_args(Bound):
            raise ValueError(f"Expected bound to be one of {', '.join(get_args(Bound))}, got {self.bound!r}")

    @property
    def threshold(self) -> float:
        """Evidence, nats, at which an alarm is raised."""
        return -math.log(self.alpha)

    def begin(self, *batch: int) -> ChangeEvidence:
        """No reading yet."""
        empty = torch.full((*batch, len(self.weights)), -torch.inf, dtype=torch.float64)
        return ChangeEvidence(empty, empty, torch.zeros(batch, dtype=torch.int64))

    def update(self, evidence: ChangeEvidence, log_ratios: Float[Tensor, "*b K"]) -> ChangeEvidence:
        """Take in a reading.

        Args:
            evidence: before it.
            log_ratios: log q_k - log p of it, nats; -inf where an alternative rules it out, +inf where p does.

        Raises:
            ValueError: a ratio is NaN, or there is not one for each alternative.
        """
        ratios = torch.as_tensor(log_ratios).double()
        if ratios.shape != evidence.log_sum.shape:
            raise ValueError(
                f"Expected log_ratios as {tuple(evidence.log_sum.shape)}, one for each alternative, "
                f"got {tuple(ratios.shape)}"
            )
        if bool(ratios.isnan().any()):
            raise ValueError(
                "Expected log_ratios without NaN: where both densities are 0 a reading tells nothing, give 0"
            )
        ratios = ratios.clamp_max(MOST)
        number = (evidence.readings + 1).double()[..., None]
        begun = torch.zeros_like(number) if self.bound == "rate" else -number.log() - (number + 1.0).log()
        return ChangeEvidence(
            torch.logaddexp(evidence.log_sum, begun.expand_as(ratios)) + ratios,
            torch.logaddexp(evidence.log_moment, (begun + number.log()).expand_as(ratios)) + ratios,
            evidence.readings + 1,
        )

    def log_evidence(self, evidence: ChangeEvidence) -> Float[Tensor, "*b"]:
        """Nats against "no fault so far"; an alarm is due from `threshold` on."""
        terms = self.log_weights + evidence.log_sum
        if self.bound == "rate":
            return torch.logsumexp(terms, -1)
        later = -(evidence.readings + 1.0).double().log()  # prior of an onset yet to come
        return torch.logsumexp(torch.cat((terms, later[..., None]), -1), -1)

    def alarm(self, evidence: ChangeEvidence) -> Tensor:
        """Whether an alarm is due, (*b)."""
        return self.log_evidence(evidence) >= self.threshold

    def explanations(self, evidence: ChangeEvidence) -> Float[Tensor, "*b K1"]:
        """Posterior probability of "no fault so far" (the first) and of each alternative.

        Of "rate", in which onsets have no prior that sums to 1, each onset weighs as much as no fault at all.
        """
        none = torch.zeros_like(evidence.log_sum[..., :1])
        if self.bound == "run":
            none = none - (evidence.readings + 1.0).double().log()[..., None]
        return torch.cat((none, self.log_weights + evidence.log_sum), -1).softmax(-1)

    def onset(self, evidence: ChangeEvidence) -> Float[Tensor, "*b K"]:
        """Posterior mean of the number of the first reading with a fault, from 1 on, were it each alternative.

        The last reading's where an alternative is ruled out.
        """
        last = evidence.readings.double()[..., None].expand_as(evidence.log_sum)
        ruled_out = evidence.log_sum.isneginf()
        off = torch.where(ruled_out, 0.0, evidence.log_moment - torch.where(ruled_out, 0.0, evidence.log_sum))
        return torch.where(ruled_out, last, off.exp())

    @cached_property
    def log_weights(self) -> Float[Tensor, "K"]:
        """Of the alternatives, normalised."""
        return torch.tensor(self.weights, dtype=torch.float64).log().log_softmax(-1)
