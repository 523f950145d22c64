"""States of the rollouts that touch the object, as the plain version of RUMI's push model carries them on."""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass
class Touched:
    """Rollouts that touch the object, sorted by when they first do; changed in place as they are carried on."""

    sample: Int[Tensor, "R"]
    start: Int[Tensor, "R"]
    controls: Float[Tensor, "R H A"]
    draws: Float[Tensor, "R S"]
    now: Float[Tensor, "R Q"]
    way: Float[Tensor, "R Q"]  # free motion of a mini step
    offset: Float[Tensor, "R 3"]
    strayed: Bool[Tensor, "R"]  # was held up, hence off the free path
    stuck: Bool[Tensor, "R"]  # held up, and would be again at every mini step left of this step, or at its end

    @classmethod
    def at_first_contact(
        cls,
        path: Float[Tensor, "K S1 Q"],
        controls: Float[Tensor, "K H A"],
        draws: Float[Tensor, "KM S"],
        start: Int[Tensor, "KM"],
        rows: Int[Tensor, "R"],
    ) -> Self:
        """Rollouts `rows` at the start of the mini step in which each first touches, on the free path until then."""
        sample, first = rows // (len(draws) // len(path)), start[rows]
        now, no = path[sample, first], torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        way = path[sample, first + 1] - now
        offset = torch.zeros_like(now[:, :3])
        return cls(sample, first, controls[sample], draws[rows], now, way, offset, no, no.clone())
