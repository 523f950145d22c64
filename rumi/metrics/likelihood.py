"""How likely the belief makes the true surface, and how likely it thinks its own (RUMI, Eqs 2, 33-36)."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from sdf import se3
from sdf.base import SDF
from sdf.posed import posed_distance
from sensors.semantics import log_surface_probability


def negative_log_likelihood(
    world_T_object: Float[Tensor, "*b N 4 4"],
    log_weights: Float[Tensor, "*b N"],
    truth: Float[Tensor, "*b 4 4"],
    surface_points_o: Float[Tensor, "S 3"],
    sdf: SDF,
    sharpness: float = 100.0,
    tolerance: float = 0.003,
) -> Float[Tensor, "*b"]:
    """Nll of the true surface under the belief, nats, 0 or more (RUMI, Eqs 34-36).

    `-sum_x log sum_i w_i p(surface | sdf(T_i T*^-1 x))` over object-frame surface points x; the paper prints T*
    for T*^-1. Computed by logsumexp, so that no belief gives infinity.
    """
    points_w = se3.apply(truth, surface_points_o.to(truth).expand(*truth.shape[:-2], *surface_points_o.shape))
    distance = posed_distance(sdf, world_T_object, points_w)
    log = log_surface_probability(distance, sharpness, tolerance) + log_weights[..., None]
    return -torch.logsumexp(log, dim=-2).sum(-1)


class SelfAgreement(NamedTuple):
    """How much a belief agrees with itself.

    Attributes:
        expected_nll: (*b), the nll that the belief expects if it is right: sum_j w_j nll(T_j), nats.
        apc: (*b), average pairwise chamfer distance of the particles, unweighted, metres (RUMI, Eq 33).
    """

    expected_nll: Float[Tensor, "*b"]
    apc: Float[Tensor, "*b"]


def self_agreement(
    belief: PoseBelief,
    surface_points_o: Float[Tensor, "S 3"],
    sdf: SDF,
    *,
    nll_points: int = 500,
    sharpness: float = 100.0,
    tolerance: float = 0.003,
) -> SelfAgreement:
    """Expected nll and APC from one table sdf(T_i W_j x) over all pairs of particles.

    Eq 33 prints T_i^-1 T_j; with T world to object it is T_i T_j^-1. The distances are not symmetric in i and
    j, so that all pairs are needed.

    Args:
        belief: the particles.
        surface_points_o: (S, 3), a sample of the object's surface; its size sets the cost, P^2 S look-ups.
        sdf: the object's signed distance function.
        nll_points: number of points that the expected nll is scaled to, so that it compares with an nll over as
            many whatever the sample's size.
        sharpness: of the sensor model, 1/m.
        tolerance: of the sensor model, m.
    """
    pose = belief.attached_T_object
    points = surface_points_o.to(pose)
    batch, count = pose.shape[:-3], pose.shape[-3]
    everywhere = se3.apply(pose, points.expand(*batch, count, *points.shape)).reshape(*batch, -1, 3)
    distance = posed_distance(sdf, pose, everywhere).reshape(*batch, count, count, len(points))
    log = log_surface_probability(distance, sharpness, tolerance)
    log_mixture = torch.logsumexp(log + belief.log_weights[..., :, None, None], dim=-3)
    nll = -log_mixture.sum(-1) * (nll_points / max(len(points), 1))
    return SelfAgreement((belief.weights * nll).sum(-1), distance.abs().mean(dim=(-3, -2, -1)))
