"""Particle filter for touch alone over whole trajectories, which resamples by replaying the history (resample-move).

A particle is where the object started, how it slides, and what noise its motion had; a push model makes everything else
of the robot's path. New particles are jittered old ones, rolled through all actions and accepted by Metropolis's rule:
they follow the exact posterior under the model, with no weights invented. The touch-only paper's own rule (App B) puts
newcomers near the robot; it stands beside.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import torch
from annotated_types import Interval
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.prior import PlanarPrior
from rumi.belief.trajectory_belief import TouchAction, TrajectoryBelief, concatenate
from rumi.dynamics.along_path import PathPush, Pusher, distance_to, push_along_path
from rumi.dynamics.sliding import Outline, Sliding
from rumi.resampling import resample_systematic
from rumi.seeding import normal, uniform
from sdf.bounds import ASCENDING, Checked, Count, CountOr0, NotNegative, Positive, Share
from sdf.numbers import refuse_trained
from sensors.touch.contact_model import ContactModel

Resampling = Literal["replay", "importance", "newcomers", "none"]


@dataclass(frozen=True)
class TrajectorySettings(Checked):
    """Settings of the trajectory filter.

    Attributes:
        resampling: "replay" moves particles along the exact posterior; "importance" copies the likely ones;
            "newcomers" is the paper's rule, near the robot where contact was felt and importance else; "none" never.
        trigger: share of N that the effective sample size falls below before it is resampled.
        sweeps: Metropolis moves of every particle at a resampling.
        from_prior: share of moves that are draws from the prior, not jitter.
        jitter_m: least and greatest standard deviation of the jitter, log-uniform.
        jitter_rad_per_m: of yaw with it.
        friction: range of the coefficient, uniform.
        lever_m: range of c, uniform.
        noise: standard deviation of each action's motion, as a share of it; 0 for none.
        noise_tails: h of Tukey's g-and-h distribution, z exp(h z^2 / 2) of a normal z: 0 is normal, more has heavier
            tails, for motions that now and then go quite another way.
        noise_m_per_rad: metres of motion that a radian counts as.
        noise_rad_per_m: of yaw with it.
        newcomers: share of the particles that newcomers replace.
        newcomer_mass: weight that they get in all, split by their likelihood; all of it where they replace all.
        temper: power of the likelihood: 1 for readings that err independently, below it for those that err together.
        overlap_m: distance over which it is uncertain whether the tool, coming down, meets the object.
        overlap_error: chance that it is wrongly taken to have met it, or not to.
        substeps: parts of the way between two readings.
        passes: contacts that are settled in a part, at most.
    """

    resampling: Resampling = "replay"
    trigger: Share = 0.5
    sweeps: CountOr0 = 2
    from_prior: Share = 0.1
    jitter_m: Annotated[tuple[Positive, Positive], ASCENDING] = (1e-3, 0.05)
    jitter_rad_per_m: NotNegative = 8.0
    friction: Annotated[tuple[NotNegative, NotNegative], ASCENDING] = (0.1, 0.6)
    lever_m: Annotated[tuple[Positive, Positive], ASCENDING] = (0.03, 0.06)
    noise: NotNegative = 0.0
    noise_tails: NotNegative = 0.0
    noise_m_per_rad: NotNegative = 0.04
    noise_rad_per_m: NotNegative = 10.0
    newcomers: Share = 0.2
    newcomer_mass: Share = 0.1
    temper: Positive = 1.0
    overlap_m: Positive = 0.002
    overlap_error: Annotated[float, Interval(gt=0.0, lt=0.5)] = 0.02
    substeps: Count = 2
    passes: Count = 2

    def __post_init__(self) -> None:
        """Refuse what has no meaning, and what would drop a gradient."""
        refuse_trained(self)
        super().__post_init__()


class StepInfo(NamedTuple):
    """Diagnostics of a filter step, for each run.

    Attributes:
        ess: (R), before resampling.
        resampled: (R).
        accepted: share of the Metropolis moves that were accepted; NaN if there were none.
    """

    ess: Float[Tensor, "R"]
    resampled: Bool[Tensor, "R"]
    accepted: float


class TrajectoryFilter:
    """Resample-move particle filter over trajectories, of contact signals; holds settings, never the belief.

    Args:
        outline: of the object.
        centre: (2,), its centre of friction, object frame, metres.
        pusher: the tool.
        model: of the contact signal.
        prior: over start poses.
        settings: of particles, resampling and moves.
        carrier: how the tool moves the objects; quasi-statically by default.
    """

    def __init__(
        self,
        outline: Outline,
        centre: Float[Tensor, "2"],
        pusher: Pusher,
        model: ContactModel,
        prior: PlanarPrior,
        settings: TrajectorySettings | None = None,
        carrier: PathPush = push_along_path,
    ) -> None:
        self.outline, self.centre, self.pusher = outline, centre, pusher
        self.model, self.prior = model, prior
        self.settings, self.carrier = settings or TrajectorySettings(), carrier

    def initial(self, runs: int, count: int, *, generator: torch.Generator) -> TrajectoryBelief:
        """Draws from the prior, equally weighted."""
        start = self.prior.sample(runs, count, generator=generator)
        flat = torch.zeros_like(start[..., 0])
        friction, lever = (
            self._within(bounds, uniform(flat.shape, generator=generator, dtype=flat.dtype, device=flat.device))
            for bounds in (self.settings.friction, self.settings.lever_m)
        )
        return TrajectoryBelief(start, friction, lever, (), start, flat.log_softmax(-1), flat)

    def step(
        self,
        belief: TrajectoryBelief,
        history: Sequence[TouchAction],
        *,
        generator: torch.Generator,
        resample: bool = True,
    ) -> tuple[TrajectoryBelief, StepInfo]:
        """Take in the last action of a history, and resample the runs whose effective sample size is low.

        Args:
            belief: before that action.
            history: all actions, the new one last.
            generator: of the random draws.
            resample: False leaves the weights as the readings have them.
        """
        action = history[-1]
        noise: Tensor | None = None
        if self.settings.noise > 0:
            pose = belief.pose
            noise = normal(pose.shape, generator=generator, dtype=pose.dtype, device=pose.device)
        pose, gained = self.roll(belief.pose, belief.friction, belief.lever, noise, action)
        log_weights = (belief.log_weights + gained).log_softmax(-1)
        belief = replace(
            belief,
            noise=belief.noise if noise is None else (*belief.noise, noise),
            pose=pose,
            log_weights=log_weights,
            log_likelihood=belief.log_likelihood + gained,
        )
        ess, low = belief.ess(), torch.zeros(len(pose), dtype=torch.bool, device=pose.device)
        if resample and self.settings.resampling != "none":
            low = ess < self.settings.trigger * pose.shape[1]
        rows, accepted = low.nonzero()[:, 0], float("nan")
        if len(rows):
            some = [each.at(rows) for each in history]
            fresh, accepted = self.resample(belief.at(rows), some, generator=generator)
            belief = belief.put(rows, fresh)
        return belief, StepInfo(ess, low, accepted)

    def resample(
        self, belief: TrajectoryBelief, history: Sequence[TouchAction], *, generator: torch.Generator
    ) -> tuple[TrajectoryBelief, float]:
        """Resample all runs, by the rule of the settings; and the share of accepted moves."""
        if self.settings.resampling == "newcomers" and history[-1].contact.shape[-1] > 0:
            touched = history[-1].contact[..., -1].expand(len(belief.start))
            rows, with_newcomers = touched.nonzero()[:, 0], self._newcomers(belief, history[-1], generator)
            belief = belief.resampled(resample_systematic(belief.log_weights, generator=generator))
            return belief.put(rows, with_newcomers.at(rows)), float("nan")
        belief = belief.resampled(resample_systematic(belief.log_weights, generator=generator))
        if self.settings.resampling != "replay" or self.settings.sweeps == 0:
            return belief, float("nan")
        moved = 0.0
        for _ in range(self.settings.sweeps):
            belief, accepted = self._sweep(belief, history, generator)
            moved += accepted / self.settings.sweeps
        return belief, moved

    def roll(
        self,
        pose: Float[Tensor, "R N 3"],
        friction: Float[Tensor, "R N"],
        lever: Float[Tensor, "R N"],
        noise: Float[Tensor, "R N 3"] | None,
        action: TouchAction,
    ) -> tuple[Float[Tensor, "R N 3"], Float[Tensor, "R N"]]:
        """Poses after an action, and the log-likelihood of its readings."""
        runs, count = pose.shape[:2]
        each = runs * count
        path = action.path if action.path.ndim == 3 else action.path[None]
        if len(path) > 1:
            path = path[:, None].expand(runs, count, *path.shape[1:]).reshape(each, *path.shape[1:])
        centre = self.centre.to(pose).expand(each, 2)
        carried = self.carrier(
            pose.reshape(each, 3),
            path,
            self.pusher,
            self.outline,
            Sliding(centre, lever.reshape(each), friction.reshape(each)),
            substeps=self.settings.substeps,
            passes=self.settings.passes,
        )
        distance = carried.distance.view(runs, count, -1)
        contact = (action.contact if action.contact.ndim == 2 else action.contact[None])[:, None]
        gained = self.settings.temper * self.model.log_likelihood(distance, contact).sum(-1)
        if action.blocked is not None:
            gained = gained + self._descent(pose, path, action.blocked)
        after = carried.track[:, -1].view(runs, count, 3) if distance.shape[-1] else pose
        return self._disturbed(pose, after, noise), gained

    def _descent(self, pose: Tensor, path: Tensor, blocked: bool) -> Float[Tensor, "R N"]:
        """Log-likelihood of having come down at the start of a path, or not."""
        own, flat = self.settings, pose.reshape(-1, 3)
        apart = distance_to(flat, path[:, 0], self.pusher, self.outline).view(pose.shape[:2])
        meets = own.overlap_error + (1.0 - 2.0 * own.overlap_error) * torch.sigmoid(-apart / own.overlap_m)
        return (meets if blocked else 1.0 - meets).log()

    def _disturbed(self, before: Tensor, after: Tensor, noise: Tensor | None) -> Tensor:
        """Poses off by noise that grows with the motion."""
        own = self.settings
        if noise is None:
            return after
        motion = after - before
        sigma = own.noise * (motion[..., :2].norm(dim=-1) + own.noise_m_per_rad * motion[..., 2].abs())
        scale = torch.stack((sigma, sigma, own.noise_rad_per_m * sigma), -1)
        if own.noise_tails > 0:
            noise = noise * (0.5 * own.noise_tails * noise.square()).exp()
        return after + scale * noise

    def replay(
        self,
        start: Float[Tensor, "R N 3"],
        friction: Float[Tensor, "R N"],
        lever: Float[Tensor, "R N"],
        noise: Sequence[Tensor],
        history: Sequence[TouchAction],
    ) -> tuple[Float[Tensor, "R N 3"], Float[Tensor, "R N"]]:
        """Poses now and the log-likelihood of all readings, from the start."""
        if self.settings.noise == 0 and all(action.blocked is None for action in history):
            # nothing happens between actions: all of them are one
            return self.roll(start, friction, lever, None, concatenate(history))
        pose, total = start, torch.zeros_like(friction)
        each: Sequence[Tensor | None] = noise if self.settings.noise > 0 else [None] * len(history)
        for own, action in zip(each, history, strict=True):
            pose, gained = self.roll(pose, friction, lever, own, action)
            total = total + gained
        return pose, total

    def _sweep(
        self, belief: TrajectoryBelief, history: Sequence[TouchAction], generator: torch.Generator
    ) -> tuple[TrajectoryBelief, float]:
        """One Metropolis move of every particle on start pose, parameters and noise."""
        own, like, dtype = self.settings, belief.start, belief.start.dtype

        def even() -> Tensor:
            return uniform(belief.friction.shape, generator=generator, dtype=dtype, device=like.device)

        def noisy() -> Tensor:
            return normal(like.shape, generator=generator, dtype=dtype, device=like.device)

        least, most = own.jitter_m
        size = least * (most / least) ** even()
        step = noisy() * torch.stack((size, size, own.jitter_rad_per_m * size), -1)
        afresh = even() < own.from_prior
        drawn = self.prior.sample(*belief.friction.shape, generator=generator).to(dtype)
        start = torch.where(afresh[..., None], drawn, belief.start + step)
        reach, changes = size / most, noisy()
        friction = self._moved(belief.friction, own.friction, afresh, reach * changes[..., 0], even())
        lever = self._moved(belief.lever, own.lever_m, afresh, reach * changes[..., 1], even())
        noise = belief.noise
        if own.noise > 0:
            # a turn within the plane of old and new draws leaves normal ones normal
            angle = 0.5 * torch.pi * torch.where(afresh, 1.0, (even() < 0.5) * torch.maximum(reach, even() ** 4))
            cos, sin = angle.cos()[..., None], angle.sin()[..., None]
            noise = tuple(cos * part + sin * noisy() for part in noise)
        pose, log_likelihood = self.replay(start, friction, lever, noise, history)
        # a draw from the prior is proposed as often as the prior has it
        change = self.prior.log_density(start) - self.prior.log_density(belief.start)
        odds = log_likelihood - belief.log_likelihood + torch.where(afresh, 0.0, change)
        accept = even().log() < odds
        wide = accept[..., None]
        return replace(
            belief,
            start=torch.where(wide, start, belief.start),
            friction=torch.where(accept, friction, belief.friction),
            lever=torch.where(accept, lever, belief.lever),
            noise=tuple(torch.where(wide, new, old) for new, old in zip(noise, belief.noise, strict=True)),
            pose=torch.where(wide, pose, belief.pose),
            log_likelihood=torch.where(accept, log_likelihood, belief.log_likelihood),
        ), float(accept.to(dtype).mean())

    def _moved(self, value: Tensor, bounds: tuple[float, float], afresh: Tensor, step: Tensor, drawn: Tensor) -> Tensor:
        """A parameter moved by a share of its range, reflected at the ends, or drawn afresh."""
        low, high = bounds
        if high <= low:
            return value
        place = (value - low) / (high - low) + 0.5 * step
        folded = 1.0 - (torch.remainder(place, 2.0) - 1.0).abs()
        return self._within(bounds, torch.where(afresh, drawn, folded))

    @staticmethod
    def _within(bounds: tuple[float, float], share: Tensor) -> Tensor:
        return bounds[0] + (bounds[1] - bounds[0]) * share

    def _newcomers(self, belief: TrajectoryBelief, action: TouchAction, generator: torch.Generator) -> TrajectoryBelief:
        """The paper's rule (App B): poses near the robot take the place of the least likely particles.

        Their weights are not specified there: they share `newcomer_mass` by how well they explain the last reading.
        """
        runs, count = belief.friction.shape
        many = max(1, round(self.settings.newcomers * count))
        tool = action.path[..., -1, :].expand(runs, 3)
        reach = self.outline.radius + self.pusher.radius
        pose = belief.pose
        draw = uniform((runs, many, 3), generator=generator, dtype=pose.dtype, device=pose.device)
        near = tool[:, None, :2] + reach * (2.0 * draw[..., :2] - 1.0)
        fresh = torch.cat((near, torch.pi * (2.0 * draw[..., 2:] - 1.0)), -1)
        flat = tool[:, None].expand(runs, many, 3).reshape(-1, 3)
        distance = distance_to(fresh.reshape(-1, 3), flat, self.pusher, self.outline).view(runs, many)
        contact = action.contact[..., -1].expand(runs)[:, None]
        fit = self.model.log_likelihood(distance, contact).log_softmax(-1)
        least = belief.log_weights.topk(many, dim=-1, largest=False).indices
        mass = fresh.new_tensor(self.settings.newcomer_mass if many < count else 1.0)
        kept = belief.log_weights.scatter(1, least, -torch.inf).log_softmax(-1) + (1.0 - mass).log()
        wide = least[..., None].expand(runs, many, 3)
        return replace(
            belief,
            start=belief.start.scatter(1, wide, fresh),
            pose=belief.pose.scatter(1, wide, fresh),
            log_weights=kept.scatter(1, least, fit + mass.log()).log_softmax(-1),
        )
