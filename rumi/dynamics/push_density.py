"""Predictive density of a push: a mixture over particles of quasi-static predictions with a heavy-tailed residual."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.outline import Support
from rumi.dynamics.sliding import rotated
from sdf.so3 import wrap


@dataclass(frozen=True)
class PushResidual:
    """Student-t residual of a predicted push: along the tool's way, across it, and of the turn times the base's radius.

    The scale of each grows with the way that the object is predicted to go (its centre's, and the turn's at the base's
    mean radius). Scales are 0.9 of what the sets' own fits leave: particles that differ are doubt too.

    Attributes:
        floor_m: scales of a push that moves nothing.
        share: of the predicted way.
        tails: degrees of freedom.
        power: of the likelihood where parameters are learnt: pushes of an object err together, so that ten tell less
            than ten independent ones.
        spread: deviation of the log of an object's own scale, as a multiple of these.
    """

    floor_m: tuple[float, float, float] = (1.1e-4, 0.9e-4, 1.1e-4)
    share: tuple[float, float, float] = (0.045, 0.0334, 0.0504)
    tails: float = 1.53
    power: float = 0.3
    spread: float = 0.25

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        for name in ("floor_m", "share"):
            value = getattr(self, name)
            if len(value) != 3 or not all(0 < part < math.inf for part in value):
                raise ValueError(f"Expected {name} as three numbers above 0, got {value}")
        if not 0 < self.tails < math.inf or not 0 < self.power <= 1:
            raise ValueError(f"Expected tails above 0 and power in (0, 1], got {self.tails} and {self.power}")
        if not 0 <= self.spread < math.inf:
            raise ValueError(f"Expected a spread of 0 or more, got {self.spread}")

    def scale(self, way_m: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
        """Of the residual, metres, by the predicted way."""
        return torch.hypot(way_m.new_tensor(self.floor_m), way_m[..., None] * way_m.new_tensor(self.share))

    def own(self, white: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """An object's own multiple of the scale, by standard normal numbers."""
        return (self.spread * white).exp()

    def log_density(self, residual_m: Float[Tensor, "*#b 3"], scale: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b"]:
        """Of a residual, 1/m^3."""
        nu, square = self.tails, (residual_m / scale).square().sum(-1)
        constant = math.lgamma(0.5 * (nu + 3.0)) - math.lgamma(0.5 * nu) - 1.5 * math.log(nu * math.pi)
        return constant - scale.log().sum(-1) - 0.5 * (nu + 3.0) * torch.log1p(square / nu)


class PushPrediction(NamedTuple):
    """Predictive density of E pushes: a mixture over N particles.

    Attributes:
        ends: (E, N, 3), poses that the particles predict.
        log_weights: (N), normalised.
        scale: (E, N, 3), of the residual, metres.
        heading: (E), direction of the tool's way, radians.
        support: of the object.
        residual: of the predictions.
    """

    ends: Float[Tensor, "E N 3"]
    log_weights: Float[Tensor, "N"]
    scale: Float[Tensor, "E N 3"]
    heading: Float[Tensor, "E"]
    support: Support
    residual: PushResidual

    def mean(self) -> Float[Tensor, "E 3"]:
        """Mean of the predicted ends: the point prediction with the least error."""
        first = self.ends[:, :1]
        off = torch.cat((self.ends[..., :2] - first[..., :2], wrap(self.ends[..., 2:] - first[..., 2:])), -1)
        return first[:, 0] + (self.log_weights.exp()[:, None] * off).sum(1)

    def log_density(self, ends: Float[Tensor, "E *s 3"]) -> Float[Tensor, "E *s"]:
        """Log density of poses after the pushes, nats per (m, m, rad)."""
        flat = ends.reshape(len(ends), -1, 3)
        return torch.logsumexp(self.log_weights + self.particle_log_density(flat), -1).view(ends.shape[:-1])

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "E count 3"]:
        """Draws of the poses after the pushes."""
        chosen = torch.multinomial(self.log_weights.exp(), count, replacement=True, generator=generator)
        ends, scale = self.ends[:, chosen], self.scale[:, chosen]
        normal = torch.randn(scale.shape, generator=generator, dtype=scale.dtype)
        shape = (*scale.shape[:2], 1)
        chi = torch._standard_gamma(scale.new_full(shape, 0.5 * self.residual.tails), generator=generator)
        off = scale * normal * (0.5 * self.residual.tails / chi.clamp_min(1e-30)).sqrt()
        yaw = ends[..., 2] + off[..., 2] / self.support.spread
        centre = self.support.centre.to(ends)
        place = ends[..., :2] + rotated(centre, ends[..., 2]) + rotated(off[..., :2], self.heading[:, None])
        return torch.cat((place - rotated(centre, yaw), yaw[..., None]), -1)

    def level(self, ends: Float[Tensor, "E 3"], generator: torch.Generator, *, draws: int = 400) -> Float[Tensor, "E"]:
        """Mass of the smallest region that holds a pose: a region of 90 % holds those of a level up to 0.9."""
        drawn = self.log_density(self.sample(draws, generator))
        return (drawn > self.log_density(ends)[:, None]).to(ends).mean(-1)

    def residual_of(self, ends: Float[Tensor, "E S 3"]) -> Float[Tensor, "E S N 3"]:
        """Of poses by each particle: along the tool's way, across it, and the turn times the base's radius, metres."""
        centre, own = self.support.centre.to(self.ends), self.ends[:, None]
        off = ends[..., :2] + rotated(centre, ends[..., 2])
        off = off[:, :, None] - own[..., :2] - rotated(centre, own[..., 2])
        turn = self.support.spread * wrap(ends[:, :, None, 2] - own[..., 2])
        return torch.cat((rotated(off, -self.heading[:, None, None]), turn[..., None]), -1)

    def particle_log_density(self, ends: Float[Tensor, "E S 3"]) -> Float[Tensor, "E S N"]:
        """Log density of poses by each particle."""
        return self.residual.log_density(self.residual_of(ends), self.scale[:, None]) + math.log(self.support.spread)
