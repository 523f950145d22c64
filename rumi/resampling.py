"""Systematic resampling of weighted particles, as pure functions of the log-weights."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.seeding import Generators, uniform


def systematic(
    log_weights: Float[Tensor, "*b N"],
    offset: Float[Tensor, "*b"] | float,
    count: int | None = None,
    *,
    raw: bool = False,
) -> Int[Tensor, "*b count"]:
    """Systematic resampling: the particles under the comb (k + offset) / count, in order.

    Args:
        log_weights: (*b, N), need not be normalised; at least one finite a row.
        offset: (*b), in [0, 1); 0.5 puts each tooth in the middle of its share.
        count: teeth of the comb; N by default.
        raw: cumulate the weights without dividing by their sum, and let a tooth on a border pick the particle before
            it. Of equal weights, whose borders teeth meet, it picks others: grasps on record were chosen so.

    Returns:
        indices of particles (*b, count).
    """
    size = log_weights.shape[-1]
    count = size if count is None else count
    # float64: the cumulated sum of float32 weights ends a few 1e-7 off 1, enough to move a tooth
    cumulated = torch.softmax(log_weights.double(), -1).cumsum(-1)
    if not raw:
        cumulated = cumulated / cumulated[..., -1:]
    offset = torch.as_tensor(offset, dtype=torch.float64, device=log_weights.device).expand(log_weights.shape[:-1])
    comb = (torch.arange(count, device=log_weights.device, dtype=torch.float64) + offset[..., None]) / count
    return torch.searchsorted(cumulated.contiguous(), comb.contiguous(), right=not raw).clamp_max(size - 1)


def resample_systematic(
    log_weights: Float[Tensor, "*b N"], count: int | None = None, *, generator: Generators
) -> Int[Tensor, "*b count"]:
    """Systematic resampling with a random offset a row."""
    offset = uniform(log_weights.shape[:-1], generator=generator, device=log_weights.device, dtype=torch.float64)
    return systematic(log_weights, offset, count)
