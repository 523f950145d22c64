"""Expected information gain of a motion by touch: the mean divergence of the posterior from the prior.

A motion meets the object somewhere in each state, or meets nothing, and each of these is a reading.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.resampling import resample_systematic
from sdf.check import check_shape, is_eager
from sdf.sweep import Sweep
from sensors.touch.rectangle_touch import rectangle_log_likelihoods
from sensors.touch.touch_likelihood import TouchNoise


class ContactKind(IntEnum):
    """Kinds of outcome: no contact, and a contact with a point and a normal; others are told by their kind alone."""

    NOTHING = 0
    TOUCH = 1
    TOP = 2


TouchLikelihood = Callable[[Tensor, Tensor], Tensor]
"""Log-likelihood (*b, M, N) of touches, given points and normals (*b, M, D), at N states."""


class Outcomes(NamedTuple):
    """Outcomes of a motion in each state: the first contact on its way, or none.

    Attributes:
        kind: (*b, N), of `ContactKind`; all but a touch tell no more than itself.
        point: (*b, N, D), touched, metres.
        normal: (*b, N, D), outward, unit.
    """

    kind: Int[Tensor, "*b N"]
    point: Float[Tensor, "*b N D"]
    normal: Float[Tensor, "*b N D"]

    @classmethod
    def of(cls, sweep: Sweep) -> "Outcomes":
        """Of one straight way."""
        return cls(sweep.hit.long() * ContactKind.TOUCH, sweep.point, sweep.normal)


def touch_gain(
    log_weights: Float[Tensor, "N"],
    outcomes: Outcomes,
    likelihood: TouchLikelihood,
    *,
    readings: int | None = None,
    noise: TouchNoise | None = None,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "*b"]:
    """Divergence of the posterior from the prior, nats, expected over what a motion may lead to (Eqs. 6-8).

    The paper lets a motion end at its nominal contact; here it ends wherever it meets the object, and a state that it
    misses leads to a reading of nothing. No readings are simulated twice: the likelihoods alone decide.

    Args:
        log_weights: of the states.
        outcomes: of motions (*b) in each.
        likelihood: of touches.
        readings: how many are drawn, of states by weight; all states' by default, which takes O(N^2).
        noise: that drawn readings have; none by default, as in the paper, which is off to either side of the mutual
            information by how wide the belief is for the noise.
        generator: of the draws.
    """
    shape, size = outcomes.kind.shape[:-1], outcomes.kind.shape[-1]
    check_shape("log_weights", log_weights, "(N,)", last=(size,))
    if (readings is not None or noise is not None) and generator is None:
        raise ValueError("Drawn readings need a generator")
    if readings is None or generator is None:
        kind, point, normal, reading_weights = *outcomes, log_weights
    else:
        if readings < 1:
            raise ValueError(f"Expected one reading or more, got {readings}")
        index = resample_systematic(log_weights, readings, generator=generator)
        kind, point, normal = outcomes.kind[..., index], outcomes.point[..., index, :], outcomes.normal[..., index, :]
        reading_weights = log_weights.new_zeros(readings)
    if noise is not None:
        point, normal = add_noise(point, normal, noise, generator=generator)
    told = likelihood(point, normal)
    told = with_kinds(torch.where((kind == ContactKind.TOUCH)[..., None], told, 0.0), kind, outcomes.kind)
    gains = expected_divergence(log_weights.expand(*shape, size), told, reading_weights.expand(*shape, kind.shape[-1]))
    return gains


def add_noise(
    points: Float[Tensor, "*b D"],
    normals: Float[Tensor, "*b D"],
    noise: TouchNoise,
    *,
    generator: torch.Generator | None,
) -> tuple[Float[Tensor, "*b D"], Float[Tensor, "*b D"]]:
    """The same touches as a sensor with this noise reports them: points off by it, normals turned by it."""
    on = points.device if generator is None else generator.device
    place = torch.randn(points.shape, generator=generator, dtype=points.dtype, device=on).to(points)
    turn = torch.randn(normals.shape, generator=generator, dtype=normals.dtype, device=on).to(normals)
    # across the normal, and so far on that the angle is the one drawn
    across = turn - (turn * normals).sum(-1, keepdim=True) * normals
    angle = noise.normal_rad * across.norm(dim=-1, keepdim=True)
    unit = torch.nn.functional.normalize(across, dim=-1)
    return points + noise.point_m * place, angle.cos() * normals + angle.sin() * unit


def rectangle_likelihood(poses: Float[Tensor, "N 3"], half: Float[Tensor, "2"], noise: TouchNoise) -> TouchLikelihood:
    """Of touches of a rectangle at planar poses, in closed form."""

    def likelihood(points: Tensor, normals: Tensor) -> Tensor:
        return rectangle_log_likelihoods(poses, points, normals, half, noise)

    return likelihood


def divergence(log_weights: Float[Tensor, "*#b N"], log_likelihood: Float[Tensor, "*#b N"]) -> Float[Tensor, "*b"]:
    """KL divergence (*b), nats, of the posterior weights from those before (time allocation, Eq. 6).

    In the form E_post[log L] - log Z, which takes no logarithm of a weight that is 0. A reading that no state explains
    tells nothing: 0.

    Args:
        log_weights: of the states, normalised or not.
        log_likelihood: of the reading at each state, up to a constant; may be -inf.

    Raises:
        ValueError: a weight or a likelihood is NaN or infinite, or no state has any weight.
    """
    joint = log_weights.log_softmax(-1) + log_likelihood
    evidence = joint.logsumexp(-1)
    if is_eager() and bool((evidence.isnan() | (evidence == torch.inf)).any()):
        raise ValueError(
            "Expected log-weights of which one is finite and log-likelihoods that are finite or -inf, got NaN or inf: "
            "are all states, readings and their noise finite, and the noise above 0?"
        )
    possible = torch.isfinite(evidence)
    if joint.requires_grad or not is_eager():
        # a sum of nothing but exp(-inf) has no slope
        joint = torch.where(possible[..., None], joint, 0.0)
        evidence = torch.where(possible, joint.logsumexp(-1), -torch.inf)
    posterior = (joint - torch.where(possible, evidence, 0.0)[..., None]).exp()
    held = (posterior > 0) & possible[..., None]
    mean = torch.where(held, posterior * torch.where(held, log_likelihood, 0.0), 0.0).sum(-1)
    return torch.where(possible, mean - torch.where(possible, evidence, 0.0), 0.0).clamp_min(0.0)


def expected_divergence(
    log_weights: Float[Tensor, "*#b N"],
    log_likelihood: Float[Tensor, "*#b M N"],
    reading_log_weights: Float[Tensor, "*#b M"] | None = None,
) -> Float[Tensor, "*b"]:
    """Divergence (*b), nats, expected over readings (time allocation, Eq. 7), in O(M N) from the likelihoods alone.

    With M = N noise-free readings, one of each state, it is what the paper works out: no mutual information, and off
    to one side or the other by how wide the belief is for the noise. With readings that are drawn, of a state by
    weight and with noise, it is an estimate of the mutual information: take those to compare actions of different
    precision.

    Args:
        log_weights: of the states.
        log_likelihood: of reading j (rows) at state i (columns), up to a constant for each row.
        reading_log_weights: of the readings; by default the states' where M = N, else even.
    """
    readings, states = log_likelihood.shape[-2:]
    if log_weights.shape[-1] != states:
        raise ValueError(f"Expected a likelihood for each of the {log_weights.shape[-1]} states, got {states}")
    if reading_log_weights is None:
        reading_log_weights = log_weights if readings == states else log_weights.new_zeros(readings)
    weights = reading_log_weights.softmax(-1)
    return (weights * divergence(log_weights[..., None, :], log_likelihood)).sum(-1)


def with_kinds(
    log_likelihood: Float[Tensor, "*b M N"], reading_kinds: Int[Tensor, "*b M"], state_kinds: Int[Tensor, "*b N"]
) -> Float[Tensor, "*b M N"]:
    """The likelihoods where readings are of kinds, of which each state leads to one surely, and to no other.

    Args:
        log_likelihood: of the readings, their kind given.
        reading_kinds: any numbers, such as 0 for no contact.
        state_kinds: the kind that each state leads to.
    """
    same = reading_kinds[..., :, None] == state_kinds[..., None, :]
    return torch.where(same, log_likelihood, torch.full_like(log_likelihood, -torch.inf))
