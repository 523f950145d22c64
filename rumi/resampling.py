"""Resampling of weighted particles, as pure functions of the log-weights."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.seeding import Generators, uniform


def systematic(log_weights: Float[Tensor, "*b N"], offset: Float[Tensor, "*b"]) -> Int[Tensor, "*b N"]:
    """Systematic resampling: the particles under the comb (k + offset) / N, in order.

    Args:
        log_weights: (*b, N), need not be normalised; at least one finite a row.
        offset: (*b), in [0, 1).
    """
    count = log_weights.shape[-1]
    # float64: the cumulated sum of float32 weights ends a few 1e-7 off 1, enough to move a tooth
    cumulated = torch.softmax(log_weights.double(), -1).cumsum(-1)
    cumulated = cumulated / cumulated[..., -1:]
    comb = (torch.arange(count, device=log_weights.device, dtype=torch.float64) + offset.double()[..., None]) / count
    return torch.searchsorted(cumulated.contiguous(), comb.contiguous(), right=True).clamp_max(count - 1)


def resample_systematic(log_weights: Float[Tensor, "*b N"], *, generator: Generators) -> Int[Tensor, "*b N"]:
    """Systematic resampling with a random offset a row."""
    offset = uniform(log_weights.shape[:-1], generator=generator, device=log_weights.device, dtype=torch.float64)
    return systematic(log_weights, offset)
