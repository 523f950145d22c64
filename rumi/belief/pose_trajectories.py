"""Belief over trajectories of a pushed object: particles that each have a motion of their own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.prior import PosePrior
from rumi.belief.pushed_model import Pushed
from rumi.belief.sensed_motion import log_likelihood_of_motions
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.seeding import normal
from sdf import backend, se3

PHYSICS, NOISE, OWN = 5, 11, 5
"""Standard normals of a particle, of a segment, and those of a segment that its action does not share."""


@dataclass(frozen=True, eq=False)
class Trajectories:
    """N particles, each with a history of its own; float64.

    Attributes:
        physics: (N, 5) standard normals: log-friction, log-lever, centre of friction (x, y), pressure ahead; behind
            them, where the run has systematic errors, theirs (`rumi.belief.systematic_errors`).
        noise: (N, S, 11) standard normals of each segment: log-friction, log-lever, motion along, across and turn;
            and for the whole action, of which its first segment's count, the last three once more, the size of all
            these, and the shift (x, y) of the centre of friction.
        poses: (N, S + 1, 3), (x, y, yaw) before the first segment and after each; in space (N, S + 1, 6), with the
            resting pose, the edge that it leans about, and the tilt (`rumi.dynamics.toppling.Leaning`).
        log_likelihood: (N, S), of each segment's readings.
        history: what was done and sensed.
        starts: (Q, 3 or 6), poses that the first view leaves open, as it has them, about evenly likely: proposals are
            drawn about them.
        apart: whether they stand too far apart for a touch: draws of a prior, or of where a jump may have led.
        log_evidence: estimate of the log marginal likelihood of the readings since the start.
        forgotten: segments before the history's first.
        first: prior of the start pose, where no view shows it; else start poses are even.
    """

    physics: Float[Tensor, "N P"]
    noise: Float[Tensor, "N S 11"]
    poses: Float[Tensor, "N S1 D"]
    log_likelihood: Float[Tensor, "N S"]
    history: History
    starts: Float[Tensor, "Q D"]
    apart: bool = False
    log_evidence: float = 0.0
    forgotten: int = 0
    first: PosePrior | None = None

    @classmethod
    def drawn(
        cls,
        start: Float[Tensor, "N D"],
        history: History,
        generator: torch.Generator,
        starts: Float[Tensor, "Q D"] | None = None,
        *,
        apart: bool = False,
        systematic: Float[Tensor, "N E"] | None = None,
    ) -> Self:
        """Start poses with physics and noise of the prior, not replayed yet.

        Args:
            start: poses.
            history: to be replayed.
            generator: of the draws.
            starts: poses that are left open.
            apart: whether they stand too far apart for a touch.
            systematic: standard normals of the run's systematic errors; None for none.
        """
        count, segments = len(start), len(history)
        physics = normal((count, PHYSICS), generator=generator, dtype=torch.float64)
        if systematic is not None:
            physics = torch.cat((physics, systematic), -1)
        noise = normal((count, segments, NOISE), generator=generator, dtype=torch.float64)
        poses = start[:, None].repeat(1, segments + 1, 1)
        logs, starts = start.new_zeros(count, segments), start[:0] if starts is None else starts
        return cls(physics, noise, poses, logs, history, starts, apart)

    @classmethod
    def still(cls, start: Float[Tensor, "N D"], history: History) -> Self:
        """Poses at the median of physics and noise, not replayed yet."""
        count, segments = len(start), len(history)
        physics, noise = start.new_zeros(count, PHYSICS), start.new_zeros(count, segments, NOISE)
        poses = start[:, None].repeat(1, segments + 1, 1)
        return cls(physics, noise, poses, start.new_zeros(count, segments), history, start[:0])

    def __len__(self) -> int:
        """Number of particles."""
        return len(self.physics)

    @property
    def pose(self) -> Float[Tensor, "N D"]:
        """Where each particle is now."""
        return self.poses[:, -1]

    def at(self, rows: Tensor) -> Self:
        """Some particles."""
        rows = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
        return self._with([getattr(self, name).index_select(0, rows) for name in _PARTS])

    @property
    def systematic(self) -> Float[Tensor, "N E"]:
        """Standard normals of the systematic errors; none of them where there are none."""
        return self.physics[:, PHYSICS:]

    def put(self, rows: Int[Tensor, "R"], other: Self) -> Self:
        """The same with another's particles in some rows."""
        return self._with([getattr(self, name).index_copy(0, rows, getattr(other, name)) for name in _PARTS])

    def where(self, accept: Bool[Tensor, "N"], other: Self) -> Self:
        """Another's particles where accepted, else one's own."""
        wide = accept[:, None]
        masks = wide, wide[..., None], wide[..., None], wide
        pairs = ((getattr(other, name), getattr(self, name)) for name in _PARTS)
        return self._with([torch.where(mask, *pair) for mask, pair in zip(masks, pairs, strict=True)])

    def _with(self, parts: list[Tensor]) -> Self:
        physics, noise, poses, log_likelihood = parts
        return replace(self, physics=physics, noise=noise, poses=poses, log_likelihood=log_likelihood)

    def lengthened(self, noise: Float[Tensor, "N 1 11"], history: History) -> Self:
        """With one more segment, which is not replayed yet."""
        return replace(
            self,
            noise=torch.cat((self.noise, noise), 1),
            poses=torch.cat((self.poses, self.poses[:, -1:]), 1),
            log_likelihood=torch.cat((self.log_likelihood, self.log_likelihood.new_zeros(len(self), 1)), 1),
            history=history,
        )

    def stepped(
        self, model: Pushed, settings: PoseTrajectorySettings, noise: Float[Tensor, "N 1 11"], history: History
    ) -> Self:
        """With one more segment, replayed from the present poses on."""
        inner, action = noise.clone(), int(history.action[-1])
        if action < len(self.history):  # alone, a segment's action is its own: what the action shares comes along
            inner[:, 0, OWN:] = self.noise[:, action, OWN:]
        alone = replace(
            self,
            noise=inner,
            poses=self.pose[:, None].repeat(1, 2, 1),
            log_likelihood=self.log_likelihood.new_zeros(len(self), 1),
        )
        alone = alone.replayed(model, settings, history.last(), torch.zeros(len(self), dtype=torch.long))
        return replace(
            self,
            noise=torch.cat((self.noise, noise), 1),
            poses=torch.cat((self.poses, alone.poses[:, 1:]), 1),
            log_likelihood=torch.cat((self.log_likelihood, alone.log_likelihood), 1),
            history=history,
        )

    def moved_from(self, start: Float[Tensor, "N D"], model: Pushed, settings: PoseTrajectorySettings) -> Self:
        """The same where the last segment's motion counts from other poses than those before it, as where it jumped."""
        rows = (self.poses[:, -2] != start).any(-1).nonzero()[:, 0]
        end, told = model.world_T_object(self.pose[rows]), self.log_likelihood.clone()
        sensed = self.history.motion[-1:], self.history.motion_power[-1:]
        for sign, begun in ((-1.0, self.poses[rows, -2]), (1.0, start[rows])):
            there = torch.stack((model.world_T_object(begun), end), 1)
            told[rows, -1] += sign * log_likelihood_of_motions(there, *sensed, settings)[:, 0]
        return replace(self, log_likelihood=told)

    def joined(self, *others: Self) -> Self:
        """These particles and others of the same history."""
        if not others:
            return self
        return self._with([torch.cat([getattr(part, name) for part in (self, *others)]) for name in _PARTS])

    def remembered(self, most: int) -> Self:
        """The same without the older half of a history of more segments, cut where an action begins."""
        begins = (self.history.action == torch.arange(len(self.history))).nonzero()[:, 0]
        begins = begins[begins >= len(self.history) - max(1, most // 2)]
        if len(self.history) <= most or not len(begins):
            return self
        at = int(begins[0])
        return replace(
            self,
            noise=self.noise[:, at:],
            poses=self.poses[:, at:],
            log_likelihood=self.log_likelihood[:, at:],
            history=self.history.since(at),
            starts=self.starts[:0],
            forgotten=self.forgotten + at,
        )

    def log_prior(self) -> Float[Tensor, "N"]:
        """Log-density of physics and noise, up to a constant; start poses are even."""
        return -0.5 * (self.physics.square().sum(-1) + self.noise.square().sum((-2, -1)))

    def replayed(
        self,
        model: Pushed,
        settings: PoseTrajectorySettings,
        history: History,
        first: Int[Tensor, "N"],
        least: Float[Tensor, "N"] | None = None,
    ) -> Self:
        """Poses and likelihood under a history of as many segments, from a segment of each particle's own on.

        Args:
            model: object and tool.
            settings: of motion prior and sensors.
            history: what is replayed.
            first: segment of each particle from which on.
            least: log-likelihood from there on below which a particle may be given up: a segment's is then -inf, and
                what comes after it is left as it was.
        """
        version = backend.dispatch(model.replay, self.poses, *model.sdf.tensors())
        least = torch.full_like(first, -torch.inf, dtype=torch.float64) if least is None else least
        poses, log_likelihood = version(model, settings, history, self, first, least)
        further = []
        if bool(history.force[:, 2].any()):
            further.append(model.told_by_force(settings, self.physics, poses, history))
        if bool(history.motion_power.any()):
            there, sensed = model.world_T_object(poses), (history.motion, history.motion_power)
            further.append(log_likelihood_of_motions(there, *sensed, settings))
        for told in further:
            log_likelihood = log_likelihood + torch.where(torch.arange(len(history)) >= first[:, None], told, 0.0)
        return replace(self, poses=poses, log_likelihood=log_likelihood)


def middle_motion(now: Trajectories, spans: Sequence[int], count: int, model: Pushed) -> Float[Tensor, "K 4 4"]:
    """World motion of a particle in the middle of some, up to each instant of an action, segments evenly divided.

    Args:
        now: the particles.
        spans: instants of each of the action's segments, which are the last ones; none if nothing moved.
        count: K, instants of the action.
        model: of the object.
    """
    if not spans:
        return se3.identity((count,), dtype=torch.float64)
    pose = now.pose
    weights = pose.new_tensor((1.0, 1.0, 0.05, 1.0, 0.0, 1.0)[: pose.shape[-1]])  # ways of resting are far apart
    middle = int((pose - pose.median(0).values).mul(weights).square().sum(-1).argmin())
    track = now.poses[middle, -len(spans) - 1 :]
    steps = []
    for at, length in enumerate(spans):
        share = (torch.arange(length, dtype=torch.float64) + 1.0)[:, None] / length
        planar = track[at, :3] + share * (track[at + 1] - track[at])[:3]
        lying = torch.where(share < 1.0, track[at, 3:], track[at + 1, 3:])
        steps.append(torch.cat((planar, lying), -1))
    moved = model.world_T_object(torch.cat(steps))
    return moved @ se3.inverse(model.world_T_object(track[0]))


_PARTS = ("physics", "noise", "poses", "log_likelihood")


@dataclass(frozen=True)
class PoseTrajectoryBelief(PoseBelief):
    """Pose particles that each have a trajectory of their own.

    Poses are those at present; `world_T_attached` is the motion of one of them, in whose frame the points are kept
    that planners and figures ask for. `discrepancy` is 0: evidence counts by its likelihood.

    Attributes:
        trajectories: of the particles, in their order.
    """

    trajectories: Trajectories | None = None
