"""Locally optimal update of pose particles by one noisy reading of the pose, which may tell nothing or repeat the last.

Each particle's motion and the reading's noise are normal: its weight is the reading's exact predictive density, and its
pose is drawn given what of the reading it takes in (Doucet, Godsill, Andrieu 2000). Beside it stand the densities of
the reading had the object been knocked, or were the tracker's pose an old one.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.so3 import wrap

_LOG_TAU = math.log(2.0 * math.pi)


class PoseReading(NamedTuple):
    """A reading, and how readings come about.

    Attributes:
        value: (3), x, y, yaw, metres and radians.
        noise: (3), its variance.
        others: (A, 3), variances that are added were it an outlier, far or near (the first two, each as likely), or the
            object knocked by a little or far.
        back: (L, 3), poses that it may repeat; the last one is the reading before.
        old: (L, 3), variances about them.
        rates: of outliers, and of readings that repeat the last one.
    """

    value: Float[Tensor, "3"]
    noise: Float[Tensor, "3"]
    others: Float[Tensor, "A 3"]
    back: Float[Tensor, "L 3"]
    old: Float[Tensor, "L 3"]
    rates: tuple[float, float]


class MotionNoise(NamedTuple):
    """Noise of the push model over one motion: its variance is still^2 + way_variance times the way.

    Attributes:
        still: standard deviation of an object that is not pushed, metres.
        way_variance: that the way adds, square metres a metre.
        radius: by which turning counts as way, metres a radian.
    """

    still: float
    way_variance: float
    radius: float

    def variance(self, motion: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Of x, y and yaw after motions (x, y, yaw)."""
        way = motion[:, :2].norm(dim=-1) + self.radius * motion[:, 2].abs()
        metres = self.still**2 + self.way_variance * way
        return torch.stack((metres, metres, metres / self.radius**2), -1)


class ReadingUpdate(NamedTuple):
    """Outcome of a reading.

    Attributes:
        pose: (N, 3), drawn given the reading.
        log_weights: (N), normalised.
        mean: (3), of the poses, of a belief that is near one place.
        log_density: of the reading, had nothing gone wrong.
        others: (A), the same by each of `PoseReading.others`.
        old: (L), the same about each of `PoseReading.back`.
        told: posterior probability that the reading tells of the object.
        untold: that it is an outlier.
        effective: effective sample size of the weights.
    """

    pose: Float[Tensor, "N 3"]
    log_weights: Float[Tensor, "N"]
    mean: Float[Tensor, "3"]
    log_density: float
    others: Float[Tensor, "A"]
    old: Float[Tensor, "L"]
    told: float
    untold: float
    effective: float


def update_by_reading(
    before: Float[Tensor, "N 3"],
    pushed: Float[Tensor, "N 3"],
    log_weights: Float[Tensor, "N"],
    motion: MotionNoise,
    reading: PoseReading,
    *,
    generator: torch.Generator,
) -> ReadingUpdate:
    """Take a reading into particles whose motion the push model foretells.

    Args:
        before: poses before the motion.
        pushed: the same after it, without noise.
        log_weights: normalised.
        motion: its noise.
        reading: what was read.
        generator: of the random draws.
    """
    normal, chance = reading_draws(len(pushed), generator)
    outlier, repeats = reading.rates
    variance, off = motion.variance(pushed - before), pose_difference(reading.value, pushed)
    added = torch.cat((torch.zeros_like(reading.others[:1]), reading.others))
    predicted = _log_normal(off.square(), variance + reading.noise + added[:, None])
    old = _log_normal(pose_difference(reading.value, reading.back).square(), reading.old)
    told = math.log1p(-outlier - repeats) + predicted[0]
    untold = math.log(0.5 * outlier) + torch.logaddexp(predicted[1], predicted[2])
    both = torch.logaddexp(told, torch.logaddexp(untold, math.log(repeats) + old[-1]))
    weighed = log_weights + both
    # each particle's pose, given what of the reading it takes in
    share = (told - both).exp()
    gain = (chance < share)[:, None] * (variance / (variance + reading.noise))
    pose = pushed + gain * off + ((1.0 - gain) * variance).sqrt() * normal
    after = weighed.log_softmax(-1)
    weights = after.exp()
    return ReadingUpdate(
        pose,
        after,
        pose[0] + weights @ pose_difference(pose, pose[0]),
        float(torch.logsumexp(weighed, -1)),
        torch.logsumexp(log_weights + predicted[1:], -1),
        old,
        float(weights @ share),
        float(weights @ (untold - both).exp()),
        float(1.0 / weights.square().sum()),
    )


def reading_draws(count: int, generator: torch.Generator) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """What a reading takes of chance: normal draws of the poses, and uniform ones of whether it tells of them."""
    normal = torch.randn((count, 3), generator=generator, dtype=torch.float64)
    return normal, torch.rand((count,), generator=generator, dtype=torch.float64)


def pose_difference(first: Float[Tensor, "*#b 3"], second: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3"]:
    """First minus second pose (x, y, yaw), the yaw between -pi and pi."""
    off = first - second
    off[..., 2] = wrap(off[..., 2])
    return off


def _log_normal(square: Tensor, variance: Tensor) -> Tensor:
    """Log density of three independent normal parts, by their squares."""
    return -0.5 * ((square / variance + variance.log()).sum(-1) + 3.0 * _LOG_TAU)
