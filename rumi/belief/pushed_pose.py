"""Particle filter of a pushed object's pose by a tracker's noisy poses, that notices when it is wrong.

Particles are poses and ways of sliding; each reading they are pushed along the tool's path, and drawn from their
locally optimal proposal (Doucet, Godsill, Andrieu 2000), exact for normal noise. A reading is the object's pose or, at
a rate that is learnt within the run, tells nothing. Faults, each with a predictive density of its own, are tested by
`ChangeTest`; after an alarm the belief takes in what the likeliest fault leaves true: what a tracker said from the
fault's onset on is undone, by going back to the belief before it and along the tool's path from there.
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
from rumi.belief.pose_reading import MotionNoise, PoseReading, pose_difference, update_by_reading
from rumi.dynamics.along_path import push_along_path
from rumi.dynamics.push_parameters import sliding_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.sliding import Sliding
from rumi.resampling import resample_systematic
from sdf.bounds import Checked, Count, Positive
from sdf.check import check_shape

Fault = Literal["knocked", "late", "stuck", "none of these"]
FAULTS: tuple[Fault, ...] = get_args(Fault)
"""The object was moved by something else; the tracker's pose is old; it repeats one number; nothing known fits."""

_OF_TRACKER = ("late", "stuck")
_LAGS = (3, 6, 12)  # readings by which a tracker is late, each as likely
_KNOCKS = ((0.008, 0.15), (0.03, 0.5))  # standard deviations of knocks, metres and radians, each as likely
_PARTS = ("knocked",) * len(_KNOCKS) + ("late",) * len(_LAGS) + ("stuck", "none of these")
_SHARES = (0.35,) * len(_KNOCKS) + (0.05,) * len(_LAGS) + (0.1, 0.05)
_REMEMBERED = 50  # readings that can be undone
# of how objects slide: wider than the library's prior, since what slides differs along a run too
_SLIDES = (math.log(0.25), 0.15, 1.1, 4.0, 0.0, 0.0, 0.0, 0.0)
_WIDE = (0.5, 0.45, 1.2, 2.3, 0.04, 0.04, 0.06, 0.06)
_FORGET = 0.99  # of a way of sliding at a resampling: it drifts about the prior, so that it is never used up

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
        outlier_m: standard deviation of those about the object, metres, of far ones and of near ones: half each.
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
    outlier_m: tuple[Positive, Positive] = (0.1, 0.008)
    outlier_rad: tuple[Positive, Positive] = (1.0, 0.15)
    mean_run: Annotated[float, Gt(1.0), Lt(math.inf)] = 20_000.0


class PushedPoseBelief(NamedTuple):
    """Belief of an object's pose, and evidence that it is wrong.

    Attributes:
        pose: (N, 3), x, y, yaw, metres and radians.
        log_weights: (N), normalised.
        parameters: (N, 8) of how the object slides; see `rumi.dynamics.push_posterior.PARAMETERS`.
        sliding: the same, for its support.
        tool: (N, 3), of the tool's place against the tracker's, metres; its yaw is not off.
        evidence: of faults.
        trail: (T, 3), mean poses after the last readings, the latest first.
        reading: the last one.
        outliers: readings that told nothing, and readings, with what the prior counts as.
        past: the last beliefs since the last alarm, the earliest first, each with the tool's path from there on.
        fault: what the last alarm was taken for; None before the first, and once a tracker that failed fits again.
        alarm: whether this reading raised one.
    """

    pose: Float[Tensor, "N 3"]
    log_weights: Float[Tensor, "N"]
    parameters: Float[Tensor, "N 8"]
    sliding: Sliding
    tool: Float[Tensor, "N 3"]
    evidence: ChangeEvidence
    trail: Float[Tensor, "T 3"]
    reading: Float[Tensor, "3"]
    outliers: tuple[float, float]
    past: "tuple[tuple[PushedPoseBelief, Tensor], ...]" = ()
    fault: Fault | None = None
    alarm: bool = False

    def mean(self) -> Float[Tensor, "3"]:
        """Mean pose, of a belief that is near one place."""
        first = self.pose[0]
        return first + self.log_weights.exp() @ pose_difference(self.pose, first)

    def covariance(self) -> Float[Tensor, "3 3"]:
        """Of the pose."""
        off = pose_difference(self.pose, self.mean())
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
    prior: PushPosterior = field(default_factory=lambda: PushPosterior.prior(1, mean=_SLIDES, deviation=_WIDE))

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
    def _others(self) -> Float[Tensor, "4 3"]:
        """Variance that is added to what is predicted: those of outliers, those of knocks."""
        own = self.settings
        deviations = (*zip(own.outlier_m, own.outlier_rad, strict=True), *_KNOCKS)
        return torch.tensor([(m, m, rad) for m, rad in deviations], dtype=torch.float64).square()

    @cached_property
    def _tool_m(self) -> Float[Tensor, "3"]:
        """Standard deviation of the tool's place."""
        return torch.tensor((self.settings.tool_m, self.settings.tool_m, 0.0), dtype=torch.float64)

    @cached_property
    def motion(self) -> MotionNoise:
        """Noise of the push model."""
        own = self.settings
        return MotionNoise(own.still, own.share**2 * own.share_way_m, self.body.support.spread)

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
            self._tool_m * torch.randn((own.particles, 3), generator=generator, dtype=torch.float64),
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
        pushed = self._pushed(belief, path)
        past = (*belief.past, (belief._replace(past=()), path))[-_REMEMBERED:]
        if reading is None:
            return self._unread(belief, pushed, generator)._replace(past=past)
        check_shape("reading", reading, "(3,)", last=(3,))
        reading = reading.double()
        if not bool(reading.isfinite().all()):
            raise ValueError(f"Expected a reading of finite numbers, or None where there is none, got {reading}")
        return self._weighed(belief._replace(past=past), pushed, reading, generator)

    def _pushed(self, belief: PushedPoseBelief, path: Tensor) -> Float[Tensor, "N 3"]:
        """Poses after a path of the tool, by the push model."""
        return push_along_path(
            belief.pose,
            path.double() + belief.tool[:, None],
            self.body.pusher,
            self.body.outline,
            belief.sliding,
            substeps=1,
            distances=False,
        ).track[:, -1]

    def _unread(self, belief: PushedPoseBelief, pushed: Tensor, generator: torch.Generator) -> PushedPoseBelief:
        """The belief after a path without a reading."""
        normal = torch.randn(pushed.shape, generator=generator, dtype=pushed.dtype)
        spread = self.motion.variance(pushed - belief.pose).sqrt()
        after = belief._replace(pose=pushed + spread * normal, alarm=False)
        return _followed(after, after.mean())

    def _weighed(
        self, belief: PushedPoseBelief, pushed: Tensor, reading: Tensor, generator: torch.Generator
    ) -> PushedPoseBelief:
        """The belief after a reading, and the evidence of faults in it."""
        own, (lost, readings) = self.settings, belief.outliers
        rate = min(lost / readings, 0.2)
        back = torch.cat((belief.trail[list(_LAGS)], belief.reading[None]))
        read = PoseReading(reading, self._noise, self._others, back, self._old, (rate, own.repeats))
        found = update_by_reading(belief.pose, pushed, belief.log_weights, self.motion, read, generator=generator)
        alternatives = torch.cat((found.others[2:], found.old, found.others[:1]))  # in the order of their names
        test = self.test
        evidence = test.update(belief.evidence, alternatives - found.log_density)
        alarm = bool(test.alarm(evidence))
        after = belief._replace(
            pose=found.pose,
            log_weights=found.log_weights,
            evidence=evidence,
            reading=reading,
            outliers=(lost + found.untold, readings + 1.0),
            alarm=alarm,
            fault=None if found.told > 0.5 and belief.fault in _OF_TRACKER else belief.fault,
        )
        if alarm:
            return self._recovered(after, generator)
        after = _followed(after, found.mean)
        if found.effective < 0.5 * len(found.log_weights):
            return self._resampled(after, generator)
        return after

    def _recovered(self, belief: PushedPoseBelief, generator: torch.Generator) -> PushedPoseBelief:
        """The belief after an alarm: what the likeliest fault leaves true.

        A knock leaves the readings true: half of the particles begin anew about the last one, the rest are as they
        were. A tracker that is late or stuck leaves the belief before it true: nothing of what it said since is kept.
        """
        shares = self.test.explanations(belief.evidence)[1:]
        by_name = {
            name: sum(float(s) for s, part in zip(shares, _PARTS, strict=True) if part == name) for name in FAULTS
        }
        fault = max(FAULTS, key=lambda name: by_name[name])
        own = self.settings
        if fault in _OF_TRACKER:
            part = max(_parts(fault), key=lambda number: float(shares[number]))
            belief = self._undone(belief, int(self.test.onset(belief.evidence)[part]), generator)
        fresh = belief._replace(
            evidence=self.test.begin(),
            outliers=(own.outlier * own.outlier_readings, own.outlier_readings),
            past=(),
            fault=fault,
            alarm=True,
        )
        if fault in _OF_TRACKER:
            return fresh  # whose poses were followed anew
        kept = self._resampled(fresh, generator)
        about = self._about(belief.reading, generator)
        some = (torch.arange(len(about)) % 2 == 0)[:, None]
        after = kept._replace(pose=torch.where(some, about, kept.pose))
        return _followed(after, after.mean())

    def _undone(self, belief: PushedPoseBelief, onset: int, generator: torch.Generator) -> PushedPoseBelief:
        """The belief without the readings from number `onset` since the last alarm on, as far as it remembers."""
        before = [number for number, (past, _) in enumerate(belief.past) if int(past.evidence.readings) < onset]
        rest = belief.past[max(before, default=0) :]
        found = rest[0][0]
        for _, path in rest:
            found = self._unread(found, self._pushed(found, path), generator)
        return found._replace(reading=belief.reading)

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
            tool=_FORGET * belief.tool[rows] + left * self._tool_m * moved,
        )

    def _about(self, reading: Tensor, generator: torch.Generator) -> Float[Tensor, "N 3"]:
        shape = (self.settings.particles, 3)
        return reading + self._noise.sqrt() * torch.randn(shape, generator=generator, dtype=reading.dtype)


def _followed(belief: PushedPoseBelief, mean: Tensor) -> PushedPoseBelief:
    return belief._replace(trail=torch.cat((mean[None], belief.trail[:-1])))


def _parts(fault: Fault) -> list[int]:
    return [number for number, part in enumerate(_PARTS) if part == fault]
