"""Importance weights of particles, in log-space: checks, normalisation, Boltzmann weights, effective sample size."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sdf.check import is_eager, may_look


def check_weights(log_weights: Float[Tensor, "*b N"]) -> None:
    """Refuse log-weights that weigh nothing.

    Raises:
        ValueError: there are none, a set's are all -inf, or some are NaN or +inf.
    """
    if log_weights.shape[-1] == 0:
        raise ValueError(f"Expected one state or more in each set, got log_weights {tuple(log_weights.shape)}")
    if not may_look(log_weights) or log_weights.numel() == 0:
        return
    top = log_weights.detach().amax(-1)
    if not bool(torch.isfinite(top).all()):
        bad = float(top[~torch.isfinite(top)].reshape(-1)[0])
        raise ValueError(
            f"Expected a finite log-weight in each set and none that is NaN or +inf, got {bad} as a set's greatest"
        )


def normalise(log_weights: Float[Tensor, "*b N"]) -> Float[Tensor, "*b N"]:
    """Log-weights whose exponentials sum to 1 in each set."""
    return log_weights.log_softmax(-1)


def equal_weights(like: Float[Tensor, "*b N"] | int) -> Float[Tensor, "*b N"]:
    """Log-weights -log N, as after a resampling.

    Args:
        like: log-weights of as many particles; or N, for float64 on the CPU.
    """
    return normalise(torch.zeros(like, dtype=torch.float64) if isinstance(like, int) else torch.zeros_like(like))


def resampled_weights(log_weights: Float[Tensor, "*b N"], index: Int[Tensor, "*b N"]) -> Float[Tensor, "*b N"]:
    """Log-weights -log N of the particles `index`, with the slope of the weights that they were drawn by.

    Stop-gradient resampling (Scibior and Wood, arXiv 2106.10314): each weight is multiplied by w / stop(w), which is 1
    and has the slope of log w. The gradient of an expectation is then that of the weighted particles, though which of
    them were drawn has none. Where no graph is kept the weights are equal to the bit.
    """
    equal = equal_weights(log_weights)
    if is_eager() and not log_weights.requires_grad:
        return equal
    kept = log_weights.gather(-1, index)
    return equal + (kept - kept.detach())


def boltzmann(discrepancy: Float[Tensor, "*b N"], peakiness: float | Tensor) -> Float[Tensor, "*b N"]:
    """Log-weights -lambda C of discrepancies (RUMI, Eq 10), not normalised: the best particle's is 0.

    Differences of discrepancies are exact or nearly so, products of large ones with lambda are not: taken first they
    keep the weights right in float32 however large the discrepancies are.
    """
    return -peakiness * (discrepancy - discrepancy.amin(-1, keepdim=True))


def effective_sample_size(log_weights: Float[Tensor, "*b N"]) -> Float[Tensor, "*b"]:
    """Effective sample size, (sum w)^2 / sum w^2, between 1 and N, of log-weights that need not be normalised."""
    # float64, and of weights that need not sum to 1 to the last digit: else it may come out well above N
    log = log_weights.double()
    log = log - log.amax(-1, keepdim=True)
    size = (2.0 * torch.logsumexp(log, -1) - torch.logsumexp(2.0 * log, -1)).exp()
    return size.clamp(1.0, float(log.shape[-1])).to(log_weights.dtype)
