"""The pose filter with evidence that is no points: it counts as the prior does, wherever poses are weighed."""

import copy
from dataclasses import replace
from typing import Self

from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.filter import PoseFilter
from rumi.belief.particles import PoseBelief
from sensors.evidence import Evidence
from sensors.observation import Observation


class FusedFilter(PoseFilter):
    """A `PoseFilter` whose discrepancies hold, beside points and prior, -log L / lambda of further evidence.

    Eq 10 then gives all of it its own weight, exp(-lambda C) times L, in weighing, resampling and drawing anew. The
    descent of poses follows the points alone.
    """

    evidence: Evidence | None = None

    @classmethod
    def of(cls, plain: PoseFilter) -> Self:
        """With the settings of another; it needs a prior.

        Raises:
            ValueError: it has none.
        """
        if plain.prior is None:
            raise ValueError("Expected a filter with a prior, beside which further evidence counts, got none")
        return cls(plain.discrepancy, plain.search, plain.settings, plain.prior, plain.pushed)

    def with_evidence(self, evidence: Evidence) -> Self:
        """The same filter with this evidence, which stands in the frame that rides with the object."""
        other = copy.copy(self)
        other.evidence = evidence
        return other

    def prior_part(self, attached_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """The discrepancy that prior and further evidence amount to."""
        part = super().prior_part(attached_T_object)
        if self.evidence is None:
            return part
        return part - self.evidence.log_likelihood(attached_T_object) / self.settings.peakiness

    def weigh(
        self, belief: PoseBelief, before: PoseBelief, memory: Observation, added: Observation, moved: Bool[Tensor, "*b"]
    ) -> PoseBelief:
        """Weights by all there is: new evidence changes the discrepancy without new points."""
        total = self.total(belief, memory)
        return self._weighted(replace(belief, discrepancy=total), total - before.discrepancy)
