"""The pose filter with evidence that is no points: it counts as the prior does, wherever poses are weighed."""

import copy
from dataclasses import replace
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.filter import PoseFilter
from rumi.belief.particles import PoseBelief
from rumi.registration.descent import retract
from rumi.registration.register import thinned
from rumi.seeding import Generators, normal
from sdf import se3
from sensors.evidence import Evidence
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

_FREE = 4000  # points that are no surface, by which poses settle
_STEPS = [(0.005 * 0.8**k, 0.1 * 0.8**k) for k in range(12)]
"""Metres and radians of the steps by which poses settle, one after the other."""


class FusedFilter(PoseFilter):
    """A `PoseFilter` whose discrepancies hold, beside points and prior, -log L / lambda of further evidence.

    Eq 10 then gives all of it its own weight, exp(-lambda C) times L, in weighing, resampling and drawing anew. The
    descent of poses follows the points alone; poses drawn anew then settle by all evidence.
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

    def settled(
        self, attached_T_object: Float[Tensor, "N 4 4"], here: Observation, *, generator: Generators
    ) -> Float[Tensor, "N 4 4"]:
        """Poses drawn anew after steps at random that are kept where all evidence together gains by them.

        Points leave them free along some ways, where a touch's normal or a signal asks for a place to the millimetre.
        """
        if self.evidence is None:
            return attached_T_object
        surface = here.of_class(Semantics.SURFACE)
        here = concatenate([here[surface], thinned(here[here.valid & ~surface], _FREE)])
        poses, cost = attached_T_object, self.cost(attached_T_object, here)
        for shift_m, turn_rad in _STEPS:
            sigma = torch.tensor([shift_m, shift_m, turn_rad]).to(poses)
            step = sigma * normal((*poses.shape[:-2], 3), generator=generator, dtype=poses.dtype, device=poses.device)
            tried = se3.renormalised(retract(poses, step, "SE(2)"))
            there = self.cost(tried, here)
            better = there < cost
            poses = torch.where(better[..., None, None], tried, poses)
            cost = torch.where(better, there, cost)
        return poses

    def weigh(
        self, belief: PoseBelief, before: PoseBelief, memory: Observation, added: Observation, moved: Bool[Tensor, "*b"]
    ) -> PoseBelief:
        """Weights by all there is: new evidence changes the discrepancy without new points."""
        total = self.total(belief, memory)
        return self._weighted(replace(belief, discrepancy=total), total - before.discrepancy)
