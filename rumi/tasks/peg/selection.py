"""The second stage: where to touch next in the time there is, until the holes are known well enough."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.belief.static_filter import ResampleMoveFilter, ResampleMoveSettings, StaticBelief
from rumi.clock import Now, SimulatedClock
from rumi.information.contact_gain import ContactKind, rectangle_likelihood, touch_gain
from rumi.information.entropy import NeighbourEntropy
from rumi.information.neighbours import StateMetric
from rumi.information.state_rules import CovarianceRule, MassRule, TargetEstimate
from rumi.planning.anytime import Candidate, Selection, in_descending_posterior, select
from rumi.planning.duration_model import DurationModel
from rumi.resampling import resample_systematic
from rumi.robot.motion_time import path_time
from rumi.tasks.peg.cell import Felt
from rumi.tasks.peg.moves import Motion, motions, outcomes
from rumi.tasks.peg.search import free_ways
from rumi.tasks.peg.settings import PEG_STOPS, PegSettings
from sdf.sweep import turned
from sensors.touch.rectangle_touch import RectangleTouches
from sensors.touch.touch_likelihood import box_face_log_likelihoods

_FIRST_S = 0.05
"""Seconds that an evaluation is taken to last before any was measured."""
_REMEMBERED = 500


def block_filter(settings: PegSettings) -> ResampleMoveFilter:
    """The filter of the second stage: the block's middle on the table's part, and any yaw."""
    size = torch.tensor(settings.table_m, dtype=torch.float64)

    def log_prior(poses: Tensor) -> Tensor:
        on = (poses[..., :2].abs() <= 0.5 * size).all(-1)
        return torch.where(on, 0.0, -torch.inf).to(poses)

    metric = StateMetric.planar(0.5 * settings.length_m)
    if settings.power == 1.0:
        return ResampleMoveFilter(metric, log_prior)
    lever = 0.5 * settings.length_m
    least = 0.3 * min(settings.point_m, lever * float(settings.noise.normal_rad))
    return ResampleMoveFilter(metric, log_prior, ResampleMoveSettings(jitter_m=(min(least, 3e-4), 0.05)))


def updated(
    follow: ResampleMoveFilter,
    belief: StaticBelief,
    new: RectangleTouches,
    every: RectangleTouches,
    settings: PegSettings,
    *,
    generator: torch.Generator,
) -> StaticBelief:
    """The belief after a reading; one more exact than particles are apart is let in little by little."""
    if settings.power < 1.0:
        return follow.update_tempered(belief, new, every, generator=generator)
    return follow.update(belief, new, every, generator=generator)[0]


def evidence_of(felt: Felt, settings: PegSettings) -> RectangleTouches:
    """What a motion says of the block: its touch, and the ways that were free."""
    new = RectangleTouches.none(settings.block.half(), settings.noise, settings.radius_m)
    for way in free_ways(felt, settings):
        new = new.with_way(*way)
    if felt.kind == ContactKind.TOUCH:
        new = new.with_touch(felt.point, felt.normal)
    elif felt.kind != ContactKind.NOTHING:
        new = new.with_top(felt.point)
    return new


class Thought(NamedTuple):
    """A decision.

    Attributes:
        selection: of a motion.
        begun_s, ended_s: on the clock.
    """

    selection: Selection[Motion]
    begun_s: float
    ended_s: float


@dataclass
class Chooser:
    """Chooses motions under a deadline, on a simulated clock that thinking takes time of.

    Attributes:
        settings: of the task.
        clock: that thinking advances.
        generator: of all draws.
        measured: work and seconds of the last evaluations, where they are measured.
        making: seconds that each of the last candidates took to make, then.
    """

    settings: PegSettings
    clock: SimulatedClock
    generator: torch.Generator
    measured: list[tuple[float, float]]
    making: list[float] = field(default_factory=list)

    def choose(self, belief: StaticBelief, tip: Float[Tensor, "3"], away: Float[Tensor, "2"] | None) -> Thought:
        """The motion to carry out next.

        Args:
            belief: over (x, y, yaw).
            tip: where the ball's centre is.
            away: normal of the side that it rests against, None where it rests against none.
        """
        own = self.settings
        if own.evaluation_s is None and not self.measured:
            self._warmed(belief, tip, away)
        watch = _Watch(self.clock, running=own.evaluation_s is None)
        work = float(own.readings * own.particles)
        index = self._configurations(belief)

        def of_particle(place: int) -> Iterator[Candidate[Motion]]:
            found = motions(belief.states[index[place]], tip, away, belief.states, belief.log_weights, own)
            for number in torch.randperm(len(found), generator=self.generator).tolist():
                took = float(path_time(found[number].path, own.limits))
                yield Candidate(found[number], took, work)

        # where real time counts, what was done so far is of the time that there is
        before = watch() - watch.begun_s
        made = _Timed(in_descending_posterior(belief.log_target[index], of_particle), watch)
        selection = select(
            made,
            self._stated(self._gain(belief)),
            max(own.action_budget_s - before, 0.0),
            evaluation=self._evaluation(),
            generation=_bound_of(self.making),
            doublings=own.doublings,
            now=watch,
        )
        if own.evaluation_s is None:
            self.measured = [*self.measured, *selection.measured][-_REMEMBERED:]
            self.making = [*self.making, *made.seconds][-_REMEMBERED:]
        watch.stop()
        return Thought(selection, watch.begun_s, self.clock())

    def _warmed(self, belief: StaticBelief, tip: Float[Tensor, "3"], away: Float[Tensor, "2"] | None) -> None:
        """Do all once, for nothing: what is compiled at its first use is no measure of the time that it takes."""
        aside = replace(self, generator=torch.Generator().manual_seed(0))
        index = int(aside._configurations(belief)[0])
        found = motions(belief.states[index], tip, away, belief.states, belief.log_weights, self.settings)
        aside._gain(belief)(found[0])

    def _configurations(self, belief: StaticBelief) -> Int[Tensor, "C"]:
        """The likeliest particle, and others drawn by weight: the next likeliest would be nearly the same."""
        size = len(belief.log_weights)
        drawn = resample_systematic(belief.log_weights, generator=self.generator)
        count = self.settings.configurations - 1
        others = drawn[torch.randperm(size, generator=self.generator)[:count]]
        held = torch.where(belief.log_weights > -torch.inf, belief.log_target, -torch.inf)
        return torch.cat((held.argmax()[None], others))

    def _gain(self, belief: StaticBelief) -> Callable[[Motion], float]:
        own = self.settings
        likelihood = rectangle_likelihood(belief.states, own.block.half(), own.noise)

        def gain(motion: Motion) -> float:
            found = touch_gain(
                belief.log_weights,
                outcomes(motion, belief.states, own),
                likelihood,
                readings=own.readings,
                noise=own.noise if own.sampled else None,
                generator=self.generator,
            )
            return float(found)

        return gain

    def _stated(self, gain: Callable[[Motion], float]) -> Callable[[Motion], float]:
        """The same, whose stated time passes on the simulated clock; the machine's own passes by itself."""
        stated = self.settings.evaluation_s
        if stated is None:
            return gain

        def timed(motion: Motion) -> float:
            value = gain(motion)
            self.clock.advance(stated)
            return value

        return timed

    def _evaluation(self) -> DurationModel:
        if self.settings.evaluation_s is not None:
            return DurationModel.known(self.settings.evaluation_s)
        if not self.measured:
            return DurationModel.known(_FIRST_S)
        work, seconds = zip(*self.measured, strict=True)
        return DurationModel.fit(work, seconds)


class _Watch:
    """The simulated clock during a decision: as it stands, or, running, with all time that passes on this machine."""

    def __init__(self, clock: SimulatedClock, *, running: bool) -> None:
        self._clock, self._running = clock, running
        self.begun_s, self._at = clock(), time.perf_counter()

    def __call__(self) -> float:
        """Seconds now."""
        return self._clock() + (time.perf_counter() - self._at if self._running else 0.0)

    def stop(self) -> None:
        """Let the simulated clock know what time it is."""
        if self._running:
            self._clock.advance(time.perf_counter() - self._at)
            self._running = False


class _Timed:
    """Candidates, and the seconds that each of them took to make."""

    def __init__(self, source: Iterator[Candidate[Motion]], now: Now) -> None:
        self._source, self._now = source, now
        self.seconds: list[float] = []

    def __iter__(self) -> Iterator[Candidate[Motion]]:
        return self

    def __next__(self) -> Candidate[Motion]:
        begun = self._now()
        candidate = next(self._source)
        self.seconds.append(self._now() - begun)
        return candidate


def _bound_of(making: list[float]) -> DurationModel | None:
    """How long the next candidate takes to make, as far as earlier ones tell; None where they are made in no time."""
    return DurationModel.fit([1.0] * len(making), making) if making else None


def sides_touched(pose: Float[Tensor, "3"], every: RectangleTouches) -> int:
    """How many different sides the touches are on, if the block is at this pose."""
    if not len(every.points_w):
        return 0
    back = turned(-pose[2])
    points = (every.points_w - pose[:2]) @ back.mT
    side = box_face_log_likelihoods(points, every.normals_w @ back.mT, every.half, every.noise).argmax(-1)
    return len(side.unique())


def confirmed(
    belief: StaticBelief,
    every: RectangleTouches,
    aim: TargetEstimate,
    settings: PegSettings,
    *,
    generator: torch.Generator,
) -> tuple[StaticBelief, TargetEstimate]:
    """Other particles of the same posterior, and how probable the aim is by them.

    The aim was chosen for the particles that it is judged by, after each of many readings: by these it would seem
    better than it is at the very moment at which it is taken.
    """
    index = resample_systematic(belief.log_weights, generator=generator)
    even = torch.zeros_like(belief.log_weights).log_softmax(-1)
    fresh = StaticBelief(belief.states[index], even, belief.log_target[index])
    fresh, _ = block_filter(settings).move(fresh, every, ess=belief.ess, generator=generator)
    return fresh, aim._replace(probability=probability_of(aim.points, fresh, settings))


def probability_of(points: Float[Tensor, "2 2"], belief: StaticBelief, settings: PegSettings) -> float:
    """Of both holes within the tolerance of two points, either way round."""
    holes = settings.block.holes(belief.states)
    apart = torch.stack([(holes - order).norm(dim=-1).amax(-1) for order in (points, points.flip(0))]).amin(0)
    return float((apart <= settings.tolerance_m).to(holes) @ belief.log_weights.exp())


def sure(belief: StaticBelief, every: RectangleTouches, aim: TargetEstimate, settings: PegSettings) -> bool:
    """Whether the rule to stop holds."""
    return len(every.points_w) >= settings.contacts and PEG_STOPS[settings.stop](belief, every, aim, settings)


def by_mass(belief: StaticBelief, every: RectangleTouches, aim: TargetEstimate, settings: PegSettings) -> bool:
    """Whether both holes are within the tolerance of where they are thought to be, with the probability."""
    return aim.probability >= settings.probability


def by_contacts(belief: StaticBelief, every: RectangleTouches, aim: TargetEstimate, settings: PegSettings) -> bool:
    """Whether enough different sides were touched."""
    return sides_touched(belief.best, every) >= settings.sides


def by_covariance(belief: StaticBelief, every: RectangleTouches, aim: TargetEstimate, settings: PegSettings) -> bool:
    """Whether the pose spreads little."""
    spread = (settings.spread_m, settings.spread_m, math.radians(settings.spread_deg))
    return CovarianceRule(spread, (None, None, math.pi)).holds(belief.states, belief.log_weights)


def by_entropy(belief: StaticBelief, every: RectangleTouches, aim: TargetEstimate, settings: PegSettings) -> bool:
    """Whether the pose's differential entropy is low."""
    # the block looks the same half a turn on: of twice its yaw, of which there is twice as much
    states = belief.states * belief.states.new_tensor([1.0, 1.0, 2.0])
    metric = StateMetric.planar(0.25 * settings.length_m)
    return float(NeighbourEntropy(metric)(states, belief.log_weights)) <= settings.most_nats + math.log(2.0)


def aim_of(belief: StaticBelief, settings: PegSettings) -> TargetEstimate:
    """Where the holes most probably are, both within the tolerance."""
    rule = MassRule(settings.tolerance_m, settings.probability)
    return rule.aim(settings.block.holes(belief.states), belief.log_weights)
