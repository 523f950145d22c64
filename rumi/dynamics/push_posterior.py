"""Posterior over an object's push parameters, and the predictive density of a push under it.

Particles over how an object slides are weighed by pushes whose outcome was measured, with the likelihood of a
quasi-static prediction and a heavy-tailed residual; resample-move (Gilks & Berzuini 2001) keeps them apart. All numbers
are fitted to the 14 sets of 5400 real pushes (7 shapes on two surfaces) of Yu, Bauza, Fazeli, Rodriguez (IROS 2016).
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import Pusher, push_along_path
from rumi.dynamics.outline import GridOutline, Support, support_of
from rumi.dynamics.sliding import Outline, Sliding, rotated
from rumi.errors import UsageError
from rumi.resampling import resample_systematic, systematic
from rumi.robot.tool_shape import ToolShape
from sdf.base import SDF
from sdf.check import check_shape
from sdf.so3 import wrap

PARAMETERS = (
    "log friction",
    "log lever ratio",
    "quartic",
    "quartic by elongation",
    "anisotropy xx",
    "anisotropy xy",
    "centre x",
    "centre y",
)
"""Of a particle: friction at the tool; lever as a multiple of even pressure's; quartic limit surface, its mean and what
the support's elongation adds; log anisotropy; centre of friction off the centre of mass, in mean radii of the base."""

_MEAN = (math.log(0.25), 0.15, 1.1, 4.0, 0.0, 0.0, 0.0, 0.0)
# fits of the sets scatter by (.14, .36, 1.2, 2.3, .04, .03, .05, .05); friction is .14 to .27 there and .2 to .6 in the
# simulator, levers of .5 to 1.6 there and up to 2.45 of what rests on a rim or on four corners, so that both are wider
_DEVIATION = (0.5, 0.45, 1.2, 2.3, 0.04, 0.04, 0.06, 0.06)
_QUARTIC = (-1.5, 4.0)  # eigenvalues of a limit surface that is convex
_MOVES = 2  # Metropolis sweeps at a resampling
_KEPT = 200  # pushes that are replayed: the latest


class PushedBody(NamedTuple):
    """An upright object and the level tool that pushes it.

    Attributes:
        outline: of the object at the tool's height.
        support: how it rests on the floor.
        pusher: the tool.
    """

    outline: Outline
    support: Support
    pusher: Pusher

    @classmethod
    def of(cls, sdf: SDF, height_m: float, shape: ToolShape, *, spacing_m: float = 0.005) -> "PushedBody":
        """Of an object and a gripper, at a height in the object's frame; points of its border so far apart."""
        outline, support = GridOutline.of_slice(sdf, height_m), support_of(sdf)
        return cls(outline, support, Pusher(shape.outline(spacing_m).to(support.centre)))


class ObservedPush(NamedTuple):
    """A push whose outcome was measured.

    Attributes:
        start: (3,), pose (x, y, yaw) before, metres and radians.
        path: (K1, 3), (x, y, yaw) of the tool.
        end: (3,), pose after.
    """

    start: Float[Tensor, "3"]
    path: Float[Tensor, "K1 3"]
    end: Float[Tensor, "3"]


@dataclass(frozen=True)
class PushResidual:
    """Student-t residual of a predicted push: along the tool's way, across it, and of the turn times the base's radius.

    The scale of each grows with the way that the object is predicted to go (its centre's, and the turn's at the base's
    mean radius). Its numbers are the sets' best.

    Attributes:
        floor_m: scales of a push that moves nothing.
        share: of the predicted way.
        tails: degrees of freedom.
        power: of the likelihood where parameters are learnt: pushes of an object err together, so that ten tell less
            than ten independent ones.
    """

    floor_m: tuple[float, float, float] = (3.8e-4, 6.3e-4, 4.6e-4)
    share: tuple[float, float, float] = (0.056, 0.041, 0.0575)
    tails: float = 2.0
    power: float = 0.3

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        for name in ("floor_m", "share"):
            value = getattr(self, name)
            if len(value) != 3 or not all(0 < part < math.inf for part in value):
                raise ValueError(f"Expected {name} as three numbers above 0, got {value}")
        if not 0 < self.tails < math.inf or not 0 < self.power <= 1:
            raise ValueError(f"Expected tails above 0 and power in (0, 1], got {self.tails} and {self.power}")

    def scale(self, way_m: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
        """Of the residual, metres, by the predicted way."""
        return torch.hypot(way_m.new_tensor(self.floor_m), way_m[..., None] * way_m.new_tensor(self.share))

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
        return torch.logsumexp(self.log_weights + self._particle_log_density(flat), -1).view(ends.shape[:-1])

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

    def _particle_log_density(self, ends: Float[Tensor, "E S 3"]) -> Float[Tensor, "E S N"]:
        centre, own = self.support.centre.to(self.ends), self.ends[:, None]
        off = ends[..., :2] + rotated(centre, ends[..., 2])
        off = off[:, :, None] - own[..., :2] - rotated(centre, own[..., 2])
        turn = self.support.spread * wrap(ends[:, :, None, 2] - own[..., 2])
        residual = torch.cat((rotated(off, -self.heading[:, None, None]), turn[..., None]), -1)
        return self.residual.log_density(residual, self.scale[:, None]) + math.log(self.support.spread)


@dataclass(frozen=True, eq=False)
class PushPosterior:
    """Posterior over an object's push parameters: weighted particles, and the pushes that they were learnt from.

    Attributes:
        parameters: (N, 8), see `PARAMETERS`.
        log_weights: (N), normalised.
        pushes: learnt from, the latest last.
        residual: of predictions.
        mean: of the normal prior, (8,).
        deviation: of it.
    """

    parameters: Float[Tensor, "N 8"]
    log_weights: Float[Tensor, "N"]
    pushes: tuple[ObservedPush, ...] = ()
    residual: PushResidual = field(default_factory=PushResidual)
    mean: tuple[float, ...] = _MEAN
    deviation: tuple[float, ...] = _DEVIATION

    @classmethod
    def prior(
        cls,
        count: int = 256,
        *,
        mean: Sequence[float] = _MEAN,
        deviation: Sequence[float] = _DEVIATION,
        residual: PushResidual | None = None,
    ) -> "PushPosterior":
        """Even particles of the prior, quasi-random: the same each time."""
        if len(mean) != len(PARAMETERS) or len(deviation) != len(PARAMETERS) or not min(deviation) > 0:
            raise ValueError(f"Expected a mean and a deviation above 0 for each of {len(PARAMETERS)} parameters")
        uniform = torch.quasirandom.SobolEngine(len(PARAMETERS), scramble=True, seed=1).draw(count, dtype=torch.float64)
        # every n-th point of the sequence lies in a part of the space
        uniform = uniform[torch.randperm(count, generator=torch.Generator().manual_seed(1))]
        normal = math.sqrt(2.0) * torch.erfinv((2.0 * uniform - 1.0).clamp(-1.0 + 1e-9, 1.0 - 1e-9))
        parameters = torch.tensor(mean, dtype=torch.float64) + torch.tensor(deviation, dtype=torch.float64) * normal
        flat = parameters.new_zeros(count).log_softmax(-1)
        return cls(parameters, flat, (), residual or PushResidual(), tuple(mean), tuple(deviation))

    @property
    def effective(self) -> float:
        """Effective number of particles."""
        return float(1.0 / self.log_weights.exp().square().sum())

    def quantiles(self, shares: Sequence[float]) -> Float[Tensor, "q 8"]:
        """Weighted quantiles of each parameter."""
        order = self.parameters.argsort(0)
        below = self.log_weights.exp()[order].cumsum(0)
        at = torch.stack([(below >= share - 1e-12).to(torch.int8).argmax(0) for share in shares])
        return self.parameters.gather(0, order).gather(0, at)

    def draws(self, count: int) -> Float[Tensor, "count 8"]:
        """Particles that stand for equal shares of the posterior (systematic, nothing random)."""
        return self.parameters[systematic(self.log_weights, 0.5, count)]

    def middle(self, support: Support) -> Sliding:
        """How an object slides by the mean of the particles."""
        mean = sliding_of((self.log_weights.exp() @ self.parameters)[None], support)
        return mean.map(lambda part: part[0])

    def predict(
        self, start: Float[Tensor, "E 3"], path: Float[Tensor, "#E K1 3"], body: PushedBody, *, substeps: int = 1
    ) -> PushPrediction:
        """Predictive density of pushes along paths; see `push_along_path`."""
        check_shape("start", start, "(E, 3)", last=(3,))
        ends, scale, heading = self._ends(self.parameters, start, path, body, substeps)
        return PushPrediction(ends, self.log_weights, scale, heading, body.support, self.residual)

    def log_likelihood(self, pushes: Sequence[ObservedPush], body: PushedBody) -> Float[Tensor, "N"]:
        """Of some pushes by each particle, to the residual's power."""
        return self._log_likelihood(self.parameters, pushes, body)

    def update(self, pushes: Sequence[ObservedPush], body: PushedBody, generator: torch.Generator) -> "PushPosterior":
        """The posterior after more pushes of the same object, one after the other."""
        found = self
        for push in pushes:
            weighed = found.log_weights + found._log_likelihood(found.parameters, (push,), body)
            found = replace(found, log_weights=weighed.log_softmax(-1), pushes=(*found.pushes, push)[-_KEPT:])
            if found.effective < 0.5 * len(found.log_weights):
                found = found._moved(body, generator)
        return found

    def _moved(self, body: PushedBody, generator: torch.Generator) -> "PushPosterior":
        """Resampled, and moved by Metropolis's rule along the posterior of all pushes."""
        weights = self.log_weights.exp()
        off = self.parameters - weights @ self.parameters
        covariance = off.T @ (weights[:, None] * off)
        slack = 1e-4 * torch.tensor(self.deviation, dtype=off.dtype).square().diag()
        root = torch.linalg.cholesky(covariance + slack) * (2.38 / math.sqrt(len(PARAMETERS)))
        now = self.parameters[resample_systematic(self.log_weights, generator=generator)]
        target = self._log_target(now, body)
        for _ in range(_MOVES):
            normal = torch.randn(now.shape, generator=generator, dtype=now.dtype)
            there = now + normal @ root.T
            gained = self._log_target(there, body)
            uniform = torch.rand(len(now), generator=generator, dtype=now.dtype)
            accept = uniform.log() < gained - target
            now, target = torch.where(accept[:, None], there, now), torch.where(accept, gained, target)
        return replace(self, parameters=now, log_weights=torch.zeros_like(target).log_softmax(-1))

    def _log_target(self, parameters: Float[Tensor, "N 8"], body: PushedBody) -> Float[Tensor, "N"]:
        off = (parameters - parameters.new_tensor(self.mean)) / parameters.new_tensor(self.deviation)
        return self._log_likelihood(parameters, self.pushes, body) - 0.5 * off.square().sum(-1)

    def _log_likelihood(
        self, parameters: Float[Tensor, "N 8"], pushes: Sequence[ObservedPush], body: PushedBody
    ) -> Float[Tensor, "N"]:
        """Of pushes, to the residual's power."""
        whole = parameters.new_zeros(len(parameters))
        for count in sorted({len(push.path) for push in pushes}):
            same = [push for push in pushes if len(push.path) == count]
            start, path, end = (torch.stack(part).to(parameters) for part in zip(*same, strict=True))
            ends, scale, heading = self._ends(parameters, start, path, body, 1)
            shown = PushPrediction(ends, self.log_weights, scale, heading, body.support, self.residual)
            whole = whole + self.residual.power * shown._particle_log_density(end[:, None])[:, 0].sum(0)
        return whole

    def _ends(
        self,
        parameters: Float[Tensor, "N 8"],
        start: Float[Tensor, "E 3"],
        path: Float[Tensor, "#E K1 3"],
        body: PushedBody,
        substeps: int,
    ) -> tuple[Float[Tensor, "E N 3"], Float[Tensor, "E N 3"], Float[Tensor, "E"]]:
        """Predicted ends, scales of their residuals, and headings of the tool's ways."""
        pushes, particles = len(start), len(parameters)
        path = path.to(start).expand(pushes, *path.shape[1:])
        sliding = sliding_of(parameters.to(start), body.support).map(
            lambda part: part.repeat(pushes, *[1] * (part.ndim - 1))
        )
        outcome = push_along_path(
            start.repeat_interleave(particles, 0),
            path.repeat_interleave(particles, 0),
            Pusher(body.pusher.points.to(start), body.pusher.thickness),
            body.outline.to(start) if hasattr(body.outline, "to") else body.outline,
            sliding,
            substeps=substeps,
        )
        ends = (
            outcome.track[:, -1].view(pushes, particles, 3)
            if path.shape[1] > 1
            else start[:, None].repeat(1, particles, 1)
        )
        centre = body.support.centre.to(start)
        before = start[:, None, :2] + rotated(centre, start[:, None, 2])
        gone = (ends[..., :2] + rotated(centre, ends[..., 2]) - before).norm(dim=-1)
        way = gone + body.support.spread * (ends[..., 2] - start[:, None, 2]).abs()
        tool = path[:, -1, :2] - path[:, 0, :2]
        return ends, self.residual.scale(way), torch.atan2(tool[:, 1], tool[:, 0])

    def save(self, path: Path) -> None:
        """Write to a JSON file, whole or not at all."""
        data = {
            "format": _FORMAT,
            "names": list(PARAMETERS),
            "mean": list(self.mean),
            "deviation": list(self.deviation),
            "residual": vars(self.residual),
            "parameters": self.parameters.tolist(),
            "log_weights": self.log_weights.tolist(),
            "pushes": [{name: part.tolist() for name, part in push._asdict().items()} for push in self.pushes],
        }
        aside = path.with_name(path.name + ".part")
        aside.write_text(json.dumps(data))
        aside.replace(path)

    @classmethod
    def load(cls, path: Path) -> "PushPosterior":
        """Read what `save` wrote.

        Raises:
            UsageError: there is no such file, or it is another.
        """
        try:
            data = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise UsageError(
                f"Expected a file of push parameters, as `rumi pushes --out` writes, got {path}: {error}"
            ) from None
        try:
            if data["format"] != _FORMAT or data["names"] != list(PARAMETERS):
                raise ValueError(f"format {data['format']!r}")
            numbers = data["residual"]
            residual = PushResidual(
                tuple(numbers["floor_m"]), tuple(numbers["share"]), numbers["tails"], numbers["power"]
            )
            double = {name: torch.tensor(data[name], dtype=torch.float64) for name in ("parameters", "log_weights")}
            check_shape("parameters", double["parameters"], "(N, 8)", last=(len(PARAMETERS),))
            if not all(bool(part.isfinite().all()) for part in double.values()):
                raise ValueError("numbers that are not finite")
            pushes = tuple(
                ObservedPush(*(torch.tensor(push[name], dtype=torch.float64) for name in ObservedPush._fields))
                for push in data["pushes"]
            )
            prior = (tuple(data["mean"]), tuple(data["deviation"]))
            return cls(double["parameters"], double["log_weights"], pushes, residual, *prior)
        except (KeyError, TypeError, ValueError) as error:
            raise UsageError(
                f"Expected push parameters as `rumi pushes --out` writes them in {path}, got {error}"
            ) from None


_FORMAT = "rumi push parameters 1"


FIXED, PRIOR = "fixed", "prior"


def push_posterior(name: str) -> PushPosterior | None:
    """The posterior that a setting names: None for "fixed", the prior for "prior", else that of a file."""
    if name == FIXED:
        return None
    return PushPosterior.prior() if name == PRIOR else PushPosterior.load(Path(name))


def sliding_of(parameters: Float[Tensor, "N 8"], support: Support) -> Sliding:
    """How an object slides that rests as it does, by each particle."""
    friction, lever, mean, slope, *rest = parameters.unbind(-1)
    elongation = support.elongation.to(parameters)
    size = elongation.norm().clamp_min(1e-12)
    spread = slope * size
    high = (mean + spread.abs()).clamp(*_QUARTIC)
    low = (mean - spread.abs()).clamp(*_QUARTIC)
    deviator = (0.5 * (high - low) * spread.sign())[:, None] * (elongation / size)
    quartic = torch.cat((torch.stack(rest[:2], -1), 0.5 * (high + low)[:, None], deviator), -1)
    centre = support.centre.to(parameters) + support.spread * torch.stack(rest[2:], -1)
    return Sliding(centre, support.spread * lever.exp(), friction.exp(), quartic)
