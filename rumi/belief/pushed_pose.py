"""Particle filter of a pushed object's pose by a tracker's noisy poses, that notices when it is wrong.

Particles are poses and ways of sliding; each reading they are pushed along the tool's path, and drawn from their
locally optimal proposal (Doucet, Godsill, Andrieu 2000), exact for normal noise. A reading is the object's pose or, at
a rate that is learnt within the run, tells nothing. Faults, each with a predictive density of its own, are tested by
`ChangeTest`; after an alarm the belief takes in what the likeliest fault leaves true.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Literal, NamedTuple, get_args

import torch
from annotated_types import Gt, Interval, Lt
from jaxtyping import Float
from torch import Tensor

from rumi.belief.change_test import ChangeEvidence, ChangeTest
from rumi.dynamics.along_path import push_along_path
from rumi.dynamics.push_parameters import sliding_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.sliding import Sliding
from rumi.resampling import resample_systematic
from rumi.weights import effective_sample_size
from sdf.bounds import Checked, Count, Positive
from sdf.check import check_shape
from sdf.so3 import wrap

Fault = Literal["knocked", "late", "stuck", "none of these"]
FAULTS: tuple[Fault, ...] = get_args(Fault)
"""The object was moved by something else; the tracker's pose is old; it repeats one number; nothing known fits."""

_OF_TRACKER = ("late", "stuck")
_LAGS = (3, 6, 12)  # readings by which a tracker is late, each as likely
_KNOCKS = ((0.008, 0.15), (0.03, 0.5))  # standard deviations of knocks, metres and radians, each as likely
_PARTS = ("knocked",) * len(_KNOCKS) + ("late",) * len(_LAGS) + ("stuck", "none of these")
_SHARES = (0.35,) * len(_KNOCKS) + (0.05,) * len(_LAGS) + (0.1, 0.05)
_FORGET = 0.99  # of a way of sliding at a resampling: it drifts about the prior, so that it is never used up
_LOG_TAU = math.log(2.0 * math.pi)


_DEGREE = math.radians(1.0)
_Rate = Annotated[float, Interval(gt=0.0, lt=0.5)]


@dataclass(frozen=True)
class PushedPoseSettings(Checked):
    """Settings of the filter.

    Attributes:
        particles: how many.
        reading_m: standard deviation of a read position, each axis, metres.
        reading_rad: of a read yaw.
        still: standard deviation of the motion of an object that is not pushed, over one reading, metres (and radians
            times the mean radius of its base).
        share: of motion that is pushed, over `share_way_m` of it; it grows with the way's root.
        share_way_m: see `share`.
        tool_m: standard deviation of the tool's place against the tracker's, each axis, metres: it is learnt.
        repeats: rate of readings that repeat the last one to the digit, a frame that was lost.
        outlier: rate of readings that tell nothing, before the run.
        outlier_readings: how many readings that rate counts as.
        outlier_m: standard deviation of those about the object, metres.
        outlier_rad: of their yaw.
        mean_run: faultless readings between false alarms, at least, on average.
    """

    particles: Count = 200
    reading_m: Positive = 1e-3
    reading_rad: Positive = _DEGREE
    still: Positive = 5e-5
    share: Positive = 0.06
    share_way_m: Positive = 0.05
    tool_m: Positive = 1.5e-3
    repeats: _Rate = 0.05
    outlier: _Rate = 0.01
    outlier_readings: Positive = 200.0
    outlier_m: Positive = 0.1
    outlier_rad: Positive = 1.0
    mean_run: Annotated[float, Gt(1.0), Lt(math.inf)] = 20_000.0


class PushedPoseBelief(NamedTuple):
    """Belief of an object's pose, and evidence that it is wrong.

    Attributes:
        pose: (N, 3), x, y, yaw, metres and radians.
        log_weights: (N), normalised.
        parameters: (N, 8) of how the object slides; see `rumi.dynamics.push_posterior.PARAMETERS`.
        sliding: the same, for its support.
        tool: (N, 2), of the tool's place against the tracker's, metres.
        evidence: of faults.
        trail: (T, 3), mean poses after the last readings, the latest first.
        reading: the last one.
        outliers: readings that told nothing, and readings, with what the prior counts as.
        fault: what the last alarm was taken for; None before the first, and once a tracker that failed fits again.
        alarm: whether this reading raised one.
    """

    pose: Float[Tensor, "N 3"]
    log_weights: Float[Tensor, "N"]
    parameters: Float[Tensor, "N 8"]
    sliding: Sliding
    tool: Float[Tensor, "N 2"]
    evidence: ChangeEvidence
    trail: Float[Tensor, "T 3"]
    reading: Float[Tensor, "3"]
    outliers: tuple[float, float]
    fault: Fault | None = None
    alarm: bool = False

    def mean(self) -> Float[Tensor, "3"]:
        """Mean pose, of a belief that is near one place."""
        first = self.pose[0]
        return first + self.log_weights.exp() @ _off(self.pose, first)

    def covariance(self) -> Float[Tensor, "3 3"]:
        """Of the pose."""
        off = _off(self.pose, self.mean())
        return off.T @ (self.log_weights.exp()[:, None] * off)


@dataclass(frozen=True)
class PushedPoseFilter:
    """The filter; holds what does not change, never the belief.

    Attributes:
        body: the object and the tool.
        settings: of the filter.
        prior: of how objects slide.
    """

    body: PushedBody
    settings: PushedPoseSettings = field(default_factory=PushedPoseSettings)
    prior: PushPosterior = field(default_factory=lambda: PushPosterior.prior(1))

    @cached_property
    def test(self) -> ChangeTest:
        """Of faults: what is listed, and how often it is wrong."""
        return ChangeTest(_SHARES, 1.0 / self.settings.mean_run, "rate")

    @cached_property
    def _noise(self) -> Float[Tensor, "3"]:
        """Variance of a reading."""
        own = self.settings
        return torch.tensor((own.reading_m, own.reading_m, own.reading_rad), dtype=torch.float64).square()

    @cached_property
    def _added(self) -> Float[Tensor, "4 1 3"]:
        """Variance that is added to what is predicted: nothing, an outlier's, those of knocks."""
        own = self.settings
        deviations = ((0.0, 0.0), (own.outlier_m, own.outlier_rad), *_KNOCKS)
        return torch.tensor([(m, m, rad) for m, rad in deviations], dtype=torch.float64).square()[:, None]

    @cached_property
    def _old(self) -> Float[Tensor, "4 3"]:
        """Variance of a reading about old poses, and about the last reading, which is repeated but for digits."""
        return self._noise * self._noise.new_tensor([2.0] * len(_LAGS) + [1e-4])[:, None]

    def initial(self, reading: Float[Tensor, "3"], *, generator: torch.Generator) -> PushedPoseBelief:
        """The belief after a first reading."""
        check_shape("reading", reading, "(3,)", last=(3,))
        reading, own = reading.double(), self.settings
        posterior = PushPosterior.prior(own.particles, mean=self.prior.mean, deviation=self.prior.deviation)
        return PushedPoseBelief(
            self._about(reading, generator),
            torch.zeros(own.particles, dtype=torch.float64).log_softmax(-1),
            posterior.parameters,
            sliding_of(posterior.parameters, self.body.support),
            own.tool_m * torch.randn((own.particles, 2), generator=generator, dtype=torch.float64),
            self.test.begin(),
            reading[None].repeat(max(_LAGS) + 1, 1),
            reading,
            (own.outlier * own.outlier_readings, own.outlier_readings),
        )

    @torch.no_grad()
    def step(
        self,
        belief: PushedPoseBelief,
        path: Float[Tensor, "K1 3"],
        reading: Float[Tensor, "3"] | None,
        *,
        generator: torch.Generator,
    ) -> PushedPoseBelief:
        """Take in the tool's path since the last reading, and a reading.

        Args:
            belief: before it.
            path: (x, y, yaw) of the tool, the last reading's instant first.
            reading: the tracker's (x, y, yaw), metres and radians; None where it gave none.
            generator: of the random draws.

        Raises:
            ValueError: a shape does not fit, or something is not finite.
        """
        off = torch.cat((belief.tool, torch.zeros_like(belief.tool[:, :1])), -1)
        pushed = push_along_path(
            belief.pose, path.double() + off[:, None], self.body.pusher, self.body.outline, belief.sliding, substeps=1
        ).track[:, -1]
        spread = self._motion_deviation(pushed - belief.pose)
        if reading is None:
            normal = torch.randn(pushed.shape, generator=generator, dtype=pushed.dtype)
            return self._remembered(belief._replace(pose=pushed + spread * normal, alarm=False))
        check_shape("reading", reading, "(3,)", last=(3,))
        reading = reading.double()
        if not bool(reading.isfinite().all()):
            raise ValueError(f"Expected a reading of finite numbers, or None where there is none, got {reading}")
        return self._remembered(self._weighed(belief, pushed, spread.square(), reading, generator))

    def _weighed(
        self, belief: PushedPoseBelief, pushed: Tensor, motion: Tensor, reading: Tensor, generator: torch.Generator
    ) -> PushedPoseBelief:
        """The belief after a reading, and the evidence of faults in it."""
        own, noise, added = self.settings, self._noise, self._added
        off = _off(reading, pushed)
        weights, (lost, readings) = belief.log_weights, belief.outliers
        # of each particle: as predicted, as an outlier, and knocked, a little or far
        predicted = _log_normal(off.square(), (motion + noise) + added)
        mixed = torch.logsumexp(weights + predicted, -1)
        # of the tracker: as it was a while ago, or the last reading to the digit
        back = torch.cat((belief.trail[list(_LAGS)], belief.reading[None]))
        tracker = _log_normal(_off(reading, back).square(), self._old)
        rate = min(lost / readings, 0.2)
        told, untold = math.log1p(-rate - own.repeats) + predicted[0], math.log(rate) + predicted[1]
        both = torch.logaddexp(told, torch.logaddexp(untold, math.log(own.repeats) + tracker[-1]))
        weighed = weights + both
        null = torch.logsumexp(weighed, -1)
        alternatives = torch.cat((mixed[2:], tracker, mixed[1:2]))  # in the order of their names
        test = self.test
        evidence = test.update(belief.evidence, alternatives - null)
        alarm = bool(test.alarm(evidence))
        # each particle's pose, given what of the reading it takes in
        told_share = (told - both).exp()
        takes = torch.rand(told.shape, generator=generator, dtype=told.dtype) < told_share
        gain = takes[:, None] * (motion / (motion + noise))
        normal = torch.randn(pushed.shape, generator=generator, dtype=pushed.dtype)
        pose = pushed + gain * off + ((1.0 - gain) * motion).sqrt() * normal
        log_weights = weighed.log_softmax(-1)
        lost += float(log_weights.exp() @ (untold - both).exp())
        fits = float(log_weights.exp() @ told_share) > 0.5
        after = belief._replace(
            pose=pose,
            log_weights=log_weights,
            evidence=evidence,
            reading=reading,
            outliers=(lost, readings + 1.0),
            alarm=alarm,
            fault=None if fits and belief.fault in _OF_TRACKER else belief.fault,
        )
        if alarm:
            return self._recovered(after, generator)
        if float(effective_sample_size(log_weights)) < 0.5 * len(log_weights):
            return self._resampled(after, generator)
        return after

    def _recovered(self, belief: PushedPoseBelief, generator: torch.Generator) -> PushedPoseBelief:
        """The belief after an alarm: what the likeliest fault leaves true.

        A knock leaves the readings true: half of the particles begin anew about the last one, the rest are as they
        were. A tracker that is late or stuck leaves the belief true, and nothing of what it said since is kept.
        """
        shares = self.test.explanations(belief.evidence)[1:]
        by_name = {
            name: sum(float(s) for s, part in zip(shares, _PARTS, strict=True) if part == name) for name in FAULTS
        }
        fault = max(FAULTS, key=lambda name: by_name[name])
        own = self.settings
        fresh = belief._replace(
            evidence=self.test.begin(),
            outliers=(own.outlier * own.outlier_readings, own.outlier_readings),
            fault=fault,
        )
        if fault in _OF_TRACKER:
            return fresh
        kept = self._resampled(fresh, generator)
        about = self._about(belief.reading, generator)
        some = (torch.arange(len(about)) % 2 == 0)[:, None]
        return kept._replace(pose=torch.where(some, about, kept.pose))

    def _resampled(self, belief: PushedPoseBelief, generator: torch.Generator) -> PushedPoseBelief:
        """Equally weighted, with ways of sliding that drift."""
        rows = resample_systematic(belief.log_weights, generator=generator)
        mean, deviation = (belief.pose.new_tensor(part) for part in (self.prior.mean, self.prior.deviation))
        normal = torch.randn(belief.parameters.shape, generator=generator, dtype=belief.pose.dtype)
        left = math.sqrt(1.0 - _FORGET**2)
        drift = left * deviation * normal
        moved = torch.randn(belief.tool.shape, generator=generator, dtype=belief.tool.dtype)
        parameters = mean + _FORGET * (belief.parameters[rows] - mean) + drift
        return belief._replace(
            pose=belief.pose[rows],
            log_weights=torch.zeros_like(belief.log_weights).log_softmax(-1),
            parameters=parameters,
            sliding=sliding_of(parameters, self.body.support),
            tool=_FORGET * belief.tool[rows] + left * self.settings.tool_m * moved,
        )

    def _remembered(self, belief: PushedPoseBelief) -> PushedPoseBelief:
        return belief._replace(trail=torch.cat((belief.mean()[None], belief.trail[:-1])))

    def _about(self, reading: Tensor, generator: torch.Generator) -> Float[Tensor, "N 3"]:
        shape = (self.settings.particles, 3)
        return reading + self._noise.sqrt() * torch.randn(shape, generator=generator, dtype=reading.dtype)

    def _motion_deviation(self, motion: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Of the push model's error over a motion."""
        own, radius = self.settings, self.body.support.spread
        way = motion[:, :2].norm(dim=-1) + radius * motion[:, 2].abs()
        metres = (own.still**2 + own.share**2 * own.share_way_m * way).sqrt()
        return torch.stack((metres, metres, metres / radius), -1)


def _off(first: Tensor, second: Tensor) -> Tensor:
    off = first - second
    off[..., 2] = wrap(off[..., 2])
    return off


def _log_normal(square: Tensor, variance: Tensor) -> Tensor:
    """Log density of three independent normal parts, by their squares."""
    return -0.5 * ((square / variance + variance.log()).sum(-1) + 3.0 * _LOG_TAU)
