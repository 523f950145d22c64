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
from typing import Annotated, get_args

import torch
from annotated_types import Gt, Interval, Lt
from jaxtyping import Float
from torch import Tensor

from rumi.belief.change_test import ChangeTest
from rumi.belief.pose_reading import MotionNoise
from rumi.belief.pushed_pose_reading import Fault, PushedPoseBelief, ReadingModel, followed, moved_on, take_reading
from rumi.belief.pushed_pose_resampling import Drift, resampled
from rumi.dynamics.push_parameters import sliding_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import PushedBody
from rumi.weights import equal_weights
from sdf.bounds import Checked, Count, Positive
from sdf.check import check_finite, check_shape

FAULTS: tuple[Fault, ...] = get_args(Fault)

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
    def _tool_m(self) -> Float[Tensor, "3"]:
        """Standard deviation of the tool's place."""
        return torch.tensor((self.settings.tool_m, self.settings.tool_m, 0.0), dtype=torch.float64)

    @cached_property
    def _drift(self) -> Drift:
        """Of ways of sliding and of the tool's place."""
        mean, deviation = (torch.tensor(part, dtype=torch.float64) for part in (self.prior.mean, self.prior.deviation))
        return Drift(mean, deviation, self._tool_m, _FORGET, self.body.support)

    @cached_property
    def model(self) -> ReadingModel:
        """Of readings and motions."""
        own, support = self.settings, self.body.support
        noise = torch.tensor((own.reading_m, own.reading_m, own.reading_rad), dtype=torch.float64).square()
        deviations = (*zip(own.outlier_m, own.outlier_rad, strict=True), *_KNOCKS)
        others = torch.tensor([(m, m, rad) for m, rad in deviations], dtype=torch.float64).square()
        # about old poses, and about the last reading, which is repeated but for digits
        old = noise * noise.new_tensor([2.0] * len(_LAGS) + [1e-4])[:, None]
        motion = MotionNoise(own.still, own.share**2 * own.share_way_m, support.spread)
        return ReadingModel(self.body, motion, noise, others, old, _LAGS, own.repeats, self.test)

    def initial(self, reading: Float[Tensor, "3"], *, generator: torch.Generator) -> PushedPoseBelief:
        """The belief after a first reading."""
        check_shape("reading", reading, "(3,)", last=(3,))
        reading, own = reading.double(), self.settings
        posterior = PushPosterior.prior(own.particles, mean=self.prior.mean, deviation=self.prior.deviation)
        return PushedPoseBelief(
            self._about(reading, generator),
            equal_weights(own.particles),
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
        check_shape("path", path, "(K1, 3)", last=(3,))
        check_finite("path", path)
        path = path.double()
        past = (*belief.past, (belief._replace(past=()), path))[-_REMEMBERED:]
        if reading is None:
            return moved_on(self.model, belief, [path], generator=generator)._replace(past=past)
        check_shape("reading", reading, "(3,)", last=(3,))
        if not math.isfinite(float(reading.sum())):
            raise ValueError(f"Expected a reading of finite numbers, or None where there is none, got {reading}")
        return self._weighed(belief, path, reading.double(), past, generator)

    def _weighed(
        self,
        belief: PushedPoseBelief,
        path: Tensor,
        reading: Tensor,
        past: tuple[tuple[PushedPoseBelief, Tensor], ...],
        generator: torch.Generator,
    ) -> PushedPoseBelief:
        """The belief after a reading, and the evidence of faults in it."""
        lost, readings = belief.outliers
        found = take_reading(self.model, belief, path, reading, min(lost / readings, 0.2), generator=generator)
        alarm = found.log_evidence >= self.test.threshold
        after = PushedPoseBelief(
            found.pose,
            found.log_weights,
            belief.parameters,
            belief.sliding,
            belief.tool,
            found.evidence,
            belief.trail if alarm else found.trail,
            reading,
            (lost + found.untold, readings + 1.0),
            past,
            None if found.told > 0.5 and belief.fault in _OF_TRACKER else belief.fault,
            alarm,
        )
        if alarm:
            return self._recovered(after, generator)
        if found.effective < 0.5 * len(found.log_weights):
            return resampled(after, self._drift, generator=generator)
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
        kept = resampled(fresh, self._drift, generator=generator)
        about = self._about(belief.reading, generator)
        some = (torch.arange(len(about)) % 2 == 0)[:, None]
        after = kept._replace(pose=torch.where(some, about, kept.pose))
        return followed(after)

    def _undone(self, belief: PushedPoseBelief, onset: int, generator: torch.Generator) -> PushedPoseBelief:
        """The belief without the readings from number `onset` since the last alarm on, as far as it remembers."""
        before = [number for number, (past, _) in enumerate(belief.past) if int(past.evidence.readings) < onset]
        rest = belief.past[max(before, default=0) :]
        found = moved_on(self.model, rest[0][0], [path for _, path in rest], generator=generator)
        return found._replace(reading=belief.reading)

    def _about(self, reading: Tensor, generator: torch.Generator) -> Float[Tensor, "N 3"]:
        shape = (self.settings.particles, 3)
        return reading + self.model.noise.sqrt() * torch.randn(shape, generator=generator, dtype=reading.dtype)


def _parts(fault: Fault) -> list[int]:
    return [number for number, part in enumerate(_PARTS) if part == fault]
