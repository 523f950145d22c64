"""Coulomb friction of a pushed object, at the tool and at the floor, by what a belief knows of it."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_trajectories import PoseTrajectoryBelief
from rumi.belief.trajectory_settings import PoseTrajectorySettings

_QUANTILES = 16  # of the prior, that stand for equal shares of it


class Frictions(NamedTuple):
    """Coefficients of Coulomb friction.

    Attributes:
        tool: (N), between tool and object, of each particle.
        floor: (F), between object and floor, evenly likely and the same for every particle.
    """

    tool: Float[Tensor, "N"]
    floor: Float[Tensor, "F"]


def frictions_of(belief: PoseBelief, own: PoseTrajectorySettings) -> Frictions:
    """Frictions by a belief: at the tool what each trajectory's pushes left, at the floor the prior's quantiles.

    How an object slides does not depend on its friction with the floor, so that no push that slid it tells of it; the
    prior is the same log-normal as at the tool. Particles without trajectories have the prior's median at the tool, and
    the wide prior of any object.

    Args:
        belief: of N particles.
        own: the prior of trajectories.
    """
    like = belief.log_weights.double()
    trajectories = belief.trajectories if isinstance(belief, PoseTrajectoryBelief) else None
    if trajectories is None:
        median, deviation = own.for_others().friction
        tool = torch.full_like(like, median)
    else:
        median, deviation = own.friction
        change = trajectories.noise[:, -1, 0] if trajectories.noise.shape[1] else torch.zeros_like(like)
        tool = median * (deviation * trajectories.physics[:, 0] + own.friction_change * change).exp()
    share = (torch.arange(_QUANTILES, dtype=torch.float64) + 0.5) / _QUANTILES
    floor = median * (deviation * torch.special.ndtri(share)).exp()
    return Frictions(tool, floor.to(like))
