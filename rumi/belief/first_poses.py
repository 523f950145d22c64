"""Particles of an upright object that nothing has pushed yet: of a prior, a first view, or anew for a first touch."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.prior import PosePrior
from rumi.belief.pushed_model import Pushed
from rumi.belief.segments import standing
from rumi.belief.systematic_errors import NUMBERS, as_it_is, as_seen
from rumi.belief.trajectory_history import History, Segment
from rumi.belief.trajectory_moves import KERNEL, Moves, start_density
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.belief.trajectory_starts import from_prior
from rumi.belief.yaw_search import all_round
from rumi.resampling import resample_systematic
from rumi.seeding import normal, uniform
from sensors.observation import Observation

DRAWS, STARTS, AGAIN = 6000, 300, 1000
"""Start poses that are drawn and weighed, that stand for what they leave open, and that are drawn about these anew."""

SPREADS = ((0.0005, 0.02), (0.0015, 0.05), (0.004, 0.15))
"""Deviations of draws about poses that fit a view: metres, radians."""

_SWEEPS = 4  # of moves over draws of a view's posterior
_BELOW = 2.0  # nats below the particles' own weights from which on draws are given up


def of_prior(
    prior: PosePrior, memory: Observation, model: Pushed, own: PoseTrajectorySettings, random: torch.Generator
) -> Trajectories:
    """Draws of where an object stands that no view shows, weighed by what was free of it.

    Args:
        prior: of its pose.
        memory: what was sensed before anything moved.
        model: object and tool.
        own: of the filter.
        random: of the draws.
    """
    start = from_prior(prior, DRAWS, random)[:, :3]
    view = standing(memory, start[:STARTS], model, own)
    history = History.empty() if view is None else History.empty().appended(view)
    drawn = replace(Trajectories.drawn(start, history, random, systematic=_errors(DRAWS, own, random)), first=prior)
    if view is not None:
        drawn = drawn.replayed(model, own, history, torch.zeros(DRAWS, dtype=torch.long))
    log_weights = drawn.log_likelihood.sum(-1)
    starts = start[resample_systematic(log_weights, STARTS, generator=random)]
    return replace(drawn.at(resample_systematic(log_weights, own.particles, generator=random)), starts=starts)


def of_view(
    view: Segment | None,
    fitted: Float[Tensor, "n 3"],
    model: Pushed,
    own: PoseTrajectorySettings,
    random: torch.Generator,
) -> Trajectories:
    """Draws of the posterior of a first view, from poses that fit it: importance sampling, then moves.

    Args:
        view: what it shows; None for nothing.
        fitted: x, y and yaw of poses that fit it.
        model: object and tool.
        own: of the filter.
        random: of the draws.
    """
    history = History.empty() if view is None else History.empty().appended(view)
    if own.first_particles and view is not None:
        fitted = torch.cat((fitted, all_round(fitted, history, model, own)))
    draws = max(DRAWS // len(fitted), 1)
    spread = fitted.new_tensor([(m, m, rad) for m, rad in SPREADS])
    scale = spread[torch.arange(draws * len(fitted)) % len(spread)]
    seen = fitted.repeat(draws, 1) + scale * normal(scale.shape, generator=random, dtype=torch.float64)
    drawn = _shown(seen, history, own, random)
    drawn = drawn.replayed(model, own, history, torch.zeros(len(seen), dtype=torch.long))
    proposal = torch.stack([start_density(seen, fitted, s) for s in spread]).logsumexp(0)
    log_weights = drawn.log_likelihood.sum(-1) - proposal
    starts = seen[resample_systematic(log_weights, STARTS, generator=random)]
    drawn = replace(drawn.at(resample_systematic(log_weights, own.particles, generator=random)), starts=starts)
    moves = Moves(model, own, random)
    for _ in range(_SWEEPS):
        drawn = moves.sweep(drawn, history, whole=True)
    return drawn


def drawn_again(now: Trajectories, model: Pushed, own: PoseTrajectorySettings, random: torch.Generator) -> Trajectories:
    """More particles, equally weighted, of an object that nothing has pushed yet: importance sampling.

    Draws of little weight are given up before all of their likelihood is known (rejection control; Liu, Chen and Wong
    1998): one of weight w below a floor is kept with probability w / floor, and weighs as much as that then.

    Args:
        now: particles of it.
        model: object and tool.
        own: of the filter.
        random: of the draws.
    """
    many = DRAWS if now.first is not None else max(AGAIN, own.first_particles)
    if now.first is None:
        rows = torch.randint(len(now.starts), (many,), generator=random)
        seen = now.starts[rows].clone()
        seen[:, :3] += seen.new_tensor(KERNEL) * normal((many, 3), generator=random, dtype=torch.float64)
        drawn = _shown(seen, now.history, own, random)
    else:
        start = from_prior(now.first, many, random)[:, :3]
        drawn = Trajectories.drawn(start, now.history, random, systematic=_errors(many, own, random))
    drawn = replace(drawn, starts=now.starts, log_evidence=now.log_evidence, first=now.first)
    proposal = _log_proposal(drawn, now, own)
    floor = (now.log_likelihood.sum(-1) - _log_proposal(now, now, own)).median() - _BELOW
    least = floor + proposal + uniform((many,), generator=random, dtype=torch.float64).log()
    for bound in (least, torch.full_like(least, -math.inf)):  # all are weighed as they are, where none is kept
        tried = drawn
        if len(now.history):
            tried = drawn.replayed(model, own, now.history, torch.zeros(many, dtype=torch.long), bound)
        told = tried.log_likelihood.sum(-1)
        kept, log_weights = told > bound, told - proposal
        if bool(kept.any()):
            break
    log_weights = torch.where(bound.isfinite(), log_weights.clamp_min(floor), log_weights)
    log_weights = torch.where(kept, log_weights, -math.inf)
    return tried.at(resample_systematic(log_weights, own.first_particles, generator=random))


def _shown(
    seen: Float[Tensor, "N 3"], history: History, own: PoseTrajectorySettings, random: torch.Generator
) -> Trajectories:
    """Draws of the prior by where a camera has the object, not replayed yet: it is off by what it errs by."""
    errors = _errors(len(seen), own, random)
    start = seen if errors is None else as_it_is(own, errors, seen)
    return Trajectories.drawn(start, history, random, systematic=errors)


def _log_proposal(drawn: Trajectories, now: Trajectories, own: PoseTrajectorySettings) -> Float[Tensor, "N"]:
    """Log-density, up to a constant, of what start poses are drawn anew from, over that of their prior."""
    start = drawn.poses[:, 0]
    if now.first is not None:
        return start.new_zeros(len(start))
    return start_density(as_seen(own, drawn.systematic, start), now.starts, start.new_tensor(KERNEL))


def _errors(count: int, own: PoseTrajectorySettings, random: torch.Generator) -> Tensor | None:
    """Standard normals of the systematic errors of as many draws; None where there are none."""
    return normal((count, NUMBERS), generator=random, dtype=torch.float64) if own.systematic else None
