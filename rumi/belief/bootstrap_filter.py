"""Regularised bootstrap filter of an object that no view shows: a prior until it is touched, and many particles.

Where an object may lie in several ways, lean and fall, an action leaves many ways open, and what moves particles
afterwards finds few of them again. So there are many from the start, each goes on by a draw of the motion prior,
readings weigh them, and they are resampled and moved a little (Gordon, Salmond and Smith 1993; Musso, Oudjane and Le
Gland 2001). A share of them *jumps*, as no push model has it; where nothing fits an action, all do. Planners are given
a few particles that stand for all.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import NOISE, OWN, PoseTrajectoryBelief, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.prior import PosePrior
from rumi.belief.sample_size import particles_wanted
from rumi.belief.segments import cut, felt_pads, path_of, pushed, until_felt
from rumi.belief.tempering import check_finite, log_mean, power_of
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_starts import brought_to, from_prior, jittered, jumped, least_fit
from rumi.registration.descent import Search
from rumi.resampling import resample_systematic, systematic
from rumi.seeding import Generators, lone, normal
from rumi.weights import effective_sample_size, equal_weights, normalise
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading

SHOWN = 400
"""Particles that stand for all where others ask."""

_UNMET, _MET, _SPARED = 5, 2, 0.02  # draws for each particle at a first touch, those that are pushed, their least share
_JUMPS, _MORE_JUMPS = 0.03, 0.15  # share of an action's draws that jump; where the first draws fit badly
_TRIES, _FIT = 3, 40  # times that draws are made of a segment until one in so many particles counts
_AGAIN, _WIDER = 0.5, 1.5  # share of so many that later draws are, and how much wider their noise is
_A_MOTION = 6.0  # nats that a segment's sensed motion may cost where the model follows it but roughly
_KERNEL = (0.0005, 0.0005, 0.01)  # deviations by which what is resampled moves: metres, metres, radians
_KEPT = 0.98  # correlation of the physics from action to action
_REMEMBERED = 10  # segments
_SWEPT, _ASIDE_M = 0.01, 0.001  # least share of a belief that the tool pushes unfelt before a first touch, and how far


@dataclass(frozen=True)
class BootstrapBelief(PoseTrajectoryBelief):
    """Pose particles that stand for many more, in equal shares.

    Attributes:
        every: all particles.
        every_log_weight: (M), normalised.
    """

    every: Trajectories | None = None
    every_log_weight: Float[Tensor, "M"] | None = None


class BootstrapFilter(PoseTrajectoryFilter):
    """Follows objects that are known by a prior at first and that a tool pushes about in space; holds settings alone.

    Args:
        settings: of which `trajectories` count here, and the lattice of the points kept for planners.
        discrepancy: C^, of poses that others ask about.
        model: object and tool.
        prior: of the start pose; its ways are the model's first resting poses.
        search: freedom of the pose, "SE(2)" or "SE(3)".
    """

    model: ToppledObject
    prior: PosePrior

    def __init__(
        self,
        settings: FilterSettings,
        discrepancy: Discrepancy,
        model: ToppledObject,
        prior: PosePrior,
        search: Search = "SE(2)",
    ) -> None:
        super().__init__(settings, discrepancy, model, prior, search)
        self.own = replace(self.own, memory=min(self.own.memory, _REMEMBERED))
        self.shown = SHOWN

    def begin(self, belief: PoseBelief, memory: Observation, *, generator: Generators) -> PoseBelief:
        """Draws of the prior."""
        drawn = self.drawn(lone(generator))
        return self.belief_of(drawn, equal_weights(len(drawn)), belief.world_T_attached, belief.log_weights)

    def drawn(self, random: torch.Generator) -> Trajectories:
        """As many particles of the prior as there may be, equally weighted."""
        start = from_prior(self.prior, self.own.unseen_particles, random)
        return Trajectories.drawn(start, History.empty(4), random, apart=True)

    @torch.no_grad()
    def begun_again(self, belief: BootstrapBelief, reading: Reading, *, generator: Generators) -> PoseBelief:
        """The belief after a jump in the last action: about where it was, by what the pads felt at its end.

        Args:
            belief: that a reading does not fit.
            reading: of the last action.
            generator: of the draws.
        """
        now = self._jumped(*self.particles_of(belief), reading, path_of(reading, self.model), lone(generator))
        return self.belief_of(now, equal_weights(len(now)), belief.world_T_attached, belief.log_weights)

    def particles_of(self, belief: PoseBelief) -> tuple[Trajectories, Float[Tensor, "M"]]:
        """All particles of a belief, and their log-weights."""
        if not isinstance(belief, BootstrapBelief) or belief.every is None or belief.every_log_weight is None:
            raise TypeError("Expected a belief of a bootstrap filter, as `begin` gives it, got another one")
        return belief.every, belief.every_log_weight

    def belief_of(
        self, now: Trajectories, log_weights: Tensor, world_T_attached: Tensor, like: Tensor
    ) -> PoseTrajectoryBelief:
        """The belief of particles, of which some stand for all."""
        now = now.remembered(self.own.memory)
        shown = now.at(systematic(log_weights, 0.5, min(self.shown, len(now))))
        few = super().belief_of(shown, equal_weights(len(shown)), world_T_attached, like)
        return BootstrapBelief(
            few.world_T_attached,
            few.attached_T_object,
            few.log_weights,
            few.discrepancy,
            None,
            shown,
            now,
            normalise(log_weights),
        )

    def _heights(self, now: Trajectories) -> Float[Tensor, "N"]:
        return self.model.heights_off(now.pose, *(self.own.height_off or (0.0, 0.0)))

    def _poses(self, now: Trajectories, log_weights: Tensor) -> Float[Tensor, "n 6"]:
        return now.pose[systematic(log_weights, 0.5, min(self.shown, len(now)))]

    def _pushes(self, now: Trajectories, log_weights: Tensor, reading: Reading, path: Tensor) -> bool:
        if not now.apart or bool(reading.in_contact.any()) or self._leans(now, log_weights):
            return super()._pushes(now, log_weights, reading, path)
        poses = self._poses(now, log_weights)
        near = (torch.cdist(path[:, 1, :2], poses[:, :2]) < self.model.reach_m).any(0)
        aside = (self.model.tracks(self.own, poses[near], path)[:, -1] - poses[near])[:, :2].norm(dim=-1) > _ASIDE_M
        return int(aside.sum()) >= _SWEPT * len(poses)

    def _touched(
        self,
        now: Trajectories,
        log_weights: Tensor,
        reading: Reading,
        path: Tensor,
        random: torch.Generator,
        *,
        closes: bool,
    ) -> tuple[Trajectories, list[int]]:
        before, felt, spans, told = (now, log_weights), felt_pads(reading, self.model, self.own), list[int](), 0.0
        parts: Sequence[Tensor] = cut(reading, self.own, self.model.lifted(reading.tool_pose))
        unfelt = now.apart and not bool(reading.in_contact.any())
        if unfelt:
            parts = torch.arange(len(path)).split(self.own.instants)
        elif now.apart and not bool(reading.in_contact[parts[0]].any()):
            parts = [torch.cat(tuple(parts[:2])), *parts[2:]]
        fresh = normal(now.physics.shape, generator=random, dtype=torch.float64)
        now = replace(now, physics=_KEPT * now.physics + math.sqrt(1.0 - _KEPT**2) * fresh)
        for instants in parts:
            tracks = self._tracks(now, log_weights, path[instants])
            segment = pushed(reading, instants, path, felt, tracks, self.model, self.own)
            if now.apart and not unfelt:
                now, log_weights = self._met(now, log_weights, segment, random)
            now, log_weights, gained = self._weighed_pushes(
                now, log_weights, segment, random, opens=not spans, jumps=not unfelt
            )
            told, spans = told + gained, [*spans, len(instants)]
            now, log_weights = self._thinned(now, log_weights, random)
        allowed = 0.0 if reading.object_motion is None else _A_MOTION * len(spans)
        if not unfelt and told < least_fit(int(reading.in_contact.sum())) - allowed:
            return replace(self._jumped(*before, reading, path, random), log_evidence=now.log_evidence), []
        return now.at(resample_systematic(log_weights, generator=random)), spans

    def with_segment(
        self,
        now: Trajectories,
        log_weights: Float[Tensor, "N"],
        segment: Segment,
        random: torch.Generator,
        *,
        opens: bool,
        closes: bool,
    ) -> tuple[Trajectories, Float[Tensor, "M"]]:
        """Particles and their log-weights after a segment in which none jumps."""
        if not segment.pushes:
            now, log_weights, _ = self._weighed(now, log_weights, segment, random)
            return now, log_weights
        now, log_weights, _ = self._weighed_pushes(now, log_weights, segment, random, opens=opens, jumps=False)
        return self._thinned(now, log_weights, random)

    def _weighed_pushes(
        self,
        now: Trajectories,
        log_weights: Tensor,
        segment: Segment,
        random: torch.Generator,
        *,
        opens: bool,
        jumps: bool = True,
    ) -> tuple[Trajectories, Tensor, float]:
        """Draws of motions through a segment, their log-weights, and the log of the readings' mean likelihood.

        Where few of them count, more are made, of wider noise and more jumps.

        Args:
            now: the particles.
            log_weights: of them.
            segment: of the action.
            random: of the draws.
            opens: whether the action begins with it.
            jumps: whether some may jump.
        """
        history, found, heavy = now.history.appended(segment, opens=opens), list[Trajectories](), list[Tensor]()
        whole, wanted, few = log_weights, max(1.0, len(now) / _FIT), max(1, int(_AGAIN * len(now)))
        for again in range(_TRIES):
            share = (_MORE_JUMPS if again else _JUMPS * opens) if jumps and len(segment.points) else 0.0
            before, base = now, log_weights
            if again and self.own.sampling_error:
                before = now.at(resample_systematic(log_weights, few, generator=random))
                base = equal_weights(len(before))
            some = self._some_jumped(before, segment, share, random)
            noise = normal((len(some), 1, NOISE), generator=random, dtype=torch.float64)
            if again:
                noise[:, :, 2:OWN] *= _WIDER
            after = some.stepped(self.model, self.own, noise, history)
            found.append(after if segment.motion is None else after.moved_from(before.pose, self.model, self.own))
            gained = found[-1].log_likelihood[:, -1]
            check_finite(gained)
            heavy.append(base + gained + math.log(len(before)))
            whole = torch.cat(heavy)
            if float(effective_sample_size(whole)) >= wanted:
                break
        told = float(whole.logsumexp(-1)) - math.log(len(whole))
        now = found[0].joined(*found[1:])
        return replace(now, log_evidence=now.log_evidence + told), normalise(whole), told

    def _some_jumped(self, now: Trajectories, segment: Segment, share: float, random: torch.Generator) -> Trajectories:
        """A share of the particles where a jump before the segment may have led."""
        rows = torch.randperm(len(now), generator=random)[: int(share * len(now))]
        if not len(rows):
            return now
        way = segment.tool[-1, 1, :2] - segment.tool[0, 0, :2]
        poses = now.poses.clone()
        poses[rows, -1] = jumped(self.model.rests, now.pose[rows], way, generator=random, held=True)
        return replace(now, poses=poses)

    def _weighed(
        self, now: Trajectories, log_weights: Tensor, segment: Segment, random: torch.Generator, *, closes: bool = False
    ) -> tuple[Trajectories, Tensor, bool]:
        count, history = len(now), now.history.appended(segment)
        now = now.lengthened(torch.zeros(count, 1, NOISE, dtype=torch.float64), history)
        now = now.replayed(self.model, self.own, history, torch.full((count,), len(history) - 1))
        gained = now.log_likelihood[:, -1]
        check_finite(gained)
        told = log_mean(log_weights, gained)
        now = replace(now, log_evidence=now.log_evidence + told)
        heavier = normalise(log_weights + gained)
        thinned, even = self._thinned(now, heavier, random)
        return thinned, even, thinned is not now

    def _thinned(self, now: Trajectories, log_weights: Tensor, random: torch.Generator) -> tuple[Trajectories, Tensor]:
        """Particles resampled and moved by a narrow kernel, where few of them count or there are too many."""
        count, most = particles_wanted(now.pose, log_weights, self.own, self.shown)
        if count <= len(now) <= most and float(effective_sample_size(log_weights)) >= 0.5 * count:
            return now, log_weights
        now = self._moved(now.at(resample_systematic(log_weights, count, generator=random)), random)
        return now, equal_weights(len(now))

    def _moved(self, now: Trajectories, random: torch.Generator) -> Trajectories:
        """Present poses moved by the kernel."""
        poses = now.poses.clone()
        noise = normal((len(now), 3), generator=random, dtype=torch.float64)
        poses[:, -1, :3] += noise * noise.new_tensor(_KERNEL)
        return replace(now, poses=poses)

    def _met(
        self, now: Trajectories, log_weights: Tensor, segment: Segment, random: torch.Generator
    ) -> tuple[Trajectories, Tensor]:
        """More particles for a first touch, since those before it stand too far apart, and their log-weights.

        Most are brought to what was felt; those that fit what was sensed up to then are kept, and weighed back.
        """
        many = self.own.unseen_particles
        now = now.at(resample_systematic(log_weights, _UNMET * many, generator=random))
        start, begun = jittered(now.pose, generator=random), until_felt(segment)
        gained = torch.zeros(len(now), dtype=torch.float64)
        if begun is not None:
            start = self._brought(start, begun, random)
            gained = self._fit(start, begun)
        power = power_of(torch.zeros_like(gained), gained, 0.0, _SPARED * len(now))
        kept = resample_systematic(power * gained, _MET * many, generator=random)
        poses = now.poses[kept]
        poses[:, -1] = start[kept]
        return replace(now.at(kept), poses=poses, apart=False), normalise(-power * gained[kept])

    def _jumped(
        self, last: Trajectories, log_weights: Tensor, reading: Reading, path: Tensor, random: torch.Generator
    ) -> Trajectories:
        """Particles after a jump in an action, by what the pads felt at its end; they are met by touch anew."""
        felt, own = felt_pads(reading, self.model, self.own), self.own
        touched = reading.in_contact.nonzero()[:, 0]
        way = path[touched[-1], 1, :2] - path[touched[0], 0, :2] if len(touched) else path[-1, 1, :2] - path[0, 0, :2]
        count = _UNMET * own.unseen_particles
        rows = resample_systematic(log_weights, count - count // 10, generator=random)
        held = bool(reading.in_contact[-1].any())
        start = jumped(self.model.rests, last.pose[rows], way, generator=random, held=held)
        start = torch.cat((start, from_prior(self.prior, count - len(start), random)))
        end, even = torch.tensor([len(path) - 1]), torch.zeros(count, dtype=torch.float64)
        some = start[systematic(even, 0.5, min(self.shown, count))]
        ended = pushed(reading, end, path, felt, some[:, None], self.model, own)._replace(pushes=False, motion=None)
        start = self._brought(start, ended, random)
        kept = resample_systematic(self._fit(start, ended), own.unseen_particles, generator=random)
        drawn = Trajectories.drawn(start[kept], History.empty(4), random, apart=True)
        return self._moved(drawn, random)

    def _brought(self, start: Float[Tensor, "N 6"], sensed: Segment, random: torch.Generator) -> Float[Tensor, "N 6"]:
        """Three of four poses brought to a point that was felt, if any was."""
        points = sensed.points[sensed.kind == Kind.FELT]
        if not len(points):
            return start
        some = torch.arange(len(start)) % 4 > 0
        chosen = torch.randint(len(points), (int(some.sum()),), generator=random)
        start = start.clone()
        start[some] = brought_to(self.model, start[some], points[chosen], self.own.felt_m)
        return start

    def _fit(self, start: Float[Tensor, "N 6"], sensed: Segment) -> Float[Tensor, "N"]:
        """Log-likelihood of what was sensed of poses at rest."""
        history = History.empty(4).appended(sensed)
        drawn = Trajectories.still(start, history)
        drawn = drawn.replayed(self.model, self.own, history, torch.zeros(len(start), dtype=torch.long))
        gained = drawn.log_likelihood[:, 0]
        check_finite(gained)
        return gained
