"""Metropolis-Hastings moves of trajectories under their history: they leave its posterior as it is.

Noise of a segment, or the physics, turns towards a fresh draw of its prior; noise of all segments from one on, with
start pose and physics where that is the first, goes by the difference of two other particles. The particles are moved
half by half, with differences of the other half, so that each half's proposals are symmetric whatever the other is.
Friction and lever are drawn given those of all segments (Gibbs), which moves no trajectory. Systematic errors turn
towards a fresh draw, size about what was touched; object, tool and view are translated together, of which readings can
hardly tell.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.belief.pose_trajectories import OWN, PHYSICS, Trajectories
from rumi.belief.pushed_model import Pushed
from rumi.belief.systematic_errors import NUMBERS, SIZE, VIEW, WEAR, SystematicErrors, as_it_is, as_seen
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.sliding import rotated
from sdf.so3 import wrap

KERNEL = (0.0008, 0.0008, math.radians(2.0))
"""Deviations of start poses drawn anew about those that are left open."""

_AFRESH, _SPUN = 0.15, 0.3
_OFF = [k for k in range(NUMBERS) if k not in (WEAR, SIZE)]  # errors of tool and view
_AT_ONCE = 1 << 16  # pairs of poses whose densities are worked out together: what a processor's cache holds
_FAR = 1e4  # minus the log-density of what is never drawn: finite, since differences of it are taken


@dataclass(frozen=True)
class Moves:
    """Moves for one object and one motion prior; without state.

    Attributes:
        model: object and tool.
        settings: of motion prior and sensors.
        generator: of the random draws.
    """

    model: Pushed
    settings: PoseTrajectorySettings
    generator: torch.Generator

    def sweep(self, given: Trajectories, history: History, *, whole: bool, rounds: int = 1) -> Trajectories:
        """Moves of all particles, late ones so many times; `whole` ones from the start, too."""
        for _ in range(rounds):
            if len(history.moving()):
                given = self.turned(given, history)
                given = self.shifted(given, history, whole=False)
        if whole and len(given.starts):
            given = self.shifted(given, history, whole=True)
            given = self.restarted(given, history)
            given = self.spun(given, history)
            given = self.reshaped(self.erred(self.translated(given, history), history), history)
            if len(history.moving()):
                given = self.learnt(self.slid(given, history), history)
        return given

    def turned(self, given: Trajectories, history: History) -> Trajectories:
        """Noise of a late segment, its own or its action's, turned towards a fresh draw."""
        count, segment = len(given), self._segment(history, len(given))
        share = self._uniform(count) < 0.3
        segment = torch.where(share, history.action[segment], segment)
        angle = 0.5 * math.pi * self._uniform(count)[:, None] ** 2
        rows = torch.arange(count)
        old = given.noise[rows, segment]
        fresh = angle.cos() * old + angle.sin() * self._normal(old.shape)
        chosen = (torch.arange(old.shape[1]) >= OWN) == share[:, None]
        noise = given.noise.clone()
        noise[rows, segment] = torch.where(chosen, fresh, old)
        return self.accepted(given, replace(given, noise=noise), history, segment)

    def shifted(self, given: Trajectories, history: History, *, whole: bool) -> Trajectories:
        """Each half by differences of the other half's particles, from a late segment on or in everything."""
        count = len(given)
        if count < 6:
            return given
        order = torch.randperm(count, generator=self.generator)
        for rows, others in ((order[: count // 2], order[count // 2 :]), (order[count // 2 :], order[: count // 2])):
            some, many = given.at(rows), len(rows)
            draw = torch.rand(many, len(others), generator=self.generator).topk(2, -1).indices
            one, other = others[draw[:, 0]], others[draw[:, 1]]
            size = 0.7 * self._uniform(many) ** 2
            size = torch.where(self._uniform(many) < 0.1, 1.0, size)
            first = torch.zeros(many, dtype=torch.long) if whole else self._segment(history, many)
            late = torch.arange(len(history)) >= first[:, None]
            step = size[:, None, None] * late[..., None] * (given.noise[one] - given.noise[other])
            proposed = replace(some, noise=some.noise + step)
            if whole:
                starts = given.poses[:, 0]
                apart = (starts[one] - starts[other])[:, :3]
                apart = torch.cat((apart[:, :2], wrap(apart[:, 2:])), -1)
                jitter = 0.1 * self._normal(apart.shape) * apart.new_tensor(KERNEL)
                poses = some.poses.clone()
                poses[:, 0, :3] += size[:, None] * apart + jitter
                physics = some.physics + size[:, None] * (given.physics[one] - given.physics[other])
                proposed = replace(proposed, poses=poses, physics=physics)
            change = proposed.log_prior() - some.log_prior() + self._start_prior(proposed) - self._start_prior(some)
            moved = self.accepted(some, proposed, history, first, change)
            given = given.put(rows, moved)
        return given

    def slid(self, given: Trajectories, history: History) -> Trajectories:
        """Physics of pushing alone, all of it or one number, turned towards a fresh draw; what follows is replayed."""
        count = len(given)
        angle = 0.5 * math.pi * self._uniform(count)[:, None] ** 2
        turned = self._turned_in_part(given.physics[:, :PHYSICS], angle)
        proposed = replace(given, physics=torch.cat((turned, given.systematic), -1))
        return self.accepted(given, proposed, history, history.moving()[:1].expand(count))

    def translated(self, given: Trajectories, history: History) -> Trajectories:
        """Object, tool and what was seen translated together, by a draw of the errors' prior (Gibbs).

        No reading tells of it as long as the tool does not turn, and no view at all, so that those are not weighed
        anew; other moves go that way by small steps alone.
        """
        own = self.settings
        if not own.tool_off_m > 0:
            return given
        errors = SystematicErrors.of(own, given.systematic)
        yaw = history.pushing_yaw() - errors.tool_rad
        precision = own.tool_off_m**-2 + (own.view_off_m**-2 if own.view_off_m > 0 else 0.0)
        mean = own.tool_off_m**-2 * rotated(errors.tool_m, yaw)
        if own.view_off_m > 0:
            mean = mean + own.view_off_m**-2 * rotated(errors.view_m, -errors.view_rad)
        shift = mean / precision + self._normal(mean.shape) / math.sqrt(precision)
        poses, physics = given.poses.clone(), given.physics.clone()
        told = history.shown() if own.view_off_m > 0 else 0
        poses[:, : told + 1, :2] += shift[:, None]
        physics[:, PHYSICS : PHYSICS + 2] -= rotated(shift, -yaw) / own.tool_off_m
        if own.view_off_m > 0:
            view = slice(PHYSICS + VIEW, PHYSICS + VIEW + 2)
            physics[:, view] -= rotated(shift, errors.view_rad) / own.view_off_m
        proposed = replace(given, poses=poses, physics=physics)
        odds = self._start_prior(proposed) - self._start_prior(given)
        return self.accepted(given, proposed, history, torch.full((len(given),), told), odds)

    def erred(self, given: Trajectories, history: History) -> Trajectories:
        """Errors of tool and view, all of them or one, turned towards a fresh draw; what they change is replayed.

        The object stays where the view has it, so that where the view alone is off it is not weighed anew.
        """
        if not given.systematic.shape[1]:
            return given
        angle, numbers = 0.5 * math.pi * self._uniform(len(given))[:, None], given.systematic.clone()
        numbers[:, _OFF] = self._turned_in_part(given.systematic[:, _OFF], angle)
        proposed = replace(given, physics=torch.cat((given.physics[:, :PHYSICS], numbers), -1))
        shown, before = history.shown(), given.poses[:, 0]
        off, again = (numbers != given.systematic)[:, VIEW:SIZE].any(-1), torch.zeros(len(given), dtype=torch.bool)
        if shown:
            start = torch.where(off[:, None], self.unseen(proposed, self.seen(given, before)), before)
            poses = given.poses.clone()
            poses[:, : shown + 1] = start[:, None]
            proposed, again = replace(proposed, poses=poses), off & (start == before).all(-1)
        odds = self._start_prior(proposed) - self._start_prior(given)
        return self.accepted(given, proposed, history, torch.where(again, 0, shown), odds)

    def reshaped(self, given: Trajectories, history: History) -> Trajectories:
        """Wear and size, both or one, turned towards a fresh draw.

        One touch leaves size and place open together: the larger the object, the farther off its middle is. So what was
        touched first, or what was seen, stays where it is on the object as the size changes.
        """
        own, about = self.settings, history.met()
        if not (own.size_off > 0 or own.worn[1] > 0):
            return given
        count, shape = len(given), [PHYSICS + WEAR, PHYSICS + SIZE]
        angle, physics = 0.5 * math.pi * self._uniform(count)[:, None] ** 2, given.physics.clone()
        physics[:, shape] = self._turned_in_part(given.physics[:, shape], angle)
        grown, poses = own.size_off * (physics - given.physics)[:, shape[1]], given.poses.clone()
        if len(about):
            middle = about[(self._uniform(count) * len(about)).long()]
            poses[:, 0, :2] = middle + grown.exp()[:, None] * (poses[:, 0, :2] - middle)
        proposed = replace(given, poses=poses, physics=physics)
        odds = self._start_prior(proposed) - self._start_prior(given)
        odds = odds + 2.0 * grown * bool(len(about))  # places are that much farther apart
        return self.accepted(given, proposed, history, torch.zeros(count, dtype=torch.long), odds)

    def _turned_in_part(self, numbers: Float[Tensor, "N P"], angle: Float[Tensor, "N 1"]) -> Float[Tensor, "N P"]:
        """Standard normals, all of a particle's or one, turned by an angle towards a fresh draw."""
        fresh = angle.cos() * numbers + angle.sin() * self._normal(numbers.shape)
        count, each = numbers.shape
        one = (self._uniform(count) * each).long()[:, None] == torch.arange(each)
        chosen = one | (self._uniform(count) < 0.3)[:, None]
        return torch.where(chosen, fresh, numbers)

    def learnt(self, given: Trajectories, history: History) -> Trajectories:
        """Friction and lever of each particle drawn given those of its pushed segments, which stay as they are."""
        own, moving = self.settings, history.moving()
        physics, noise = given.physics.clone(), given.noise.clone()
        for k, (deviation, change) in enumerate(
            ((own.friction[1], own.friction_change), (own.lever_ratio[1], own.lever_change))
        ):
            if not change > 0:
                continue
            ratio = deviation / change
            each = ratio * physics[:, k, None] + noise[:, moving, k]
            precision = 1.0 + len(moving) * ratio * ratio
            physics[:, k] = ratio / precision * each.sum(-1) + self._normal((len(given),)) / math.sqrt(precision)
            noise[:, moving, k] = each - ratio * physics[:, k, None]
        return replace(given, physics=physics, noise=noise)

    def restarted(self, given: Trajectories, history: History) -> Trajectories:
        """Start poses drawn anew about those that the view leaves open, as it has them."""
        rows = (self._uniform(len(given)) < _AFRESH).nonzero()[:, 0]
        if not len(rows):
            return given
        some, many = given.at(rows), len(rows)
        chosen = (self._uniform(many) * len(given.starts)).long().clamp_max(len(given.starts) - 1)
        scale = given.starts.new_tensor(KERNEL)
        seen = given.starts[chosen].clone()
        seen[:, :3] += self._normal((many, 3)) * scale
        poses = some.poses.clone()
        poses[:, 0] = self.unseen(some, seen)
        before = self.seen(some, some.poses[:, 0])
        odds = start_density(before, given.starts, scale) - start_density(seen, given.starts, scale)
        proposed = replace(some, poses=poses)
        odds = odds + self._start_prior(proposed) - self._start_prior(some)
        first = torch.zeros(many, dtype=torch.long)
        return given.put(rows, self.accepted(some, proposed, history, first, odds))

    def spun(self, given: Trajectories, history: History) -> Trajectories:
        """Start poses turned on the spot by any angle, whatever the view's fits leave open."""
        rows = (self._uniform(len(given)) < _SPUN).nonzero()[:, 0]
        if not len(rows):
            return given
        some = given.at(rows)
        poses = some.poses.clone()
        poses[:, 0, 2] = wrap(poses[:, 0, 2] + 2.0 * math.pi * self._uniform(len(rows)))
        proposed = replace(some, poses=poses)
        odds = self._start_prior(proposed) - self._start_prior(some)
        first = torch.zeros(len(rows), dtype=torch.long)
        return given.put(rows, self.accepted(some, proposed, history, first, odds))

    def seen(self, given: Trajectories, start: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        """Where a camera has start poses, by each particle's systematic errors."""
        return as_seen(self.settings, given.systematic, start)

    def unseen(self, given: Trajectories, seen: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        """Start poses by where a camera has them."""
        return as_it_is(self.settings, given.systematic, seen)

    def _start_prior(self, given: Trajectories) -> Float[Tensor, "N"] | float:
        """Log-density of the start poses, up to a constant: even, where a view told of them."""
        return 0.0 if given.first is None else given.first.planar_log_density(given.poses[:, 0])

    def accepted(
        self,
        given: Trajectories,
        proposed: Trajectories,
        history: History,
        first: Int[Tensor, "N"],
        log_odds: Float[Tensor, "N"] | float = 0.0,
    ) -> Trajectories:
        """Proposals replayed from a segment on, and taken by Metropolis's rule.

        Args:
            given: the particles.
            proposed: with other numbers; poses and likelihood from `first` on are worked out here.
            history: whose posterior is kept.
            first: segment of each particle before which nothing is proposed.
            log_odds: of prior times proposal back over those there.
        """
        late = torch.arange(len(history)) >= first[:, None]
        now = torch.where(late, given.log_likelihood, 0.0).sum(-1)
        least = self._uniform(len(given)).log() + now - log_odds
        proposed = proposed.replayed(self.model, self.settings, history, first, least)
        accept: Bool[Tensor, "N"] = torch.where(late, proposed.log_likelihood, 0.0).sum(-1) > least
        return given.where(accept, proposed)

    def _segment(self, history: History, count: int) -> Int[Tensor, "count"]:
        """A late pushed segment for each particle; half of the time the last."""
        moving = history.moving()[-self.settings.lag :]
        place = (self._uniform(count) * len(moving)).long().clamp_max(len(moving) - 1)
        return torch.where(self._uniform(count) < 0.5, moving[-1], moving[place])

    def _uniform(self, count: int) -> Float[Tensor, "count"]:
        return torch.rand(count, generator=self.generator, dtype=torch.float64)

    def _normal(self, shape: Sequence[int]) -> Tensor:
        return torch.randn(tuple(shape), generator=self.generator, dtype=torch.float64)


def start_density(
    starts: Float[Tensor, "N D"], about: Float[Tensor, "Q D"], scale: Float[Tensor, "3"]
) -> Float[Tensor, "N"]:
    """Log-density, up to a constant, of poses drawn about others with normal deviations `scale`; each rests as it."""
    parts = [_density(some, about, scale) for some in starts.split(max(1, _AT_ONCE // max(1, len(about))))]
    return torch.cat(parts) if parts else starts.new_zeros(0)


def _density(
    starts: Float[Tensor, "n D"], about: Float[Tensor, "Q D"], scale: Float[Tensor, "3"]
) -> Float[Tensor, "n"]:
    x, y, yaw = (starts[:, None, axis] - about[:, axis] for axis in range(3))
    each = (x / scale[0]).square_().add_((y / scale[1]).square_()).add_((wrap(yaw) / scale[2]).square_()).mul_(-0.5)
    if about.shape[1] > 3:
        each.masked_fill_((starts[:, None, 3:] != about[:, 3:]).any(-1), -_FAR)  # other resting poses
    return each.logsumexp(-1) - scale.log().sum()
