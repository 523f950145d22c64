"""Likelihood tempering: new readings count by a power that grows to 1, with resampling and moves (Del Moral, 2006)."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.trajectory_moves import Moves
from rumi.errors import DegenerateBeliefError
from rumi.resampling import resample_systematic
from rumi.weights import effective_sample_size


def in_full(
    now: Trajectories, power: float, moves: Moves, random: torch.Generator, *, rounds: int, whole: bool
) -> Trajectories:
    """Particles moved and resampled until the last segment's readings count in full.

    Args:
        now: equally weighted, the last segment's readings counted by a power.
        power: this power.
        moves: of the particles, under their whole history.
        random: of the draws.
        rounds: of moves once the readings count in full; before there is one a stage.
        whole: whether the last moves are from the start.
    """
    history = now.history
    while True:
        # what comes before the last stage is moved on in any case
        last = power == 1.0
        now = moves.sweep(now, history.tempered(power), whole=whole and last, rounds=rounds if last else 1)
        if last:
            return now
        gained = now.log_likelihood[:, -1] / power
        flat = torch.zeros_like(gained)
        more = power_of(flat, gained, power, 0.5 * len(now))
        now = replace(now, log_evidence=now.log_evidence + log_mean(flat, (more - power) * gained))
        now = now.at(resample_systematic((more - power) * gained, generator=random))
        now, power = raised(now, more / power), more


def raised(now: Trajectories, power: float) -> Trajectories:
    """Particles whose last segment's likelihood is raised to a power."""
    scaled = now.log_likelihood.clone()
    scaled[:, -1] *= power
    return replace(now, log_likelihood=scaled)


def log_mean(log_weights: Float[Tensor, "N"], gained: Float[Tensor, "N"]) -> float:
    """Log of the weighted mean of likelihoods: what a reading adds to the log marginal likelihood."""
    return float(torch.logsumexp(log_weights + gained, -1) - torch.logsumexp(log_weights, -1))


def check_finite(gained: Float[Tensor, "N"]) -> None:
    """Refuse likelihoods that are none."""
    if not bool(torch.isfinite(gained).all()):
        raise DegenerateBeliefError("Expected finite likelihoods, got NaN or infinity: check the reading's points")


def power_of(log_weights: Float[Tensor, "N"], gained: Float[Tensor, "N"], least: float, wanted: float) -> float:
    """Greatest power up to 1 of new readings that leaves an effective sample size, by bisection.

    Args:
        log_weights: of the particles, in which the readings count with the power `least`.
        gained: log-likelihood of the readings.
        least: power so far.
        wanted: effective sample size, where the weights have it now; else nine tenths of what they have.
    """
    wanted = min(wanted, 0.9 * float(effective_sample_size(log_weights)))
    low, high = least, 1.0
    if float(effective_sample_size(log_weights + (high - least) * gained)) >= wanted:
        return 1.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        enough = float(effective_sample_size(log_weights + (middle - least) * gained)) >= wanted
        low, high = (middle, high) if enough else (low, middle)
    return min(1.0, max(low, least + 1e-3 * (1.0 - least) + 1e-6, math.nextafter(least, 1.0)))
