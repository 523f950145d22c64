"""Whether any trajectory explains what was sensed: a bound on the p-value of the readings' likelihood at the best one.

A belief of particles is sure where they agree, right or not. Whether one of them explains the readings is another
question, that of a goodness of fit: how probable are readings as unlikely as these where the particle is right. The
bound is Chernoff's, log P(L <= t) <= s t + log E exp(-s L) for every s from 0 to 1, with readings of the sensor model
themselves in L; it asks for no tables and no draws, and holds for readings that are fewer than their points.
"""

import functools
import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.trajectory_history import Kind
from rumi.belief.trajectory_settings import PoseTrajectorySettings

_POWERS = tuple(0.05 * k for k in range(1, 20))  # s, of which the best is taken
_OF_A_MOTION = 6.0  # felt points that a sensed motion counts as, whose errors in six numbers are normal ones
_NODES, _FAR = 4001, 8.0  # of the normal deviate that a reading is off, and how far


def log_chance(now: Trajectories, log_weights: Float[Tensor, "N"], own: PoseTrajectorySettings) -> float:
    """Log of the p-value, an upper bound, of the readings at the particle that explains them best, at most 0.

    Looked at from every segment on to the last: what was sensed long ago, and fits, hides nothing that came later. The
    least of these p-values counts as many times as there are segments (Bonferroni).

    Args:
        now: particles with what was done and sensed.
        log_weights: of them; those that are ruled out explain nothing.
        own: of the sensors.
    """
    segments = len(now.history)
    if not segments:
        return 0.0
    alive = log_weights > -math.inf
    gained = now.log_likelihood[alive].flip(-1).cumsum(-1).flip(-1).amax(0)
    worth = now.history.worth()
    worth[:, Kind.FELT] += _OF_A_MOTION * now.history.motion_power
    worth = worth.flip(0).cumsum(0).flip(0)
    powers = gained.new_tensor(_POWERS)
    bounds = powers[:, None] * gained + (worth @ _log_moments(own).mT).mT
    return min(0.0, float(bounds.amin()) + math.log(segments))


@functools.cache
def _log_moments(own: PoseTrajectorySettings) -> Float[Tensor, "powers kinds"]:
    """Log E exp(-s log-likelihood) of a reading of each kind, where the particle is right, at most."""
    off = torch.linspace(-_FAR, _FAR, _NODES, dtype=torch.float64)
    density = (-0.5 * off.square()).exp()
    density = density / density.sum()
    within = (own.outliers + (1.0 - own.outliers) * (-0.5 * off.square()).exp()).log()
    rows = []
    for power in _POWERS:
        points = (1.0 - own.outliers) * (density @ (-power * within).exp()) + own.outliers ** (1.0 - power)
        bit = power * math.log(2.0)  # sum of p^(1 - s) over both outcomes, greatest where both are as likely
        rows.append([bit if kind >= Kind.PAD_FELT else float(points.log()) for kind in Kind])
    return torch.tensor(rows, dtype=torch.float64)
