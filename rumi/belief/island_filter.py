"""Islands of a bootstrap filter: populations that go on by themselves, whose mixture is the belief.

After a touch that several ways of lying explain a population keeps those that its few good draws happen to have, and
forgets the others: it is sure of what another draw of the same numbers denies. Populations with nothing in common show
what the draws have decided: what they disagree on is not known (island particles of Verge, Dubarry, Del Moral and
Moulines 2015, without their interaction). Their estimates of the evidence differ by 5 to 20 nats where nothing but the
draws does, so that they are weighed by a small power of it. Where they are asked to exchange a few particles, so that
one that lost the truth finds back, they have even shares.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.bootstrap_filter import SHOWN, BootstrapBelief, BootstrapFilter
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterInfo, FilterSettings
from rumi.belief.pose_trajectories import NOISE, PoseTrajectoryBelief, Trajectories
from rumi.belief.prior import PosePrior
from rumi.belief.segments import above
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_history import History
from rumi.registration.descent import Search
from rumi.resampling import resample_systematic
from rumi.seeding import Generators, lone
from rumi.weights import equal_weights, normalise
from sdf import se3
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading


@dataclass(frozen=True)
class IslandBelief(PoseTrajectoryBelief):
    """Pose particles of several populations; trajectories as of now, without what led there.

    Attributes:
        islands: the populations' own beliefs.
    """

    islands: tuple[BootstrapBelief, ...] = ()


class IslandFilter(BootstrapFilter):
    """Follows several populations of a bootstrap filter, which share its particles evenly; arguments as there."""

    def __init__(
        self,
        settings: FilterSettings,
        discrepancy: Discrepancy,
        model: ToppledObject,
        prior: PosePrior,
        search: Search = "SE(2)",
    ) -> None:
        super().__init__(settings, discrepancy, model, prior, search)
        count = self.own.islands
        most, least = (max(1, many // count) for many in (self.own.unseen_particles, self.own.fewest_particles))
        self.own = replace(self.own, unseen_particles=most, fewest_particles=least)
        # evidence of particles that came from elsewhere is no population's own
        self.evidence_power = 0.0 if self.own.exchanged > 0 else self.own.evidence_power
        self.shown = max(1, SHOWN // count)

    def begin(self, belief: PoseBelief, memory: Observation, *, generator: Generators) -> IslandBelief:
        """Draws of the prior, of each population its own."""
        begun = [super(IslandFilter, self).begin(belief, memory, generator=generator) for _ in range(self.own.islands)]
        return self.mixture(begun)

    @torch.no_grad()
    def forward(
        self, belief: PoseBelief, memory: Observation, reading: Reading, *, generator: Generators
    ) -> tuple[IslandBelief, Observation, FilterInfo]:
        """One whole filter step of each; the points for planners ride with the first. Arguments as of `PoseFilter`."""
        before = list(islands_of(belief))
        if self.own.exchanged > 0 and bool(reading.in_contact.any()):
            before = self._exchanged(before, lone(generator))
        first, memory, info = super().forward(before[0], memory, reading, generator=generator)
        others = [self.followed(island, reading, generator=generator) for island in before[1:]]
        moved = info.moved | any(done.touched for _, done in others)
        resampled = info.resampled | any(done.resampled for _, done in others)
        after = self.mixture([first, *(island for island, _ in others)])
        return after, memory, FilterInfo(moved, resampled, info.added)

    def _exchanged(self, islands: Sequence[BootstrapBelief], random: torch.Generator) -> list[BootstrapBelief]:
        """The populations with a share of each drawn from the others, where particles may take part in a touch."""
        parts = [self.particles_of(island) for island in islands]
        found = []
        for place, (island, (now, log_weights)) in enumerate(zip(islands, parts, strict=True)):
            others = [part for at, part in enumerate(parts) if at != place and not part[0].apart]
            each = int(self.own.exchanged * len(now) / max(1, len(others)))
            if now.apart or not others or not each:
                found.append(island)
                continue
            rows = torch.randperm(len(now), generator=random)[: each * len(others)]
            guests = [other.at(resample_systematic(own, each, generator=random)) for other, own in others]
            poses, physics, heavy = now.poses.clone(), now.physics.clone(), log_weights.clone()
            poses[rows, -1] = torch.cat([guest.pose for guest in guests])
            physics[rows] = torch.cat([guest.physics for guest in guests])
            heavy[rows] = -math.log(len(now))
            mixed = replace(now, poses=poses, physics=physics)
            belief = self.belief_of(mixed, normalise(heavy), island.world_T_attached, island.log_weights)
            assert isinstance(belief, BootstrapBelief)
            found.append(belief)
        return found

    def begun_again(self, belief: PoseBelief, reading: Reading, *, generator: Generators) -> IslandBelief:
        """The belief after a jump in the last action; see `BootstrapFilter.begun_again`."""
        again = super().begun_again
        return self.mixture([again(island, reading, generator=generator) for island in islands_of(belief)])

    def leaning(self, belief: PoseBelief, least_rad: float) -> float:
        """Share of a belief that leans on the tool by at least an angle."""
        islands = islands_of(belief)
        each = [super(IslandFilter, self).leaning(island, least_rad) for island in islands]
        return sum(share * own for share, own in zip(self.log_shares(islands).exp().tolist(), each, strict=True))

    def mixture(self, islands: Sequence[PoseBelief]) -> IslandBelief:
        """The belief of populations, by their shares in it."""
        return _mixture(islands, self.log_shares(islands))

    def log_shares(self, islands: Sequence[PoseBelief]) -> Float[Tensor, "I"]:
        """Log of the populations' shares in the belief, by a power of their evidence."""
        if self.evidence_power == 0:
            return equal_weights(torch.zeros(len(islands), dtype=torch.float64))
        evidence = [self.particles_of(island)[0].log_evidence for island in islands]
        return normalise(self.evidence_power * torch.tensor(evidence, dtype=torch.float64))

    def log_evidence(self, belief: PoseBelief) -> float:
        """Log marginal likelihood of all readings: the mean over the populations' estimates of it."""
        each = [self.particles_of(island)[0].log_evidence for island in islands_of(belief)]
        return float(torch.tensor(each, dtype=torch.float64).logsumexp(0)) - math.log(len(each))

    def log_chance(self, belief: PoseBelief) -> float:
        """Log of a bound on the p-value of all readings at the best particle of any population."""
        return max(super(IslandFilter, self).log_chance(island) for island in islands_of(belief))


def islands_of(belief: PoseBelief) -> tuple[BootstrapBelief, ...]:
    """The populations of a belief.

    Raises:
        TypeError: it has none.
    """
    if not isinstance(belief, IslandBelief):
        raise TypeError("Expected a belief of an island filter, as `begin` gives it, got another one")
    return belief.islands


def _mixture(islands: Sequence[PoseBelief], log_shares: Float[Tensor, "I"]) -> IslandBelief:
    """The mixture of populations, by the log of their shares, in the frame of the first."""
    parts = [island for island in islands if isinstance(island, BootstrapBelief)]
    frame = parts[0].world_T_attached
    back = se3.inverse(frame)
    poses = torch.cat([parts[0].attached_T_object, *[back @ part.world_T_object for part in parts[1:]]])
    share = [part.log_weights + own for part, own in zip(parts, log_shares.to(parts[0].log_weights), strict=True)]
    now = _as_of_now([part.trajectories for part in parts if part.trajectories is not None])
    flat = torch.cat([part.discrepancy for part in parts])
    return IslandBelief(frame, poses, normalise(torch.cat(share)), flat, None, now, tuple(parts))


def _as_of_now(parts: Sequence[Trajectories]) -> Trajectories:
    """Particles of different histories: where they are, how they slid last, and one segment without readings."""
    history = History.empty(4).appended(above(torch.zeros(1, 2, 4, dtype=torch.float64)))
    noise = [part.noise[:, -1:] if part.noise.shape[1] else part.noise.new_zeros(len(part), 1, NOISE) for part in parts]
    pose = torch.cat([part.pose for part in parts])
    return Trajectories(
        torch.cat([part.physics for part in parts]),
        torch.cat(noise),
        pose[:, None].repeat(1, 2, 1),
        pose.new_zeros(len(pose), 1),
        history,
        pose[:0],
        apart=any(part.apart for part in parts),
    )
