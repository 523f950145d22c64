"""What a motion is expected to tell by touching: where it meets the object in each state, or that it meets nothing."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.information.expected_divergence import expected_divergence, with_kinds
from rumi.resampling import resample_systematic
from sdf.check import check_shape
from sdf.mesh.triangles import Triangles
from sdf.sweep import Sweep, sweep_mesh
from sensors.touch.rectangle_touch import rectangle_log_likelihoods
from sensors.touch.touch_likelihood import TouchNoise, touch_log_likelihoods

NOTHING, TOUCH = 0, 1
"""Kinds of outcome: no contact, and a contact with a point and a normal; others are told by their kind alone."""

TouchLikelihood = Callable[[Tensor, Tensor], Tensor]
"""Log-likelihood (*b, M, N) of touches, given points and normals (*b, M, D), at N states."""


class Outcomes(NamedTuple):
    """What a motion leads to in each state, wherever on its way that is.

    Attributes:
        kind: (*b, N), `NOTHING`, `TOUCH`, or another number for what tells no more than itself.
        point: (*b, N, D), touched, metres.
        normal: (*b, N, D), outward, unit.
    """

    kind: Int[Tensor, "*b N"]
    point: Float[Tensor, "*b N D"]
    normal: Float[Tensor, "*b N D"]

    @classmethod
    def of(cls, sweep: Sweep) -> "Outcomes":
        """Of one straight way."""
        return cls(sweep.hit.long() * TOUCH, sweep.point, sweep.normal)


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
    if readings is None:
        kind, point, normal, reading_weights = *outcomes, log_weights
    else:
        if readings < 1:
            raise ValueError(f"Expected one reading or more, got {readings}")
        index = _drawn(log_weights, readings, generator)
        kind, point, normal = outcomes.kind[..., index], outcomes.point[..., index, :], outcomes.normal[..., index, :]
        reading_weights = log_weights.new_zeros(readings)
    if noise is not None:
        point, normal = noisy(point, normal, noise, generator=generator)
    told = likelihood(point, normal)
    told = with_kinds(torch.where((kind == TOUCH)[..., None], told, 0.0), kind, outcomes.kind)
    gains = expected_divergence(log_weights.expand(*shape, size), told, reading_weights.expand(*shape, kind.shape[-1]))
    return gains


def noisy(
    points: Float[Tensor, "*b D"],
    normals: Float[Tensor, "*b D"],
    noise: TouchNoise,
    *,
    generator: torch.Generator | None,
) -> tuple[Float[Tensor, "*b D"], Float[Tensor, "*b D"]]:
    """The same touches as a sensor with this noise reports them: points off by it, normals turned by it."""
    place = torch.randn(points.shape, generator=generator, dtype=points.dtype, device=points.device)
    turn = torch.randn(normals.shape, generator=generator, dtype=normals.dtype, device=normals.device)
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


def mesh_likelihood(world_T_object: Float[Tensor, "N 4 4"], triangles: Triangles, noise: TouchNoise) -> TouchLikelihood:
    """Of touches of any mesh at poses in SE(3)."""

    def likelihood(points: Tensor, normals: Tensor) -> Tensor:
        flat = touch_log_likelihoods(world_T_object, points.reshape(-1, 3), normals.reshape(-1, 3), triangles, noise)
        return flat.mT.reshape(*points.shape[:-1], len(world_T_object))

    return likelihood


def mesh_touch_gain(
    world_T_object: Float[Tensor, "N 4 4"],
    log_weights: Float[Tensor, "N"],
    triangles: Triangles,
    start: Float[Tensor, "*b 3"],
    end: Float[Tensor, "*b 3"],
    radius: float,
    noise: TouchNoise,
    *,
    readings: int | None = None,
    sampled: bool = False,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "*b"]:
    """What straight motions of a ball are expected to tell of where a mesh is, nats.

    Args:
        world_T_object: poses of the particles.
        log_weights: of them.
        triangles: of the mesh.
        start: of the ball's centre, outside of the object.
        end: of its way; the ball stops where it touches.
        radius: of the ball, metres.
        noise: of the touches.
        readings: as of `touch_gain`.
        sampled: whether readings are drawn with noise.
        generator: of the draws.
    """
    sweep = sweep_mesh(world_T_object, triangles, start[..., None, :], end[..., None, :], radius)
    likelihood = mesh_likelihood(world_T_object, triangles, noise)
    return touch_gain(
        log_weights,
        Outcomes.of(sweep),
        likelihood,
        readings=readings,
        noise=noise if sampled else None,
        generator=generator,
    )


def _drawn(log_weights: Float[Tensor, "N"], count: int, generator: torch.Generator | None) -> Int[Tensor, "M"]:
    """States by weight, as evenly as can be."""
    if generator is None:
        raise ValueError("Drawn readings need a generator")
    size = len(log_weights)
    if count == size:
        return resample_systematic(log_weights, generator=generator)
    weights = log_weights.double().softmax(-1).cumsum(-1)
    offset = torch.rand((), generator=generator, dtype=torch.float64)
    comb = (torch.arange(count, dtype=torch.float64) + offset) / count * weights[-1]
    return torch.searchsorted(weights, comb, right=True).clamp_max(size - 1)
