"""Trajectories of an object that no view shows: a prior until it is touched, and begun anew where nothing fits.

Before the first touch particles are the prior's, weighed by what was free. With it many are drawn anew, since those
from before it stand too far apart, and most are brought to what was felt. The same after a *jump*, a motion that no
trajectory explains: particles are then drawn about those before it, and wait for the next touch.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.pose_trajectories import NOISE, PoseTrajectoryBelief, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter, check_finite, one, power_of
from rumi.belief.prior import PosePrior
from rumi.belief.segments import cut, felt_pads, path_of, pushed, until_felt
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_moves import Moves
from rumi.belief.trajectory_starts import brought_to, from_prior, jittered, jumped, least_fit
from rumi.registration.descent import Search
from rumi.resampling import resample_systematic, systematic
from rumi.seeding import Generators, normal
from rumi.weights import normalise
from sdf.so3 import wrap
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading

# draws at a first touch, those of them whose motion is worked out, and starts that are kept for proposals and for jumps
_UNMET, _MET, _STARTS, _JUMPED = 24000, 4000, 300, 3000
_LOOKED_AT = 24  # of these, to choose the points that tell
_TOUCHED_ABOUT = (0.004, 0.004, 0.1)  # deviations of starts after a touch: metres, metres, radians
_NARROW_M, _NARROW_RAD = 0.012, 0.2  # deviations of a belief that fewer particles stand for
_FEWER = 3  # times


class UnseenTrajectoryFilter(PoseTrajectoryFilter):
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

    def begin(self, belief: PoseBelief, memory: Observation, *, generator: Generators) -> PoseBelief:
        """Draws of the prior."""
        random = one(generator)
        start, starts = (from_prior(self.prior, count, random) for count in (self.own.unseen_particles, _STARTS))
        drawn = Trajectories.drawn(start, History.empty(4), random, starts)
        even = normalise(torch.zeros(len(start), dtype=torch.float64))
        return self.belief_of(drawn, even, belief.world_T_attached, belief.log_weights)

    @torch.no_grad()
    def begun_again(self, belief: PoseTrajectoryBelief, reading: Reading, *, generator: Generators) -> PoseBelief:
        """The belief after a jump in the last action: about where it was, by what the pads felt at its end.

        Args:
            belief: that a reading does not fit.
            reading: of the last action.
            generator: of the draws.
        """
        assert belief.trajectories is not None
        random, weights = one(generator), belief.log_weights.double()
        now = self._jumped(belief.trajectories, weights, reading, path_of(reading, self.model), random)
        even = normalise(weights.new_zeros(len(now)))
        return self.belief_of(now, even, belief.world_T_attached, belief.log_weights)

    def _pushes(self, now: Trajectories, log_weights: Tensor, reading: Reading, path: Tensor) -> bool:
        if not len(now.history.moving()):
            return bool(reading.in_contact.any()) or self._leans(now, log_weights)
        return super()._pushes(now, log_weights, reading, path)

    def _touched(
        self, now: Trajectories, log_weights: Tensor, reading: Reading, path: Tensor, random: torch.Generator
    ) -> tuple[Trajectories, list[int]]:
        before, parts, spans = now, cut(reading, self.own), []
        even = log_weights
        if not len(now.history.moving()):
            if not bool(reading.in_contact[parts[0]].any()):
                parts = [torch.cat(parts[:2]), *parts[2:]]
            first, *parts = parts
            felt = felt_pads(reading, self.model, self.own)
            tracks = self._tracks(now, log_weights, path[first])
            now = self._met(now, pushed(reading, first, path, felt, tracks, self.model, self.own), random)
            spans, even = [len(first)], normalise(log_weights.new_zeros(len(now)))
        now, spans = self._through(now, even, parts, reading, path, random, spans)
        fit = float(now.log_likelihood[:, -len(spans) :].sum(-1).mean())
        if fit < least_fit(int(reading.in_contact.sum())):
            return self._jumped(before, log_weights, reading, path, random), []
        many = self.own.unseen_particles
        count = max(1, many // _FEWER) if narrow(now.pose) else many
        if count != len(now):
            now = now.at(systematic(normalise(now.log_likelihood.new_zeros(len(now))), 0.5, count))
        return now, spans

    def _met(self, now: Trajectories, segment: Segment, random: torch.Generator) -> Trajectories:
        """Particles after the first touch, drawn anew: those from before it stand too far apart.

        Most draws are brought to what was felt first; those that fit what was sensed up to then are replayed.
        """
        if now.anywhere:
            chosen = torch.randint(len(now.starts), (_UNMET,), generator=random)
            start = jittered(now.starts[chosen], generator=random)
        else:
            start = from_prior(self.prior, _UNMET, random)
        still, begun = now.history, until_felt(segment)
        if begun is not None:
            still = still.appended(begun)
            felt = begun.points[begun.kind == Kind.FELT]
            if len(felt):
                some = torch.arange(_UNMET) % 4 > 0
                chosen = torch.randint(len(felt), (int(some.sum()),), generator=random)
                start[some] = brought_to(self.model, start[some], felt[chosen], self.own.felt_m)
        drawn = replace(Trajectories.drawn(start, still, random, now.starts), anywhere=now.anywhere)
        drawn = drawn.replayed(self.model, self.own, still, torch.zeros(_UNMET, dtype=torch.long))
        log_weights = drawn.log_likelihood.sum(-1)
        check_finite(log_weights)
        power = power_of(torch.zeros_like(log_weights), log_weights, 0.0, 0.1 * _MET)
        kept = resample_systematic(power * log_weights, _MET, generator=random)
        known = now.history
        drawn = replace(
            Trajectories.drawn(start[kept], known, random, now.starts),
            anywhere=now.anywhere,
            log_likelihood=drawn.log_likelihood[kept, : len(known)],
        )
        base = drawn.log_likelihood.sum(-1) - power * log_weights[kept]
        return self._fitted(drawn, self.own.unseen_particles, segment, random, base)

    def _jumped(
        self,
        last: Trajectories,
        log_weights: Tensor,
        reading: Reading,
        path: Tensor,
        random: torch.Generator,
    ) -> Trajectories:
        """Particles after a jump in an action, by what the pads felt at its end; they are met by touch anew."""
        felt, own = felt_pads(reading, self.model, self.own), self.own
        touched = reading.in_contact.nonzero()[:, 0]
        way = path[touched[-1], 1, :2] - path[touched[0], 0, :2] if len(touched) else path[-1, 1, :2] - path[0, 0, :2]
        rows = resample_systematic(log_weights, _MET - _MET // 10, generator=random)
        held = bool(reading.in_contact[-1].any())
        start = jumped(self.model.rests, last.pose[rows], way, generator=random, held=held)
        start = torch.cat((start, from_prior(self.prior, _MET - len(start), random)))
        end, every = torch.tensor([len(path) - 1]), torch.arange(0, len(start), len(start) // _LOOKED_AT)
        end_of = pushed(reading, end, path, felt, start[every, None], self.model, own)._replace(pushes=False)
        history = History.empty(4).appended(end_of)
        there = end_of.points[end_of.kind == Kind.FELT]
        if len(there):
            some = torch.arange(len(start)) % 4 > 0
            chosen = torch.randint(len(there), (int(some.sum()),), generator=random)
            start[some] = brought_to(self.model, start[some], there[chosen], own.felt_m)
        drawn = Trajectories.drawn(start, history, random)
        drawn = drawn.replayed(self.model, own, history, torch.zeros(len(start), dtype=torch.long))
        gained = drawn.log_likelihood[:, 0]
        check_finite(gained)
        starts = start[resample_systematic(gained, _JUMPED, generator=random)]
        drawn = drawn.at(resample_systematic(gained, own.unseen_particles, generator=random))
        return replace(drawn, starts=starts, anywhere=True)

    def _fitted(
        self,
        drawn: Trajectories,
        count: int,
        segment: Segment,
        random: torch.Generator,
        base: Float[Tensor, "N"],
    ) -> Trajectories:
        """So many of the particles that a segment with contact leaves of more, tempered and moved.

        Args:
            drawn: more particles.
            count: how many.
            segment: that comes in.
            random: of the draws.
            base: log-weights before it.
        """
        own, history = self.own, drawn.history.appended(segment)
        noise = normal((len(drawn), 1, NOISE), generator=random, dtype=torch.float64)
        last = torch.full((len(drawn),), len(history) - 1)
        drawn = drawn.lengthened(noise, history).replayed(self.model, own, history, last)
        gained = drawn.log_likelihood[:, -1]
        check_finite(gained)
        whole = base + gained
        start_at = power_of(torch.zeros_like(whole), whole, 0.0, float(count))
        starts = drawn.poses[resample_systematic(start_at * whole, _STARTS, generator=random), 0]
        now = replace(drawn.at(resample_systematic(start_at * whole, count, generator=random)), starts=starts)
        scaled = now.log_likelihood.clone()
        scaled[:, -1] *= start_at
        now = self._tempered(replace(now, log_likelihood=scaled), start_at, random, whole=True)
        return replace(now, starts=now.poses[:, 0])

    def _moves(self, now: Trajectories, random: torch.Generator) -> Moves:
        """Moves under a history; start poses that only a prior tells are drawn anew farther about others."""
        if now.anywhere:
            return Moves(self.model, self.own, random, None, _TOUCHED_ABOUT)
        far = 0.3 * self.prior.spread_m
        about = _TOUCHED_ABOUT if len(now.history.moving()) else (far, far, 0.5)
        return Moves(self.model, self.own, random, self.prior, about)


def narrow(poses: Float[Tensor, "N 6"]) -> bool:
    """Whether poses rest in one way, at about one place and yaw."""
    if bool((poses[:, 3] != poses[0, 3]).any()) or bool((poses[:, 4] >= 0).any()):
        return False
    apart = wrap(poses[:, 2] - poses[0, 2])
    turn = apart.std(unbiased=False)
    return float(poses[:, :2].std(0, unbiased=False).max()) < _NARROW_M and float(turn) < _NARROW_RAD
