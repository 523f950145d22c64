"""Posterior of a pose given contacts: likelihood with outliers, the modes among poses, and what each of them holds."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.registration.contact_modes import Localization
from rumi.registration.contact_terms import LocalizeSettings, TouchFit, touch_terms
from rumi.registration.mode_draws import laplace_mass, masses
from rumi.registration.touch_surface import TouchSurface
from sdf.mesh.touched import touched_face

# what is known of an orientation without touches: the variance of an angle anywhere on the circle, about
_ANY_TURN = math.pi**2 / 3.0
# of its size without touches, that a direction's standard deviation may keep before it counts as open
_OPEN = 0.5
_HELD = 1e10  # per square radian
_ROUNDS = 10  # of EM
_LIGHT = 1e-4  # mass of a mode, relative to the heaviest, below which it is not worth draws
_PAIRS, _FEWEST_DRAWS = 60_000, 60  # of poses and touches in all draws at most; fewer about a mode say little


def gather_modes(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "N 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    settings: LocalizeSettings,
    noise_m: float | None = None,
    *,
    generator: torch.Generator,
) -> Localization:
    """Put poses together that are alike, best first, and weigh what there is.

    Distances are taken to have a Laplace distribution of scale `noise_m`, normals (chords) a normal one, but for a
    share of outliers, which may be anywhere (`LocalizeSettings.outlier`). Mass and covariance of a mode are those of
    weighted draws about it. Of modes with open directions, and where touches are many, they are those of a Gaussian by
    the Fisher information at the best pose (`laplace_covariance`).
    """
    nearest = TouchFit("absolute", True, 0.0, smooth_m=0.0)
    distance = touch_terms(surface, world_T_middle, points_w, None, nearest).objective / len(points_w)
    noise = noise_m or noise_scale(surface, world_T_middle, points_w, normals_w, settings)
    fit = mixture(surface, noise, settings, normals=normals_w is not None)
    likelihood, modes = plausible_modes(surface, world_T_middle, points_w, normals_w, fit, settings)
    reach, poses = fit.reach_m, world_T_middle[modes]
    covariance, open_ = laplace_covariance(surface, poses, points_w, normals_w, fit)
    mass = laplace_mass(likelihood[modes], covariance)
    some = ((open_ == 0) & (mass > mass.max() + math.log(_LIGHT))).nonzero()[:, 0]
    draws = min(settings.draws, _PAIRS // len(points_w))
    if draws >= _FEWEST_DRAWS * len(some) > 0:
        mass[some], covariance[some] = masses(
            surface,
            poses[some],
            covariance[some],
            lambda at: log_likelihood(surface, at, points_w, normals_w, fit),
            draws=draws,
            generator=generator,
        )
    weights = mass.softmax(0)
    heavy = weights.argsort(descending=True, stable=True)[: settings.kept]
    chosen = modes[heavy]
    off, turned = touches_off(surface, world_T_middle[chosen], points_w, normals_w, reach)
    return Localization(
        surface.uncentred(world_T_middle[chosen]),
        weights[heavy] / weights[heavy].sum(),
        distance[chosen],
        None if normals_w is None else turned.mean(-1),
        likelihood[chosen],
        covariance[heavy],
        open_[heavy],
        surface.symmetries,
        float(noise),
        len(modes),
        len(points_w),
        off,
        torch.zeros(len(points_w), dtype=torch.bool),
        surface.middle_o.double(),
    )


def mixture(surface: TouchSurface, noise_m: float, settings: LocalizeSettings, *, normals: bool) -> TouchFit:
    """The loss whose sum over touches, by the noise, is the negative log-likelihood of a pose, outliers among them."""
    reach = noise_m / settings.normal_noise_rad if normals else 0.0
    odds = float(settings.outlier_odds(noise_m, surface.diagonal, normals=normals))
    return TouchFit("absolute", True, reach, noise_m, smooth_m=1e-12, outlier=odds)


def plausible_modes(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "N 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    fit: TouchFit,
    settings: LocalizeSettings,
) -> tuple[Float[Tensor, "N"], Int[Tensor, "M"]]:
    """Log-likelihood of each pose, and which of them are plausible and unlike any that is likelier, best first."""
    likelihood = log_likelihood(surface, world_T_middle, points_w, normals_w, fit)
    order = likelihood.argsort(descending=True, stable=True)
    order = order[likelihood[order] >= likelihood[order[0]] + math.log(settings.plausible)]
    return likelihood, order[distinct(surface, world_T_middle[order], settings.mode_m, settings.mode_rad, len(order))]


def log_likelihood(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "N 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    fit: TouchFit,
) -> Float[Tensor, "N"]:
    """Of poses, by a mixture's loss, nats up to a constant."""
    return -touch_terms(surface, world_T_middle, points_w, normals_w, fit).objective / fit.noise_m


def laplace_covariance(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "M 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    fit: TouchFit,
) -> tuple[Float[Tensor, "M 6 6"], Int[Tensor, "M"]]:
    """Inverse Fisher information of distances and normals at best poses, and how many directions it leaves open.

    Each touch counts by its chance of being no outlier; known before is next to nothing: a standard deviation of the
    diagonal for the place, of any angle for the turn.
    """
    information = touch_terms(surface, world_T_middle, points_w, normals_w, replace(fit, loss="square")).hessian
    prior = torch.tensor([surface.diagonal**-2] * 3 + [1.0 / _ANY_TURN] * 3, dtype=world_T_middle.dtype)
    covariance = torch.linalg.inv(information / fit.noise_m**2 + torch.diag(prior) + _family(surface, world_T_middle))
    scaled = covariance * prior.sqrt() * prior.sqrt()[:, None]
    return covariance, (torch.linalg.eigvalsh(scaled) > _OPEN**2).sum(-1)


def noise_scale(
    surface: TouchSurface,
    world_T_middle: Float[Tensor, "N 4 4"],
    points_w: Float[Tensor, "K 3"],
    normals_w: Float[Tensor, "K 3"] | None,
    settings: LocalizeSettings,
) -> float:
    """Scale of the distances that the likeliest pose leaves: maximum likelihood of the mixture, by EM for each pose."""
    if settings.noise_m is not None:
        return settings.noise_m
    with_normals = normals_w is not None
    off, turned = touches_off(surface, world_T_middle, points_w, normals_w, 0.005 / settings.normal_noise_rad)
    nats = 2.0 * ((0.5 * turned).sin() / settings.normal_noise_rad).square()  # half a squared chord, by its variance
    scale = (off.median(-1).values / math.log(2.0)).clamp_min(settings.least_noise_m)[:, None]
    for _ in range(_ROUNDS):
        odds = settings.outlier_odds(scale, surface.diagonal, normals=with_normals)
        share = 1.0 / (1.0 + odds * (off / scale + nats).clamp_max(500.0).exp())
        mean = (share * off).sum(-1, keepdim=True) / share.sum(-1, keepdim=True).clamp_min(1e-9)
        scale = mean.clamp_min(settings.least_noise_m)
    odds = settings.outlier_odds(scale, surface.diagonal, normals=with_normals)
    likelihood = (((-(off / scale + nats)).exp() + odds) / scale).log().sum(-1)
    return float(scale[likelihood.argmax(), 0])


def distinct(
    surface: TouchSurface, world_T_middle: Float[Tensor, "N 4 4"], near_m: float, near_rad: float, most: int
) -> Int[Tensor, "M"]:
    """Indices of poses none of which is like one before it, up to the object's symmetries; `most` of them at most.

    Alike are two whose middles are less than `near_m` apart, and their turns less than `near_rad`.
    """
    poses = surface.uncentred(world_T_middle)
    least = 1.0 + 2.0 * math.cos(min(near_rad, math.pi))  # trace of a turn by so much
    left = torch.arange(len(poses))
    kept: list[Tensor] = []
    while len(left) and len(kept) < most:
        first, there = left[0], world_T_middle[left]
        kept.append(first)
        own = world_T_middle[first]
        if not surface.symmetries.trivial:
            # of the poses that the first may as well be, the nearest to each
            own = surface.centred(surface.symmetries.nearest(poses[first].expand(len(left), 4, 4), poses[left]))
        apart = (own[..., :3, 3] - there[:, :3, 3]).norm(dim=-1)
        trace = (own[..., :3, :3] * there[:, :3, :3]).sum((-2, -1))
        far = (apart >= near_m) | (trace <= least)
        far[0] = False
        left = left[far]
    return torch.stack(kept) if kept else torch.zeros(0, dtype=torch.long)


def _family(surface: TouchSurface, poses: Float[Tensor, "M 4 4"]) -> Float[Tensor, "M 6 6"]:
    """Information that holds turns about an axis of symmetry at none: poses that differ by one are the same."""
    own, held = surface.symmetries, poses.new_zeros(len(poses), 6, 6)
    if own.ball:
        held[:, 3:, 3:] = _HELD * torch.eye(3, dtype=poses.dtype)
    elif own.axis is not None:
        axis = poses[:, :3, :3] @ own.axis
        held[:, 3:, 3:] = _HELD * axis[:, :, None] * axis[:, None]
    return held


def touches_off(
    surface: TouchSurface, poses: Float[Tensor, "N 4 4"], points: Tensor, normals: Tensor | None, reach: float
) -> tuple[Float[Tensor, "N K"], Float[Tensor, "N K"]]:
    """Distance of each touch from the triangle that explains it, and angle between their normals (0 without)."""
    rotation, place = poses[:, None, :3, :3], poses[:, None, :3, 3]
    own = (rotation.mT @ (points - place)[..., None])[..., 0]
    facing = torch.zeros_like(own) if normals is None else (rotation.mT @ normals[:, :, None])[..., 0]
    found = touched_face(own, facing, surface.triangles, 0.0 if normals is None else reach)
    off = (own - found.point).norm(dim=-1)
    if normals is None:
        return off, torch.zeros_like(off)
    cosine = (facing * surface.triangles.normals[found.face]).sum(-1)
    return off, cosine.clamp(-1.0, 1.0).arccos()
