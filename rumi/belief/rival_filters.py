"""Static multiple models: beliefs under faults that hold from the first view on, each by a filter of its own.

Every rival takes one fault to be true, follows all readings, and adds up its marginal likelihood; what it says against
"no fault" is the ratio of the two (Magill 1965, multiple model estimation). Single readings tell little of an object
five per cent larger, or of a view some millimetres off: many that agree do. The rivals of a size have the object in
another size, by the same view; those of a hand and of a view that are off begin where an offset has put the object, and
keep nothing of the view; that of a push model which is off has a much wider prior of how the object slides.

A marginal likelihood of sequential Monte Carlo errs by several nats after some pushes. That of no fault is the mean
over the belief and a copy of it: the mean of unbiased estimates is one (pseudo-marginal, Andrieu and Roberts 2009).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.first_poses import SPREADS
from rumi.belief.offset_rings import CAMERA, HAND, Ring, drawn
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.systematic_errors import as_it_is, as_seen
from rumi.belief.tempering import log_mean
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_moves import Moves, start_density
from rumi.resampling import resample_systematic, systematic
from rumi.seeding import normal
from rumi.weights import equal_weights
from sdf.grid_sdf import GridSDF
from sensors.reading import Reading

RIVALS = ("hand off", "camera off", "another size", "push model off")
"""Faults that rivals stand for."""

NO_FAULT = "no fault"

MOVED_KERNEL = (0.0015, 0.0015, math.radians(2.0))
"""Kernel of the density of start poses that a fault moved: metres, metres, radians."""

SIZES = (0.93, 0.965, 1.035, 1.07)
"""Other sizes of an object, times its own, each as likely."""

FURTHER = 4
"""Copies of no fault where an alarm is due."""

_PARTICLES = 225
_OF_A_SIZE, _DRAWS, _STARTS, _SWEEPS = 75, 1500, 150, 2
_PLACES = 400  # start poses that the prior of what was moved is the density of
_NARROWER, _LEAST_KERNEL_M = 0.5, 0.0003  # kernel of start poses by a view: of their deviation, and at least
_WIDE_VIEW_M = 0.001  # deviation of a view from which on that density is told by the kernel
_HOPELESS = 8.0  # nats that a rival is less likely than no fault, from which on it is left out


class _FromStarts(Moves):
    """Moves under a prior of start poses that is the density of those that are left open: no view says where it is."""

    def _start_prior(self, given: Trajectories) -> Float[Tensor, "N"]:
        return start_density(given.poses[:, 0], given.starts, given.starts.new_tensor(MOVED_KERNEL))

    def seen(self, given: Trajectories, start: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        return start

    def unseen(self, given: Trajectories, seen: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        return seen


class Rival(NamedTuple):
    """A belief under a fault.

    Attributes:
        name: of the fault, or "no fault".
        log_share: log of its share among the beliefs of that name; 0 of no fault, whose copies become more.
        pose_filter: that follows it.
        now: particles.
        log_weights: of them.
        log_view: log-likelihood ratio of the first view against no fault.
        seen: start poses by the first view, of one that keeps nothing of it otherwise; None where the view is stated to
            be off by so little that a kernel makes no density of them.
    """

    name: str
    log_share: float
    pose_filter: PoseTrajectoryFilter
    now: Trajectories
    log_weights: Float[Tensor, "N"]
    log_view: float
    seen: Float[Tensor, "Q D"] | None = None

    @classmethod
    def of(
        cls, name: str, beliefs: int, pose_filter: PoseTrajectoryFilter, now: Trajectories, log_view: float = 0.0
    ) -> Self:
        """One of so many equally likely beliefs of a name, by particles that are equally weighted."""
        return cls(name, -math.log(beliefs), pose_filter, now, equal_weights(len(now)), log_view)

    @property
    def log_evidence(self) -> float:
        """Of all readings, against no fault's of the first view alone."""
        return self.log_share + self.log_view + self.now.log_evidence


@torch.no_grad()
def begun(pose_filter: PoseTrajectoryFilter, first: Trajectories, generator: torch.Generator) -> tuple[Rival, ...]:
    """The rivals after the first view.

    Args:
        pose_filter: of no fault.
        first: its particles after the view, equally weighted.
        generator: of the draws.
    """
    usual, wide = (
        each.supposing(own=replace(each.own, particles=_PARTICLES, first_particles=0))
        for each in (pose_filter, pose_filter.doubting())
    )

    def again() -> Trajectories:
        return first.at(torch.randint(len(first), (_PARTICLES,), generator=generator))

    # of a view that is as exact as its noise start poses are a narrow, slanted cloud, which a kernel makes far too wide
    own, starts, seen = pose_filter.own, first.starts, first.starts
    if first.first is None:  # of a view's errors it tells nothing itself
        errors = normal((len(starts), first.systematic.shape[1]), generator=generator, dtype=torch.float64)
        seen = as_it_is(own, errors, starts)
    apart = first.poses[:, 0, :2].mean(0) - starts.new_tensor(own.view_about_m or (0.0, 0.0))
    off_m = math.hypot(own.view_off_m, math.sqrt(0.5) * own.view_off_rad * float(apart.norm()))
    rivals = [Rival.of(NO_FAULT, 1, usual, again()), Rival.of("push model off", 1, wide, again())]
    for name, ring in (("hand off", HAND), ("camera off", CAMERA)):
        rival = Rival.of(name, 1, usual.supposing(moves=_FromStarts), _displaced(first, ring, generator))
        rivals.append(rival._replace(seen=seen if off_m >= _WIDE_VIEW_M else None))
    return (*rivals, *_sizes(usual.supposing(own=replace(usual.own, particles=_OF_A_SIZE)), first, generator))


@torch.no_grad()
def doubted(
    pose_filter: PoseTrajectoryFilter, first: Trajectories, readings: Sequence[Reading], generator: torch.Generator
) -> tuple[Rival, ...]:
    """Further copies of no fault after all readings, with more particles: what an alarm is asked again by.

    Args:
        pose_filter: of no fault.
        first: its particles after the first view, equally weighted.
        readings: since then.
        generator: of the draws.
    """
    usual = pose_filter.supposing(own=replace(pose_filter.own, first_particles=0))
    copies: tuple[Rival, ...] = ()
    for _ in range(FURTHER):
        now = first.at(torch.randint(len(first), (pose_filter.own.particles,), generator=generator))
        copies = (*copies, Rival.of(NO_FAULT, 1, usual, now))
    for reading in readings:
        copies = followed(copies, reading, generator)
    return copies


def is_asked_again(rivals: Sequence[Rival]) -> bool:
    """Whether some of them are copies of one: beliefs by the same filter."""
    return len({id(rival.pose_filter) for rival in rivals}) < len(rivals)


def likeliest(rivals: Sequence[Rival]) -> list[Rival]:
    """The likeliest of some rivals, with its copies; where any has copies one of these: one alone may be lucky."""
    alike = [[one for one in rivals if one.pose_filter is rival.pose_filter] for rival in rivals]
    return max(alike, key=lambda some: (len(some), max(one.log_evidence for one in some)))


@torch.no_grad()
def followed(rivals: Sequence[Rival], reading: Reading, generator: torch.Generator) -> tuple[Rival, ...]:
    """The rivals after an action."""
    after = []
    for rival in rivals:
        done = rival.pose_filter.advanced(rival.now, rival.log_weights, reading, generator)
        now = done.now.remembered(rival.pose_filter.own.memory)
        after.append(rival._replace(now=now, log_weights=done.log_weights))
    return tuple(after)


def left(rivals: Sequence[Rival], none: float) -> tuple[Rival, ...]:
    """The rivals that are not hopeless, and with any of them all copies of no fault, whose log evidence is given."""
    some = tuple(rival for rival in rivals if rival.name == NO_FAULT or rival.log_evidence > none - _HOPELESS)
    return some if any(rival.name != NO_FAULT for rival in some) else ()


def log_ratios(rivals: Sequence[Rival], own: float) -> Mapping[str, float]:
    """Log-likelihood ratio of all readings, of each fault against no fault; -inf where every rival was given up.

    Args:
        rivals: after the readings.
        own: log marginal likelihood of no fault by the belief that a run goes by.
    """
    none, found = log_none(rivals, own), {}
    for name in RIVALS:
        some = [rival for rival in rivals if rival.name == name]
        found[name] = _log_sum([rival.log_evidence for rival in some]) - none
    return found


def log_none_by(rival: Rival) -> float:
    """Log marginal likelihood of no fault by the particles of a rival, times its share; -inf where it cannot tell.

    No fault has another prior of the start pose and nothing else: the rival's marginal likelihood times the mean ratio
    of both priors (importance sampling). What the two estimates err by they have in common, so that it is no evidence.
    """
    now = rival.now
    if rival.seen is None or not len(rival.seen) or not len(now.starts):
        return -math.inf
    start = now.poses[:, 0]
    spread = (_NARROWER * rival.seen[:, :2].std(0).amax()).clamp(_LEAST_KERNEL_M, MOVED_KERNEL[0])
    scale = torch.cat((spread.expand(2), spread.new_tensor(MOVED_KERNEL[2:])))
    seen = start_density(start, rival.seen, scale) - math.log(len(rival.seen))
    moved = start_density(start, now.starts, start.new_tensor(MOVED_KERNEL)) - math.log(len(now.starts))
    return rival.log_evidence + log_mean(rival.log_weights, seen - moved)


def _log_sum(logs: Sequence[float]) -> float:
    return float(torch.tensor(logs, dtype=torch.float64).logsumexp(0)) if logs else -math.inf


def log_none(rivals: Sequence[Rival], own: float) -> float:
    """Log marginal likelihood of no fault: the greatest of several estimates.

    One is the mean over the belief that a run goes by and its copies; those by the rivals of each name are others. One
    that is too small would be evidence of every fault, one that is too great is of none.
    """
    copies = [rival.log_evidence for rival in rivals if rival.name == NO_FAULT]
    others = [_log_sum([log_none_by(rival) for rival in rivals if rival.name == name]) for name in RIVALS]
    return max(_log_sum([own, *copies]) - math.log(len(copies) + 1), *others)


def _displaced(first: Trajectories, ring: Ring, generator: torch.Generator) -> Trajectories:
    """Particles that an offset has put elsewhere, and further start poses, with nothing of the view."""
    rows = torch.randint(len(first), (_PARTICLES + _PLACES,), generator=generator)
    start = first.pose[rows].clone()
    start[:, :3] += drawn(ring, len(start), generator)
    errors = first.systematic[rows[:_PARTICLES]]
    return Trajectories.drawn(start[:_PARTICLES], History.empty(), generator, start[_PARTICLES:], systematic=errors)


def _sizes(pose_filter: PoseTrajectoryFilter, first: Trajectories, generator: torch.Generator) -> tuple[Rival, ...]:
    """Rivals in other sizes that the view leaves open."""
    model = pose_filter.model
    if not isinstance(model, PushedObject) or not isinstance(model.sdf, GridSDF) or not len(first.history):
        return ()
    usual, _ = _seen(pose_filter, first, 0.0, generator)
    found = []
    for factor in SIZES:
        other = pose_filter.supposing(model=model.resized(factor))
        seen, now = _seen(other, first, model.resting_m - other.model.resting_m, generator)
        found.append(Rival.of("another size", len(SIZES), other, now, seen - usual))
    return left(found, 0.0)


def _seen(
    pose_filter: PoseTrajectoryFilter, first: Trajectories, raised_m: float, generator: torch.Generator
) -> tuple[float, Trajectories]:
    """Log-likelihood of the first view, up to a constant, and particles by it: importance sampling, then moves.

    Heights of points count from the object's origin, which is lower by `raised_m`.
    """
    own, model = pose_filter.own, pose_filter.model
    view = first.history.segment(0)
    history = History.empty().appended(view._replace(points=view.points + view.points.new_tensor((0, 0, raised_m))))
    about = as_seen(own, first.systematic, first.poses[:, 0])
    spread = about.new_tensor([(m, m, rad) for m, rad in SPREADS])
    scale = spread[torch.arange(_DRAWS) % len(spread)]
    rows = torch.randint(len(about), (_DRAWS,), generator=generator)
    seen, errors = about[rows] + scale * normal(scale.shape, generator=generator, dtype=torch.float64), first.systematic
    tried = Trajectories.drawn(as_it_is(own, errors[rows], seen), history, generator, systematic=errors[rows])
    tried = tried.replayed(model, own, history, torch.zeros(_DRAWS, dtype=torch.long))
    proposal = torch.stack([start_density(seen, about, one) for one in spread]).logsumexp(0)
    log_weights = tried.log_likelihood.sum(-1) - proposal
    starts = seen[resample_systematic(log_weights, _STARTS, generator=generator)]
    now = replace(tried.at(resample_systematic(log_weights, own.particles, generator=generator)), starts=starts)
    moves = Moves(model, own, generator)
    for _ in range(_SWEEPS):
        now = moves.sweep(now, history, whole=True)
    return log_mean(torch.zeros_like(log_weights), log_weights), now


def adopted(rival: Rival, count: int) -> Trajectories:
    """So many particles of a rival, equally weighted."""
    return rival.now.at(systematic(rival.log_weights, 0.5, count))
