"""Posterior over an object's push parameters, learnt from pushes whose outcome was measured.

Particles over how an object slides are weighed by pushes whose outcome was measured, with the likelihood of a
quasi-static prediction and a heavy-tailed residual; resample-move (Gilks & Berzuini 2001) keeps them apart. Where tool
and object are off where they are tracked is learnt by itself, from where they touched (`Registration`), and a particle
has a draw of it: its error makes some pushes, those that turn the object either way, less certain. The residual's scale
is an object's own too: a particle has a draw of it. All numbers are fitted to the 14 sets of 5400 real pushes (7 shapes
on two surfaces) of Yu, Bauza, Fazeli, Rodriguez (IROS 2016).
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.outline import Support
from rumi.dynamics.push_density import PushPrediction, PushResidual
from rumi.dynamics.push_parameters import PARAMETERS, sliding_of
from rumi.dynamics.push_registration import SHIFTS, Registration, normal_of_4
from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.dynamics.sliding import Sliding
from rumi.dynamics.tracked_push import tracked_ends
from rumi.errors import UsageError
from rumi.resampling import resample_systematic, systematic
from sdf.check import check_shape

_MEAN = (math.log(0.2), 0.1, 0.74, 3.6, 0.0, 0.0, 0.0, 0.0)
# as the fits of the sets scatter, but for the friction, which is .14 to .28 there and .2 to .6 in the simulator; levers
# are .6 to 1.6 of even pressure's there, and up to 2.45 of what rests on a rim or on four corners
_DEVIATION = (0.45, 0.4, 1.15, 2.6, 0.04, 0.03, 0.055, 0.055)
_MOVES = 2  # Metropolis sweeps at a resampling
_WHITE = len(SHIFTS) + 1  # standard normal numbers of a particle: of the shifts, and of the residual's scale
_KEPT = 200  # pushes that are replayed: the latest


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
        registration: belief about the shifts of tool and object.
        white: (N, 6), standard normal numbers that say which shifts of that belief a particle has, and which scale of
            the residual; None for the middle.
    """

    parameters: Float[Tensor, "N 8"]
    log_weights: Float[Tensor, "N"]
    pushes: tuple[ObservedPush, ...] = ()
    residual: PushResidual = field(default_factory=PushResidual)
    mean: tuple[float, ...] = _MEAN
    deviation: tuple[float, ...] = _DEVIATION
    registration: Registration = field(default_factory=Registration)
    white: Float[Tensor, "N 6"] | None = None

    @classmethod
    def prior(
        cls,
        count: int = 256,
        *,
        mean: Sequence[float] = _MEAN,
        deviation: Sequence[float] = _DEVIATION,
        residual: PushResidual | None = None,
        registration: Registration | None = None,
    ) -> "PushPosterior":
        """Even particles of the prior, quasi-random: the same each time."""
        if len(mean) != len(PARAMETERS) or len(deviation) != len(PARAMETERS) or not min(deviation) > 0:
            raise ValueError(f"Expected a mean and a deviation above 0 for each of {len(PARAMETERS)} parameters")
        sequence = torch.quasirandom.SobolEngine(len(PARAMETERS) + _WHITE, scramble=True, seed=1)
        uniform = sequence.draw(count, dtype=torch.float64)
        # every n-th point of the sequence lies in a part of the space
        uniform = uniform[torch.randperm(count, generator=torch.Generator().manual_seed(1))]
        normal = math.sqrt(2.0) * torch.erfinv((2.0 * uniform - 1.0).clamp(-1.0 + 1e-9, 1.0 - 1e-9))
        normal, white = normal.split((len(PARAMETERS), _WHITE), -1)
        parameters = torch.tensor(mean, dtype=torch.float64) + torch.tensor(deviation, dtype=torch.float64) * normal
        flat = parameters.new_zeros(count).log_softmax(-1)
        own = registration or Registration()
        return cls(parameters, flat, (), residual or PushResidual(), tuple(mean), tuple(deviation), own, white)

    @property
    def effective(self) -> float:
        """Effective number of particles."""
        return float(1.0 / self.log_weights.exp().square().sum())

    def quantiles(self, shares: Sequence[float]) -> Float[Tensor, "q 8"]:
        """Weighted quantiles of each parameter."""
        return self._quantiles(self.parameters, shares)

    def scale_quantiles(self, shares: Sequence[float]) -> Float[Tensor, "q"]:
        """Weighted quantiles of the object's own multiple of the residual's scale."""
        return self._quantiles(self.residual.own(self._all[:, -1:]), shares)[:, 0]

    def _quantiles(self, values: Float[Tensor, "N k"], shares: Sequence[float]) -> Float[Tensor, "q k"]:
        order = values.argsort(0)
        below = self.log_weights.exp()[order].cumsum(0)
        at = torch.stack([(below >= share - 1e-12).to(torch.int8).argmax(0) for share in shares])
        return values.gather(0, order).gather(0, at)

    def draws(self, count: int) -> Float[Tensor, "count 8"]:
        """Particles that stand for equal shares of the posterior (systematic, nothing random)."""
        return self.parameters[systematic(self.log_weights, 0.5, count)]

    def thinned(self, count: int) -> "PushPosterior":
        """Even particles that stand for it."""
        chosen = systematic(self.log_weights, 0.5, count)
        flat = self.log_weights.new_zeros(count).log_softmax(-1)
        white = None if self.white is None else self.white[chosen]
        return replace(self, parameters=self.parameters[chosen], log_weights=flat, white=white)

    def middle(self, support: Support) -> Sliding:
        """How an object slides by the mean of the particles."""
        mean = sliding_of((self.log_weights.exp() @ self.parameters)[None], support)
        return mean.map(lambda part: part[0])

    def predict(
        self, start: Float[Tensor, "E 3"], path: Float[Tensor, "#E K1 3"], body: PushedBody, *, substeps: int = 1
    ) -> PushPrediction:
        """Predictive density of pushes along paths; see `tracked_ends`."""
        check_shape("start", start, "(E, 3)", last=(3,))
        ends, scale, heading = self._ends(self._known(body.support, start), start, path, body, substeps)
        return PushPrediction(ends, self.log_weights, scale, heading, body.support, self.residual)

    def log_likelihood(self, pushes: Sequence[ObservedPush], body: PushedBody) -> Float[Tensor, "N"]:
        """Of some pushes by each particle, to the residual's power."""
        return self._log_likelihood(self._all, pushes, body)

    @cached_property
    def _made(self) -> dict[str, Any]:
        """What is worked out once: how an object slides by each particle takes as long as a push of it."""
        return {}

    @property
    def _all(self) -> Float[Tensor, "N 14"]:
        """Push parameters and the standard normal numbers."""
        white = self.parameters.new_zeros(len(self.parameters), _WHITE) if self.white is None else self.white
        return torch.cat((self.parameters, white.to(self.parameters)), -1)

    def update(self, pushes: Sequence[ObservedPush], body: PushedBody, generator: torch.Generator) -> "PushPosterior":
        """The posterior after more pushes of the same object, one after the other."""
        kept = (*self.pushes, *pushes)[-_KEPT:]
        found = replace(self, registration=self.registration.learnt(kept, body)) if kept else self
        if self.pushes:
            # what was seen is weighed anew by the shifts that are known now
            before = self._log_likelihood(self._all, self.pushes, body)
            gained = found._log_likelihood(found._all, found.pushes, body) - before
            found = replace(found, log_weights=(found.log_weights + gained).log_softmax(-1))
        for push in pushes:
            weighed = found.log_weights + found._log_likelihood(found._all, (push,), body)
            found = replace(found, log_weights=weighed.log_softmax(-1), pushes=(*found.pushes, push)[-_KEPT:])
            if found.effective < 0.5 * len(found.log_weights):
                found = found._moved(body, generator)
        return found

    def _moved(self, body: PushedBody, generator: torch.Generator) -> "PushPosterior":
        """Resampled, and moved by Metropolis's rule along the posterior of all pushes."""
        whole, weights = self._all, self.log_weights.exp()
        off = whole - weights @ whole
        covariance = off.T @ (weights[:, None] * off)
        ones = [1.0] * _WHITE
        slack = 1e-4 * torch.tensor([*self.deviation, *ones], dtype=off.dtype).square().diag()
        root = torch.linalg.cholesky(covariance + slack) * (2.38 / math.sqrt(off.shape[1]))
        now = whole[resample_systematic(self.log_weights, generator=generator)]
        target = self._log_target(now, body)
        for _ in range(_MOVES):
            normal = torch.randn(now.shape, generator=generator, dtype=now.dtype)
            there = now + normal @ root.T
            gained = self._log_target(there, body)
            uniform = torch.rand(len(now), generator=generator, dtype=now.dtype)
            accept = uniform.log() < gained - target
            now, target = torch.where(accept[:, None], there, now), torch.where(accept, gained, target)
        parameters, white = now.split((len(PARAMETERS), _WHITE), -1)
        flat = torch.zeros_like(target).log_softmax(-1)
        return replace(self, parameters=parameters.contiguous(), log_weights=flat, white=white.contiguous())

    def _log_target(self, particles: Float[Tensor, "N 14"], body: PushedBody) -> Float[Tensor, "N"]:
        parameters, white = particles.split((len(PARAMETERS), _WHITE), -1)
        off = (parameters - parameters.new_tensor(self.mean)) / parameters.new_tensor(self.deviation)
        prior = -0.5 * (off.square().sum(-1) + white.square().sum(-1))
        return self._log_likelihood(particles, self.pushes, body) + prior

    def _log_likelihood(
        self, particles: Float[Tensor, "N 14"], pushes: Sequence[ObservedPush], body: PushedBody
    ) -> Float[Tensor, "N"]:
        """Of pushes, to the residual's power."""
        whole = particles.new_zeros(len(particles))
        for count in sorted({len(push.path) for push in pushes}):
            same = [push for push in pushes if len(push.path) == count]
            start, path, end = (torch.stack(part).to(particles) for part in zip(*same, strict=True))
            ends, scale, heading = self._ends(self._slides(particles, body.support), start, path, body, 1)
            shown = PushPrediction(ends, self.log_weights, scale, heading, body.support, self.residual)
            whole = whole + self.residual.power * shown.particle_log_density(end[:, None])[:, 0].sum(0)
        return whole

    def _known(self, support: Support, like: Tensor) -> "_Known":
        """`_slides` of all particles, kept for the object that was pushed last."""
        last = self._made.get("last")
        if last is None or last[0] is not support or last[1] != (like.dtype, like.device):
            last = (support, (like.dtype, like.device), self._slides(self._all.to(like), support))
            self._made["last"] = last
        found: _Known = last[2]
        return found

    def _slides(self, particles: Float[Tensor, "N 14"], support: Support) -> "_Known":
        parameters, shifts, scale = particles.split((len(PARAMETERS), len(SHIFTS), 1), -1)
        return _Known(sliding_of(parameters, support), self.registration.shifts(shifts), self.residual.own(scale))

    def _ends(
        self,
        known: "_Known",
        start: Float[Tensor, "E 3"],
        path: Float[Tensor, "#E K1 3"],
        body: PushedBody,
        substeps: int,
    ) -> tuple[Float[Tensor, "E N 3"], Float[Tensor, "E N 3"], Float[Tensor, "E"]]:
        """Predicted ends, scales of their residuals, and headings of the tool's ways."""
        path = path.to(start).expand(len(start), *path.shape[1:])
        ends, way = tracked_ends(start, path, known.shifts, known.sliding, body, substeps=substeps)
        along = path[:, -1, :2] - path[:, 0, :2]
        return ends, known.scale * self.residual.scale(way), torch.atan2(along[:, 1], along[:, 0])

    def save(self, path: Path) -> None:
        """Write to a JSON file."""
        data = {
            "format": _FORMATS[-1],
            "names": list(PARAMETERS),
            "mean": list(self.mean),
            "deviation": list(self.deviation),
            "residual": vars(self.residual),
            "parameters": self.parameters.tolist(),
            "log_weights": self.log_weights.tolist(),
            "registration": vars(self.registration),
            "white": self._all[:, len(PARAMETERS) :].tolist(),
            "pushes": [{name: part.tolist() for name, part in push._asdict().items()} for push in self.pushes],
        }
        path.write_text(json.dumps(data))

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
            if data["format"] not in _FORMATS or data["names"] != list(PARAMETERS):
                raise ValueError(f"format {data['format']!r}")
            numbers = data["residual"]
            residual = PushResidual(
                tuple(numbers["floor_m"]),
                tuple(numbers["share"]),
                numbers["tails"],
                numbers["power"],
                numbers.get("spread", 0.0),
            )
            double = {
                name: torch.tensor(data[name], dtype=torch.float64) for name in ("parameters", "log_weights", "white")
            }
            check_shape("parameters", double["parameters"], "(N, 8)", last=(len(PARAMETERS),))
            if data["format"] == _FORMATS[0]:  # of one scale for all objects, and of shifts that are normal
                double["white"] = torch.nn.functional.pad(normal_of_4(double["white"]), (0, 1))
            check_shape("white", double["white"], "(N, 6)", last=(_WHITE,))
            if not all(bool(part.isfinite().all()) for part in double.values()):
                raise ValueError("numbers that are not finite")
            pushes = tuple(
                ObservedPush(*(torch.tensor(push[name], dtype=torch.float64) for name in ObservedPush._fields))
                for push in data["pushes"]
            )
            prior = (tuple(data["mean"]), tuple(data["deviation"]))
            rest = data["registration"]
            root = None if rest["root"] is None else tuple(map(tuple, rest["root"]))
            registration = Registration(tuple(rest["deviation"]), tuple(rest["mean"]), root)
            own = (pushes, residual, *prior, registration, double["white"])
            return cls(double["parameters"], double["log_weights"], *own)
        except (KeyError, TypeError, ValueError) as error:
            raise UsageError(
                f"Expected push parameters as `rumi pushes --out` writes them in {path}, got {error}"
            ) from None


class _Known(NamedTuple):
    """What particles say of an object: how it slides, its and the tool's shifts, and the residual's scale."""

    sliding: Sliding
    shifts: Float[Tensor, "N 5"]
    scale: Float[Tensor, "N 1"]


_FORMATS = ("rumi push parameters 2", "rumi push parameters 3")
"""The earlier, which is read too, and the one that is written."""


FIXED, PRIOR = "fixed", "prior"


def push_posterior(name: str, friction: float) -> PushPosterior | None:
    """The posterior that a setting names.

    Args:
        name: "fixed", "prior", or a file.
        friction: median of the prior's coefficient between tool and object: other tools are not of the sets' steel.

    Returns:
        None for "fixed".
    """
    if name == FIXED:
        return None
    if name == PRIOR:
        return PushPosterior.prior(mean=(math.log(max(friction, 1e-3)), *_MEAN[1:]))
    return PushPosterior.load(Path(name))
