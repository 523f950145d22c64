"""Draws about the modes of a pose posterior: poses nearby that explain more, and the mass that each mode holds.

With few touches a likelihood of distances has kinks and ridges: its best pose and the curvature there say little of
where the mass is. Adaptive importance sampling finds it: draws of a mixture of Student's t distributions about the
modes, weighed by likelihood over the mixture's density, by which the mixture is then fitted anew (population Monte
Carlo: Cappe et al., 2004). A step from a pose is a shift, and a turn's axis times twice the sine of half its angle.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi import seeding
from rumi.registration.descent import retract
from rumi.registration.touch_surface import TouchSurface
from sdf import so3

LogLikelihood = Callable[[Float[Tensor, "N 4 4"]], Float[Tensor, "N"]]

_FREEDOM = 4  # degrees of freedom of the draws: heavy tails
_FIRST = (1.5, 0.4)  # times the given deviations: of the first draws, since a kink is sharper than its curvature says
_FEWEST = 20  # draws of a mode that it takes to fit it
_FITTED, _KEPT = 1.2, 0.05  # of fitted and of given covariances in the next one
_LEAST = 1e-15  # variance along an axis, of the greatest
_SMALL = 1e-6  # half angles, radians, whose sine they are
_NORMAL = math.lgamma(0.5 * (_FREEDOM + 6)) - math.lgamma(0.5 * _FREEDOM) - 3.0 * math.log(_FREEDOM * math.pi)


class _Mixture(NamedTuple):
    """Student's t distributions about poses, of steps, and how many draws are of each."""

    middle: Float[Tensor, "C 4 4"]
    covariance: Float[Tensor, "C 6 6"]
    counts: Int[Tensor, "C"]


class _Drawn(NamedTuple):
    """Draws: steps to them from each mode, log-weights whose sum is the mass, and whose they are."""

    away: Float[Tensor, "M N 6"]
    log_weight: Float[Tensor, "N"]
    owner: Int[Tensor, "N"]

    def of(self, mode: int) -> tuple[Float[Tensor, "n 6"], Float[Tensor, "n"]]:
        """Steps and log-weights of a mode's own draws."""
        own = self.owner == mode
        return self.away[mode, own], self.log_weight[own]

    @property
    def mass(self) -> Float[Tensor, "M"]:
        """Log-mass of each mode."""
        return torch.stack([self.of(mode)[1].logsumexp(0) for mode in range(len(self.away))])


def nearby(
    poses: Float[Tensor, "M 4 4"],
    covariance: Float[Tensor, "M 6 6"],
    log_likelihood: LogLikelihood,
    *,
    draws: int,
    kept: int,
    generator: torch.Generator,
) -> Float[Tensor, "K 4 4"]:
    """Of draws about each pose the likeliest, to descend from.

    Args:
        poses: of which draws are made.
        covariance: of each, of shift and turn.
        log_likelihood: of poses.
        draws: about each pose, half of them twice as wide.
        kept: of them.
        generator: of the draws.
    """
    half = torch.full((len(poses),), -(-draws // 2))
    near, far = (
        _sampled(_Mixture(poses, wider**2 * covariance, half), generator).view(len(poses), -1, 4, 4)
        for wider in (1.0, 2.0)
    )
    drawn = torch.cat((near, far), 1)
    best = log_likelihood(drawn.flatten(0, 1)).view(drawn.shape[:2]).topk(min(kept, draws)).indices
    return torch.gather(drawn, 1, best[..., None, None].expand(*best.shape, 4, 4)).flatten(0, 1)


def masses(
    surface: TouchSurface,
    poses: Float[Tensor, "M 4 4"],
    covariance: Float[Tensor, "M 6 6"],
    log_likelihood: LogLikelihood,
    *,
    draws: int,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "M"], Float[Tensor, "M 6 6"]]:
    """Log-mass of the posterior that is nearest to each mode, and its second moments about the mode.

    Two rounds of draws fit the distributions; the last one weighs, half of it even and half where the mass is, a
    quarter of it by the first distributions. A draw belongs to the mode by whose given covariance it is nearest. Poses
    that look the same are one.

    Args:
        surface: whose symmetries count.
        poses: of the modes, of the surface's middle.
        covariance: about what there is, (shift, turn).
        log_likelihood: of poses.
        draws: of all rounds, about.
        generator: of the draws.
    """
    count = len(poses)
    even = torch.full((count,), -(-draws // (8 * count)))
    first = _Mixture(poses.repeat(2, 1, 1), torch.cat([x**2 * covariance for x in _FIRST]), even.repeat(2))
    drawn = _weighed(surface, poses, covariance, log_likelihood, first, generator)
    some = _divided(draws // 4, drawn)
    drawn = _weighed(surface, poses, covariance, log_likelihood, _fitted(poses, covariance, drawn, some), generator)
    many = _divided(draws // 2, drawn)
    fitted = _fitted(poses, covariance, drawn, many)
    wide = _Mixture(poses, _FIRST[0] ** 2 * covariance, -(-many // 3))
    both = _Mixture(*(torch.cat(part) for part in zip(fitted, wide, strict=True)))
    drawn = _weighed(surface, poses, covariance, log_likelihood, both, generator)
    moments = covariance.clone()
    for mode in range(count):
        step, logs = drawn.of(mode)
        share = logs.softmax(0)
        if len(logs) and float(1.0 / share.square().sum()) >= _FEWEST:
            moments[mode] = step.mT @ (share[:, None] * step)
    return drawn.mass, moments


def laplace_mass(log_likelihood: Float[Tensor, "M"], covariance: Float[Tensor, "M 6 6"]) -> Float[Tensor, "M"]:
    """Log-mass of Gaussian modes."""
    return log_likelihood + 0.5 * torch.linalg.slogdet(covariance).logabsdet + 3.0 * math.log(2.0 * math.pi)


def moved(poses: Float[Tensor, "*b 4 4"], steps: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 4 4"]:
    """Poses a step away; half a circle at most."""
    half = 0.5 * steps[..., 3:].norm(dim=-1, keepdim=True)
    scale = torch.where(half > _SMALL, half.clamp_max(1.0).asin() / half.clamp_min(_SMALL), 1.0)
    return retract(poses, torch.cat((steps[..., :3], scale * steps[..., 3:]), -1), "SE(3)")


def apart(
    surface: TouchSurface, drawn: Float[Tensor, "N 4 4"], poses: Float[Tensor, "M 4 4"]
) -> Float[Tensor, "M N 6"]:
    """Step from each pose to each draw, as the one of those that look the same which is nearest."""
    there = drawn
    if not surface.symmetries.trivial and len(poses) > 1:
        there = drawn.expand(len(poses), *drawn.shape)
        like = surface.uncentred(poses)[:, None].expand(there.shape)
        there = surface.centred(surface.symmetries.nearest(surface.uncentred(there), like))
    own = so3.quaternion(poses[:, :3, :3])
    diagonal = own[:, 3, None, None] * torch.eye(3, dtype=own.dtype)
    vector = torch.cat((so3.hat(own[:, :3]) + diagonal, -own[:, :3, None]), -1)
    product = torch.cat((vector, own[:, None]), -2)  # of a quaternion and the inverse of each pose's own
    turn = so3.quaternion(there[..., :3, :3]) @ product.mT
    turn = 2.0 * torch.where(turn[..., 3:] < 0, -1.0, 1.0) * turn[..., :3]
    return torch.cat((there[..., :3, 3] - poses[:, None, :3, 3], turn), -1)


def owners(away: Float[Tensor, "M N 6"], covariance: Float[Tensor, "M 6 6"]) -> Int[Tensor, "N"]:
    """The mode that each draw belongs to, by steps from the modes and the modes' covariances."""
    return _log_density(away, covariance).argmax(0)


def _weighed(
    surface: TouchSurface,
    poses: Tensor,
    covariance: Tensor,
    log_likelihood: LogLikelihood,
    mixture: _Mixture,
    generator: torch.Generator,
) -> _Drawn:
    """Draws of a mixture, weighed by the likelihood over its density."""
    poses_drawn = _sampled(mixture, generator)
    share = (mixture.counts / mixture.counts.sum()).log()
    density = _log_density(apart(surface, poses_drawn, mixture.middle), mixture.covariance) + share[:, None]
    log_weight = log_likelihood(poses_drawn) - density.logsumexp(0) - math.log(len(poses_drawn))
    away = apart(surface, poses_drawn, poses)
    return _Drawn(away, log_weight, owners(away, covariance))


def _divided(draws: int, drawn: _Drawn) -> Int[Tensor, "M"]:
    """Draws of each mode, half of them evenly, half by mass."""
    share = drawn.mass.softmax(0)
    return (0.5 * draws * (share + 1.0 / len(share))).ceil().long()


def _fitted(poses: Tensor, covariance: Tensor, drawn: _Drawn, counts: Int[Tensor, "M"]) -> _Mixture:
    """Means and covariances of each mode's weighted draws; where few have all the weight, of a power of it."""
    means, wide = poses.new_zeros(len(poses), 6), _FIRST[0] ** 2 * covariance
    for mode in range(len(poses)):
        step, logs = drawn.of(mode)
        if len(logs) < _FEWEST:
            continue
        share = logs.softmax(0)
        while float(1.0 / share.square().sum()) < _FEWEST:
            logs = 0.5 * logs
            share = logs.softmax(0)
        means[mode] = share @ step
        about = (step - means[mode]).mT @ (share[:, None] * (step - means[mode]))
        wide[mode] = _FITTED * about + _KEPT * covariance[mode]
    return _Mixture(moved(poses, means), wide, counts)


def _sampled(mixture: _Mixture, generator: torch.Generator) -> Float[Tensor, "N 4 4"]:
    """Draws of each distribution, one after the other."""
    each = torch.arange(len(mixture.middle)).repeat_interleave(mixture.counts)
    normal = seeding.normal((len(each), 6 + _FREEDOM), generator=generator, dtype=mixture.middle.dtype)
    deviation, axes = _axes(mixture.covariance)
    step = ((axes * deviation[:, None])[each] @ normal[:, :6, None])[..., 0]
    return moved(mixture.middle[each], step / normal[:, 6:].square().mean(-1, keepdim=True).sqrt())


def _log_density(away: Float[Tensor, "M N 6"], covariance: Float[Tensor, "M 6 6"]) -> Float[Tensor, "M N"]:
    """Of the t distributions at steps from their middles."""
    deviation, axes = _axes(covariance)
    squared = ((away @ axes) / deviation[:, None]).square().sum(-1)
    size = deviation.log().sum(-1, keepdim=True)
    return _NORMAL - size - 0.5 * (_FREEDOM + 6) * torch.log1p(squared / _FREEDOM)


def _axes(covariance: Float[Tensor, "M 6 6"]) -> tuple[Float[Tensor, "M 6"], Float[Tensor, "M 6 6"]]:
    """Deviations along the principal axes, and these as columns; no deviation is 0, whatever rounding made of it."""
    values, axes = torch.linalg.eigh(0.5 * (covariance + covariance.mT))
    return values.clamp_min(_LEAST * values[:, -1:]).sqrt(), axes
