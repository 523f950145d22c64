"""Replicates of an update: pooled where a belief would be sure, each by draws of its own."""

from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.replicates import pooled
from rumi.seeding import generator
from tests.test_belief.test_pose_trajectory_filter import OWN, PUSH, begin, felt_by, follow

pytestmark = pytest.mark.usefixtures("by_numba")


def test_replicates_of_an_update_are_pooled_in_equal_shares(model, monkeypatch):
    followed = follow(model, replicates=3)
    belief, memory = begin(followed)
    reading, seeds, advanced = felt_by(0 * PUSH, PUSH, model), [], PoseTrajectoryFilter.advanced
    after, _, _ = followed(belief, memory, reading, generator=generator(1))

    def elsewhere(self, now, log_weights, reading, random):
        """A replicate that is sure of other poses, by a metre for each that was made."""
        done = advanced(self, now, log_weights, reading, random)
        seeds.append(float(done.now.physics[0, 0]))
        poses = done.now.poses.clone()
        poses[..., 1] += len(seeds)
        return done._replace(now=replace(done.now, poses=poses))

    monkeypatch.setattr(PoseTrajectoryFilter, "advanced", elsewhere)
    found = pooled(followed, belief, reading, after, generator=generator(2))
    assert len(set(seeds)) == 3, "draws of their own"
    assert len(found.log_weights) == OWN.particles and float(found.log_weights.std()) == 0.0
    counts = found.world_T_object[:, 1, 3].round().long().bincount()
    assert counts.tolist() == [15, 15, 15, 15]
    kept = found.trajectories
    assert kept.history is after.trajectories.history
    again = kept.replayed(followed.model, followed.own, kept.history, torch.zeros(len(kept), dtype=torch.long))
    assert torch.equal(again.log_likelihood, kept.log_likelihood)


def test_nothing_is_pooled_where_nothing_was_told_or_asked(model):
    followed, quiet = follow(model, replicates=2), follow(model, replicates=0)
    belief, memory = begin(followed)
    reading = felt_by(0 * PUSH, PUSH, model)
    after, _, _ = followed(belief, memory, reading, generator=generator(1))
    random = generator(3)
    before = random.get_state()
    assert pooled(quiet, belief, reading, after, generator=random) is after
    assert pooled(followed, belief, reading, belief, generator=random) is belief
    assert torch.equal(random.get_state(), before)


def test_replicates_that_agree_leave_the_belief_about_as_it_was(model):
    followed = follow(model, replicates=3)
    belief, memory = begin(followed)
    reading = felt_by(0 * PUSH, PUSH, model)
    after, _, _ = followed(belief, memory, reading, generator=generator(1))
    found = pooled(followed, belief, reading, after, generator=generator(2))
    apart = (found.mean() - after.mean())[:2, 3].norm()
    assert float(apart) < 0.002 and bool(torch.isfinite(found.world_T_object).all())


@pytest.mark.parametrize(("replicates", "particles"), [(100, 60), (3, 1), (2, 2)])
def test_a_pool_has_as_many_particles_as_the_belief_had(model, replicates, particles):
    followed = follow(model, replicates=replicates, particles=particles)
    belief, memory = begin(followed)
    reading = felt_by(0 * PUSH, PUSH, model)
    after, _, _ = followed(belief, memory, reading, generator=generator(1))
    found = pooled(followed, belief, reading, after, generator=generator(2))
    assert len(found.log_weights) == particles and bool(torch.isfinite(found.world_T_object).all())
