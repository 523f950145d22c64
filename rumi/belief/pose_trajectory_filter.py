"""Pose filter whose particles each have their own motion: resample-move over trajectories, with tempering.

No sensor has to measure how the object moved; one that does is evidence. Every particle is a start pose, the physics of
pushing it, and what its motion was off; each reading is compared with the particle's pose at the instant of the
reading, so that a new one costs its own points alone. Where weights degenerate, readings come in by and by (tempering),
and particles are resampled and moved under their whole history (Chopin's IBIS, 2002, with Del Moral's tempering, 2006).
"""

import copy
from dataclasses import replace
from typing import NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.first_poses import drawn_again, of_prior, of_view
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterInfo, FilterSettings, PoseFilter
from rumi.belief.pose_trajectories import NOISE, PoseTrajectoryBelief, Trajectories, middle_motion
from rumi.belief.prior import PosePrior
from rumi.belief.pushed_model import Pushed
from rumi.belief.segments import above, cut, felt_pads, path_of, pushed, seen_besides, standing
from rumi.belief.sensed_motion import way_sensed
from rumi.belief.tempering import check_finite, in_full, log_mean, power_of, raised
from rumi.belief.trajectory_chance import log_chance
from rumi.belief.trajectory_history import Segment
from rumi.belief.trajectory_moves import Moves
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.errors import UsageError
from rumi.registration.descent import Search
from rumi.resampling import resample_systematic, systematic
from rumi.seeding import Generators, lone, normal
from rumi.weights import effective_sample_size, equal_weights, normalise
from sdf import se3
from sensors.discrepancy import Discrepancy
from sensors.evidence import EvidenceModel
from sensors.observation import Observation, attach, in_world, merge
from sensors.reading import Reading

_LOOKED_AT = 24
_MOVED_M, _MOVED = 0.001, 0.1  # an unfelt push: how far it moves which share of the belief
_UNSETTLED = 0.03  # share of the belief that leans on the tool, and so moves with it, felt or not
_ALIVE = 0.4  # share of different poses before an action that needs no moves in the middle of it


class Advanced(NamedTuple):
    """Particles after an action.

    Attributes:
        now: particles.
        log_weights: of them.
        touched: whether the tool may have moved the object.
        spans: how many instants each new pushed segment has; none where it was begun anew.
        rides: (K, 4, 4), motion of a particle in the middle of the belief up to each instant.
        resampled: whether particles were resampled.
        changed: whether anything new was sensed.
    """

    now: Trajectories
    log_weights: Float[Tensor, "N"]
    touched: bool
    spans: list[int]
    rides: Float[Tensor, "K 4 4"]
    resampled: bool
    changed: bool


class PoseTrajectoryFilter(PoseFilter):
    """Follows objects that a tool pushes, with or without a sensor of their motion; holds settings alone.

    Args:
        settings: of which `trajectories` count here, and the lattice of the points kept for planners.
        discrepancy: C^, by which the first view's poses are found.
        model: object and tool.
        prior: of the start pose, where no view shows the object; its ways are the model's first resting poses.
        search: freedom of the pose, "SE(2)" or "SE(3)".
    """

    def __init__(
        self,
        settings: FilterSettings,
        discrepancy: Discrepancy,
        model: Pushed,
        prior: PosePrior | None = None,
        search: Search = "SE(2)",
    ) -> None:
        super().__init__(settings, [discrepancy], search, prior)
        self.model, self.own, self.moves = model, settings.trajectories, Moves

    def with_evidence(self, *models: EvidenceModel) -> Self:
        """Refused: trajectories take in points alone."""
        raise UsageError("Expected a motion other than 'trajectory' where further evidence counts: it takes in none")

    def doubting(self) -> Self:
        """The same filter where its prior of how the object is pushed is not believed."""
        return self.supposing(own=self.own.doubted())

    def supposing(
        self,
        *,
        model: Pushed | None = None,
        own: PoseTrajectorySettings | None = None,
        moves: type[Moves] | None = None,
    ) -> Self:
        """The same filter of another object, with other priors and noise, or with other moves."""
        other = copy.copy(self)
        other.model, other.own, other.moves = model or self.model, own or self.own, moves or self.moves
        return other

    def begin(self, belief: PoseBelief, memory: Observation, *, generator: Generators) -> PoseBelief:
        """Draws of the posterior of a first view, from poses that fit it: importance sampling, then moves.

        Without a view draws of the prior.
        """
        random, own = lone(generator), self.own
        if self.prior is not None:
            drawn = of_prior(self.prior, memory, self.model, own, random)
        else:
            fitted = se3.to_planar(belief.world_T_object.double())
            drawn = of_view(standing(memory, fitted, self.model, own), fitted, self.model, own, random)
        even = equal_weights(own.particles)
        return self.belief_of(drawn, even, belief.world_T_attached, belief.log_weights)

    @torch.no_grad()
    def forward(
        self, belief: PoseBelief, memory: Observation, reading: Reading, *, generator: Generators
    ) -> tuple[PoseBelief, Observation, FilterInfo]:
        """One whole filter step; arguments as of `PoseFilter`."""
        after, done = self.followed(belief, reading, generator=generator)
        frame = belief.world_T_attached
        frames = done.rides.to(frame) @ frame
        if done.touched and not done.spans:  # begun anew: what was sensed before told where it was
            memory = memory[(~memory.attached).nonzero()[:, 0]]
        if done.spans:
            new = attach(reading.observation, reading.instant, frames)
        else:  # one frame for all instants
            new = in_world(reading.observation, se3.inverse(frames[0]))
        memory, added = merge(memory, new, self.lattice)
        return after, memory, FilterInfo(torch.tensor(done.touched), torch.tensor(done.resampled), added)

    def followed(self, belief: PoseBelief, reading: Reading, *, generator: Generators) -> tuple[PoseBelief, Advanced]:
        """The belief after an action, and how its particles came there.

        Raises:
            ValueError: the reading is not of one scene.
        """
        if reading.tool_pose.ndim != 3:
            raise ValueError(f"Expected a reading of one scene, got tool_pose {tuple(reading.tool_pose.shape)}")
        done = self.advanced(*self.particles_of(belief), reading, lone(generator))
        if done.changed:
            frame = done.rides[-1].to(belief.world_T_attached) @ belief.world_T_attached
            belief = self.belief_of(done.now.remembered(self.own.memory), done.log_weights, frame, belief.log_weights)
        return belief, done

    def particles_of(self, belief: PoseBelief) -> tuple[Trajectories, Float[Tensor, "N"]]:
        """Particles of a belief, and their log-weights."""
        if not isinstance(belief, PoseTrajectoryBelief) or belief.trajectories is None:
            raise TypeError("Expected a belief with trajectories, as `begin` gives it, got one of poses alone")
        return belief.trajectories, belief.log_weights.double()

    @torch.no_grad()
    def advanced(
        self, now: Trajectories, log_weights: Float[Tensor, "N"], reading: Reading, random: torch.Generator
    ) -> Advanced:
        """Particles after an action, and how they came there."""
        own, resampled = self.own, False
        path = path_of(reading, self.model)
        spans, touched = list[int](), self._pushes(now, log_weights, reading, path)
        stood = reading.observation if not touched else seen_besides(reading, self.model, own)
        if touched:
            now, spans = self._touched(now, log_weights, reading, path, random, closes=not len(stood))
            log_weights, resampled = equal_weights(len(now)), True
        rides = middle_motion(now, spans, len(reading.in_contact), self.model)
        still = standing(stood, self._poses(now, log_weights), self.model, own, now.history)
        if still is not None:
            now, log_weights, again = self._weighed(now, log_weights, still, random, closes=touched)
            resampled |= again
        return Advanced(now, log_weights, touched, spans, rides, resampled, touched or still is not None)

    def log_evidence(self, belief: PoseBelief) -> float:
        """Log marginal likelihood of all readings so far."""
        return self.particles_of(belief)[0].log_evidence

    def log_chance(self, belief: PoseBelief) -> float:
        """Log of a bound on the p-value of all readings at the best particle."""
        if not isinstance(belief, PoseTrajectoryBelief) or belief.trajectories is None:
            return 0.0
        return log_chance(belief.trajectories, belief.log_weights, self.own)

    def _pushes(self, now: Trajectories, log_weights: Tensor, reading: Reading, path: Tensor) -> bool:
        """Whether the tool may have moved the object: that is sensed, the pads felt it, or it met it beside them."""
        if bool(reading.in_contact.any()) or self._leans(now, log_weights):
            return True
        path = path[~self.model.lifted(reading.tool_pose)]
        if not len(path):
            return False
        some = now.pose[systematic(log_weights, 0.5, min(_LOOKED_AT, len(now)))]
        if way_sensed(reading, self.model.world_T_object(some)) > _MOVED_M:
            return True
        if float(torch.cdist(path[:, 1, :2], some[:, :2]).min()) >= self.model.reach_m:
            return False
        moved = (self.model.tracks(self.own, some, path)[:, -1] - some)[:, :2].norm(dim=-1) > _MOVED_M
        return float(moved.double().mean()) >= _MOVED

    def leaning(self, belief: PoseBelief, least_rad: float) -> float:
        """Share of a belief that leans on the tool by at least an angle."""
        now, log_weights = self.particles_of(belief)
        return float(self.model.unsettled(now.pose, least_rad).double() @ log_weights.exp())

    def _leans(self, now: Trajectories, log_weights: Tensor) -> bool:
        """Whether more of the belief than counts for nothing leans on the tool."""
        return float(self.model.unsettled(now.pose).double() @ log_weights.exp()) > _UNSETTLED

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
        """Particles, equally weighted, after an action with contact, and how long its segments are; none if anew.

        It `closes` where nothing further tells of the action: no camera has looked after it.
        """
        felt, spans = felt_pads(reading, self.model, self.own), list[int]()
        if self.own.first_particles > len(now) and len(now.starts) and not len(now.history.moving()):
            now = drawn_again(now, self.model, self.own, random)
            log_weights = equal_weights(len(now))
        lifted = self.model.lifted(reading.tool_pose)
        parts = cut(reading, self.own, lifted)
        level = [place for place, instants in enumerate(parts) if not bool(lifted[instants[0]])]
        for place, instants in enumerate(parts):
            if place not in level:
                now, log_weights, _ = self._weighed(now, log_weights, above(path[instants]), random)
                spans.append(len(instants))
                continue
            tracks = self._tracks(now, log_weights, path[instants])
            segment = pushed(reading, instants, path, felt, tracks, self.model, self.own)
            last = closes and place == level[-1]
            now = self.absorbed(now, log_weights, segment, random, opens=not spans, closes=last)
            log_weights, spans = equal_weights(len(now)), [*spans, len(instants)]
        return now, spans

    def _poses(self, now: Trajectories, log_weights: Tensor) -> Float[Tensor, "n D"]:
        """Poses by which points are chosen that tell."""
        return now.pose

    def _tracks(self, now: Trajectories, log_weights: Tensor, path: Tensor) -> Float[Tensor, "n k D"]:
        """Where some of the particles go by the median of the prior."""
        some = now.pose[systematic(log_weights, 0.5, min(_LOOKED_AT, len(now)))]
        return self.model.tracks(self.own, some, path)

    def with_segment(
        self,
        now: Trajectories,
        log_weights: Float[Tensor, "N"],
        segment: Segment,
        random: torch.Generator,
        *,
        opens: bool,
        closes: bool,
    ) -> tuple[Trajectories, Float[Tensor, "N"]]:
        """Particles and their log-weights after a segment, pushed or not."""
        if segment.pushes:
            now = self.absorbed(now, log_weights, segment, random, opens=opens, closes=closes)
            return now, equal_weights(len(now))
        now, log_weights, _ = self._weighed(now, log_weights, segment, random)
        return now, log_weights

    def absorbed(
        self,
        now: Trajectories,
        log_weights: Tensor,
        segment: Segment,
        random: torch.Generator,
        *,
        opens: bool,
        closes: bool,
    ) -> Trajectories:
        """Particles, equally weighted, after a segment with contact: motions branch, the likely ones are kept."""
        own, count = self.own, len(now)
        history = now.history.appended(segment, opens=opens)
        many = count > own.particles  # of a first touch: they branch enough, and wait for moves until they are few
        parents = torch.arange(count).repeat_interleave(1 if many else own.branches)
        noise = normal((len(parents), 1, NOISE), generator=random, dtype=torch.float64)
        tried = now.at(parents).stepped(self.model, own, noise, history)
        base, gained = log_weights[parents], tried.log_likelihood[:, -1]
        check_finite(gained)
        power = power_of(base, gained, 0.0, float(min(count, own.particles)))
        if many and (closes or power < 1.0):
            count = own.particles
        tried = tried.at(resample_systematic(base + power * gained, count, generator=random))
        told = log_mean(base, power * gained)
        now = replace(raised(tried, power), log_evidence=now.log_evidence + told)
        # the action's motions are branched anew; those before it are what dies out
        alive = len(torch.unique(now.poses[:, int(history.action[-1]), 0]))
        if power == 1.0 and not closes and (count > own.particles or alive >= _ALIVE * count):
            return now
        return self._tempered(now, power, random, whole=closes)

    def _weighed(
        self, now: Trajectories, log_weights: Tensor, segment: Segment, random: torch.Generator, *, closes: bool = False
    ) -> tuple[Trajectories, Tensor, bool]:
        """Particles weighed by what was sensed while the object stood still.

        They are resampled only where that degenerates, or too many; and moved then, or where it closes an action.
        """
        count, history = len(now), now.history.appended(segment)
        noise = normal((count, 1, NOISE), generator=random, dtype=torch.float64)
        now = now.lengthened(noise, history)
        now = now.replayed(self.model, self.own, history, torch.full((count,), len(history) - 1))
        gained = now.log_likelihood[:, -1]
        check_finite(gained)
        few = min(count, self.own.particles)
        enough = float(effective_sample_size(log_weights + gained)) >= 0.5 * few
        power = 1.0 if enough else power_of(log_weights, gained, 0.0, 0.5 * few)
        heavier = normalise(log_weights + power * gained)
        now = replace(now, log_evidence=now.log_evidence + log_mean(log_weights, power * gained))
        resampled = not enough or (closes and count > few)
        if resampled:
            now = now.at(resample_systematic(heavier, few, generator=random))
            heavier = equal_weights(few)
        if resampled or closes:
            now = self._tempered(raised(now, power), power, random, whole=True)
        return now, heavier, resampled

    def _tempered(self, now: Trajectories, power: float, random: torch.Generator, *, whole: bool) -> Trajectories:
        """Particles moved and resampled until the last segment's readings count in full, at last from the start."""
        moves = self.moves(self.model, self.own, random)
        return in_full(now, power, moves, random, rounds=self.own.rounds, whole=whole)

    def _heights(self, now: Trajectories) -> Float[Tensor, "N"]:
        """How much higher each particle's origin is than the model of its motion has it."""
        return now.pose.new_full((len(now),), self.model.resting_m)

    def belief_of(
        self, now: Trajectories, log_weights: Tensor, world_T_attached: Tensor, like: Tensor
    ) -> PoseTrajectoryBelief:
        """The belief of trajectories, in the dtype of another."""
        frame = world_T_attached.to(like)
        poses = self.model.world_T_object(now.pose.to(like))
        poses[..., 2, 3] += self._heights(now).to(like)
        attached, weights = se3.inverse(frame) @ poses, normalise(log_weights.to(like))
        return PoseTrajectoryBelief(frame, attached, weights, torch.zeros_like(weights), None, now)
