"""Islands: populations that go on by themselves, whose mixture is the belief."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.bootstrap_filter import SHOWN, BootstrapFilter
from rumi.belief.frictions import frictions_of
from rumi.belief.island_filter import IslandBelief, IslandFilter, islands_of
from rumi.belief.particles import PoseBelief
from rumi.belief.prior import PosePrior
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator
from sdf import se3
from sdf.object_model import box_model
from sensors.observation import Observation
from tests.fixtures.box_in_space import begin, felt_by, follow, towards


def make(kind, box, prior, particles: int, islands: int):
    own = {"unseen_particles": particles, "islands": islands, "exchanged": 0.0, "evidence_power": 0.0}
    return follow(box, prior, kind, **own)


def touches(box, prior):
    truth = se3.from_planar(torch.tensor([0.01, 0.005, 0.0])) @ prior.ways[1]
    return [felt_by(box, truth, towards(x)) for x in (-0.10, -0.055, -0.054)]


def test_one_island_is_the_bootstrap_filter(box, prior):
    alone, one = (make(kind, box, prior, 200, 1) for kind in (BootstrapFilter, IslandFilter))
    found = []
    for followed in (alone, one):
        belief, memory = begin(followed, prior)
        for number, reading in enumerate(touches(box, prior)):
            belief, memory, _ = followed(belief, memory, reading, generator=generator(number))
        found.append((belief, memory))
    torch.testing.assert_close(found[1][0].world_T_object, found[0][0].world_T_object, atol=1e-6, rtol=0)
    torch.testing.assert_close(found[1][0].log_weights, found[0][0].log_weights)
    assert torch.equal(found[1][1].points, found[0][1].points)
    assert one.log_chance(found[1][0]) == alone.log_chance(found[0][0])


def test_islands_share_the_particles_and_stay_apart(box, prior):
    followed = make(IslandFilter, box, prior, 600, 3)
    belief, memory = begin(followed, prior)
    assert [len(island.every) for island in islands_of(belief)] == [200, 200, 200]
    lone = islands_of(belief)
    for number, reading in enumerate(touches(box, prior)):
        random = generator(number)
        lone = [BootstrapFilter.forward(followed, own, memory, reading, generator=random)[0] for own in lone]
        belief, memory, info = followed(belief, memory, reading, generator=generator(number))
        assert bool(info.moved) or not bool(reading.in_contact.any())
    assert len(belief.world_T_object) <= SHOWN
    for island, own in zip(islands_of(belief), lone, strict=True):
        assert torch.equal(island.every.pose, own.every.pose)
    # each has the same share of what is shown, where it has its own poses
    sizes = [len(own.log_weights) for own in lone]
    shares = [part.exp().sum() for part in belief.log_weights.split(sizes)]
    torch.testing.assert_close(torch.stack(shares), torch.full((3,), 1.0 / 3.0))
    together = torch.cat([own.world_T_object for own in lone])
    torch.testing.assert_close(belief.world_T_object, together, atol=1e-6, rtol=0)


def test_what_an_island_missed_comes_back_from_the_others_where_a_touch_tells(box, prior):
    """Two populations know the place, one is sure of another a hand's breadth aside; by itself it stays there."""
    truth = se3.from_planar(torch.tensor([0.01, 0.005, 0.0])) @ prior.ways[1]
    shares = []
    for exchanged in (0.0, 0.1):
        followed = follow(box, prior, IslandFilter, unseen_particles=600, islands=3, exchanged=exchanged)
        belief, memory = begin(followed, prior)
        parts = []
        for number, island in enumerate(islands_of(belief)):
            poses, random = island.every.poses.clone(), torch.Generator().manual_seed(number)
            spread = torch.randn(len(poses), 3, generator=random, dtype=torch.float64)
            poses[:, -1, :3] = 0.001 * spread + torch.tensor([0.01, 0.005 + 0.06 * (number == 2), 0.0])
            poses[:, -1, 3] = 1.0
            now = replace(island.every, poses=poses, apart=False)
            like = (island.world_T_attached, island.log_weights)
            parts.append(followed.belief_of(now, island.every_log_weight, *like))
        belief = followed.mixture(parts)
        for number, x in enumerate((-0.055, -0.054)):
            reading = felt_by(box, truth, towards(x))
            belief, memory, _ = followed(belief, memory, reading, generator=generator(number))
        last = islands_of(belief)[2].every
        shares.append(float(((last.pose[:, :2] - torch.tensor([0.01, 0.005])).norm(dim=-1) < 0.015).double().mean()))
    assert shares[0] < 0.2 and shares[1] > 0.5


def test_a_box_stands_firmly_and_a_stick_on_its_end_is_soon_toppled(box, prior):
    stick = box_model((0.02, 0.021, 0.2), spacing=0.003)
    upright = PosePrior.of((0.0, 0.0), 0.02, stick.exact.bounds, ("z",))
    firm, unsteady = (make(IslandFilter, *one, 90, 3).model for one in ((box, prior), (stick, upright)))
    assert not firm.unsteady and unsteady.unsteady


@pytest.mark.parametrize(("size", "noise"), [((0.1, 0.08, 0.06), 5.0), ((0.02, 0.021, 0.2), 3.5)])
def test_what_is_soon_toppled_moves_with_less_noise_where_nothing_else_is_asked_for(size, noise):
    some = box_model(size, spacing=0.003)
    ways = PosePrior.of((0.0, 0.0), 0.02, some.exact.bounds, ("z",)).ways
    for asked, given in ((None, noise), (2.0, 2.0)):
        made = ToppledObject.of(
            some.sdf, GripperShape(), ways, some.symmetries, spacing_m=0.012, pad_spacing_m=0.006, wide=asked
        )
        assert made.wide == given


def test_what_islands_disagree_on_is_not_known(box, prior):
    """Two populations sure of different places: half of the belief is at each."""
    followed = make(IslandFilter, box, prior, 80, 2)
    belief, _ = begin(followed, prior)
    parts = []
    for island, x in zip(islands_of(belief), (0.0, 0.05), strict=True):
        still = island.every.poses.clone()
        still[:, -1, :2] = torch.tensor([x, 0.0])
        now = replace(island.every, poses=still)
        parts.append(followed.belief_of(now, island.every_log_weight, island.world_T_attached, island.log_weights))
    mixed = followed.mixture(parts)
    near = (mixed.world_T_object[:, 0, 3] < 0.025).float() @ mixed.log_weights.exp()
    torch.testing.assert_close(near, torch.tensor(0.5), atol=1e-5, rtol=0)


def test_planners_are_told_how_particles_of_all_islands_slid(box, prior):
    followed = make(IslandFilter, box, prior, 90, 3)
    belief, memory = begin(followed, prior)
    for number, reading in enumerate(touches(box, prior)):
        belief, memory, _ = followed(belief, memory, reading, generator=generator(number))
    told = frictions_of(belief, followed.own)
    assert len(told.tool) == len(belief.log_weights) and bool(torch.isfinite(told.tool).all())
    own = torch.cat([frictions_of(island, followed.own).tool for island in islands_of(belief)])
    torch.testing.assert_close(told.tool, own)


def test_a_jump_begins_every_island_anew(box, prior):
    followed = make(IslandFilter, box, prior, 90, 3)
    belief, memory = begin(followed, prior)
    readings = touches(box, prior)
    for number, reading in enumerate(readings):
        belief, memory, _ = followed(belief, memory, reading, generator=generator(number))
    again = followed.begun_again(belief, readings[-1], generator=generator(5))
    assert isinstance(again, IslandBelief) and len(again.islands) == 3
    assert all(island.every.apart for island in again.islands)
    assert bool(torch.isfinite(again.world_T_object).all())


def test_islands_are_weighed_by_a_power_of_their_evidence(box, prior):
    followed = follow(box, prior, IslandFilter, unseen_particles=90, islands=3, exchanged=0.0, evidence_power=0.25)
    belief, _ = begin(followed, prior)
    told = (-10.0, -10.0 + 4.0 * math.log(2.0), -10.0 + 4.0 * math.log(5.0))
    parts = []
    for island, nats in zip(islands_of(belief), told, strict=True):
        now, log_weights = followed.particles_of(island)
        own = replace(now, log_evidence=nats)
        parts.append(followed.belief_of(own, log_weights, island.world_T_attached, island.log_weights))
    mixed = followed.mixture(parts)
    shares = [part.exp().sum() for part in mixed.log_weights.split([len(part.log_weights) for part in parts])]
    torch.testing.assert_close(torch.stack(shares), torch.tensor([0.125, 0.25, 0.625]))
    exchanging = follow(box, prior, IslandFilter, unseen_particles=90, islands=3, exchanged=0.1, evidence_power=0.25)
    assert exchanging.log_shares(parts).exp().tolist() == pytest.approx([1.0 / 3.0] * 3)
    with pytest.raises(ValueError, match=r"evidence_power in \[0, 1\]"):
        replace(followed.own, evidence_power=1.5)


def test_what_leans_is_weighed_over_all_islands(box, prior):
    followed = follow(box, prior, IslandFilter, unseen_particles=90, islands=3, exchanged=0.0)
    belief, _ = begin(followed, prior)
    assert followed.leaning(belief, 0.0) == 0.0
    tilts = (0.5, 2.0, 2.0)  # degrees, an island each
    parts = []
    for island, tilt in zip(islands_of(belief), tilts, strict=True):
        now, log_weights = followed.particles_of(island)
        poses = now.poses.clone()
        poses[: len(now) * 4 // 5, -1, 4], poses[:, -1, 5] = 0.0, math.radians(tilt)
        parts.append(
            followed.belief_of(replace(now, poses=poses), log_weights, island.world_T_attached, island.log_weights)
        )
    leaning = followed.mixture(parts)
    assert followed.leaning(leaning, 0.0) == pytest.approx(0.8)
    assert followed.leaning(leaning, math.radians(1.0)) == pytest.approx(0.8 * 2 / 3)


def test_another_belief_is_refused(box, prior):
    followed = make(IslandFilter, box, prior, 20, 2)
    other = PoseBelief.uniform(prior.spread_poses(5, generator=generator(0)))
    with pytest.raises(TypeError, match="belief of an island filter"):
        followed(other, Observation.empty(), touches(box, prior)[0], generator=generator(0))
    with pytest.raises(ValueError, match="islands to be 1 or more"):
        PoseTrajectorySettings(islands=0)


@pytest.mark.parametrize("exchanged", [0.0, 0.1])
def test_islands_have_as_many_particles_as_each_needs(box, prior, exchanged):
    """One is narrow, one wide; their shares in the belief do not go by how many particles they have."""
    followed = follow(
        box,
        prior,
        IslandFilter,
        unseen_particles=6000,
        fewest_particles=90,
        sampling_error=0.05,
        islands=3,
        exchanged=exchanged,
    )
    belief, memory = begin(followed, prior)
    parts = []
    for number, island in enumerate(islands_of(belief)):
        poses, random = island.every.poses.clone(), torch.Generator().manual_seed(number)
        spread = (0.0005, 0.002, 0.01)[number] * torch.tensor([1.0, 1.0, 10.0])
        poses[:, -1, :3] = spread * torch.randn(len(poses), 3, generator=random, dtype=torch.float64)
        poses[:, -1, :2] += torch.tensor([0.01, 0.005])
        poses[:, -1, 3] = 1.0
        now = replace(island.every, poses=poses, apart=False)
        parts.append(followed.belief_of(now, island.every_log_weight, island.world_T_attached, island.log_weights))
    belief = followed.mixture(parts)
    for number, reading in enumerate(touches(box, prior)[1:]):
        belief, memory, _ = followed(belief, memory, reading, generator=generator(number))
    many = [len(island.every) for island in islands_of(belief)]
    assert all(30 <= own < 2000 for own in many) and len(set(many)) > 1
    sizes = [len(island.log_weights) for island in islands_of(belief)]
    shares = torch.stack([part.exp().sum() for part in belief.log_weights.split(sizes)])
    wanted = followed.log_shares(islands_of(belief)).exp()
    torch.testing.assert_close(shares.double(), wanted, atol=1e-5, rtol=0)
    assert bool(belief.world_T_object.isfinite().all())
