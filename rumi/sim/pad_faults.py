"""Errors of simulated tactile pads: dead zones, missed touches and false ones, drawn by seed."""

from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.seeding import split
from rumi.sim.error_settings import PadErrors

_FALSE_POINTS = 12  # of a touch that there is none of


class PadDraws(NamedTuple):
    """What goes wrong in an action, by instants and the two pads.

    Attributes:
        missed: (K, 2), where a pad feels nothing.
        false: (K, 2), where it feels what is not there.
        where: (K, 2), in [0, 1), about which of its points that is.
    """

    missed: Bool[Tensor, "K 2"]
    false: Bool[Tensor, "K 2"]
    where: Float[Tensor, "K 2"]

    def at(self, instant: int) -> Self:
        """Those of one instant."""
        return type(self)(*(part[instant : instant + 1] for part in self))


class PadFaults:
    """What keeps pads from feeling what is there, and makes them feel what is not.

    A reading is what one pad reports at one instant.

    Args:
        errors: how often.
        pads: (n, 3), points of both pads, tool frame; those of one lie at y > 0.
        seed: of the run.
    """

    def __init__(self, errors: PadErrors, pads: Float[Tensor, "n 3"], seed: int) -> None:
        self.errors, self._pads = errors, pads
        self._generator = split(seed, "pads")
        self.dead = _dead(errors, pads, split(seed, "dead zones"))
        """(n), points that never feel."""
        first = pads[:, 1] > 0
        self._own = torch.stack((first, ~first))

    def drawn(self, instants: int) -> PadDraws:
        """What goes wrong in an action of as many instants, whatever is there."""
        shape = (instants, len(self._own))
        missed = torch.rand(shape, generator=self._generator) < self.errors.missed
        false = torch.rand(shape, generator=self._generator) < self.errors.false
        return PadDraws(missed, false, torch.rand(shape, generator=self._generator))

    def felt(self, touched: Bool[Tensor, "K n"], draws: PadDraws) -> Bool[Tensor, "K n"]:
        """What is reported where `touched` would be, in the first K instants of those that were drawn for."""
        if not bool(touched.any() | draws.false.any()):
            return touched
        found = touched & ~(draws.missed[: len(touched), :, None] & self._own).any(1)
        for instant, pad in draws.false[: len(touched)].nonzero().tolist():
            own = self._own[pad].nonzero()[:, 0]
            middle = self._pads[own[int(draws.where[instant, pad] * len(own))]]
            near = (self._pads[own] - middle).norm(dim=-1).topk(min(_FALSE_POINTS, len(own)), largest=False).indices
            found[instant, own[near]] = True
        return found & ~self.dead


def _dead(errors: PadErrors, pads: Float[Tensor, "n 3"], generator: torch.Generator) -> Bool[Tensor, "n"]:
    """Round patches about random points, as many as it takes for their share; the last one is as large as is left."""
    dead = torch.zeros(len(pads), dtype=torch.bool)
    most = round(errors.dead * len(pads))
    for middle in torch.randperm(len(pads), generator=generator).tolist():
        left = most - int(dead.sum())
        if left <= 0:
            break
        away = (pads - pads[middle]).norm(dim=-1)
        patch = ((away <= errors.patch_m) & ~dead).nonzero()[:, 0]
        dead[patch[away[patch].argsort()[:left]]] = True
    return dead
