"""Other sizes of what may topple: each a population, asked again with others where it would raise an alarm."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from rumi.belief.island_filter import IslandFilter, islands_of
from rumi.belief.island_rivals import POWER, begun, doubted, log_ratios
from rumi.belief.rival_filters import FURTHER, NO_FAULT, RIVALS, SIZES, followed, is_asked_again, left, log_none
from rumi.seeding import generator
from rumi.sim.reshaped import resized
from sdf.primitives import Box
from tests.fixtures.box_in_space import begin, felt_by, follow

DOUBLE = {"dtype": torch.float64}


@pytest.fixture(scope="module")
def pose_filter(box, prior) -> IslandFilter:
    return follow(box, prior, IslandFilter, unseen_particles=1500, islands=3)


def touches(box, prior, factor: float) -> list:
    """What is felt of a box in another size: its four sides, twice, each until it is met."""
    other = SimpleNamespace(exact=resized(box.exact, factor))
    there = prior.ways[1].clone()
    there[:3, 3] *= factor
    off = 0.25 - torch.linspace(0.0, 0.22, 111)
    found = []
    for number in range(8):
        yaw = 0.5 * math.pi * (number % 4)
        path = torch.stack((-math.cos(yaw) * off, -math.sin(yaw) * off, torch.full_like(off, yaw), 0.0 * off), -1)
        path[:, 3] = 0.04 if number < 4 else 0.07
        met = int(felt_by(other, there, path).in_contact.nonzero()[0])
        found.append(felt_by(other, there, path[met - 7 : met + 1]))
    return found


def after(pose_filter, readings, seed=1):
    """The belief and the rivals after some readings."""
    belief, memory = begin(pose_filter, pose_filter.prior)
    rivals, random = begun(pose_filter, generator(seed)), generator(seed + 1)
    for reading in readings:
        belief, memory, _ = pose_filter(belief, memory, reading, generator=random)
        rivals = followed(rivals, reading, random)
    return belief, rivals


def test_rivals_are_a_population_of_each_size(box, pose_filter):
    rivals = begun(pose_filter, generator(1))
    assert [rival.name for rival in rivals] == ["another size"] * len(SIZES)
    assert [len(rival.now) for rival in rivals] == [pose_filter.own.unseen_particles] * len(SIZES)
    heights = torch.stack(
        [rival.pose_filter.model.rests.height_m / pose_filter.model.rests.height_m for rival in rivals]
    )
    torch.testing.assert_close(heights, torch.tensor(SIZES, **DOUBLE)[:, None].expand_as(heights))
    exact = pose_filter.supposing(model=replace(pose_filter.model, sdf=resized(box.exact, 1.0)))
    assert begun(exact, generator(1)) == () == left(begun(exact, generator(1)), 0.0)
    assert not is_asked_again(rivals) and all(rival.log_evidence == -math.log(len(SIZES)) for rival in rivals)


def test_touches_of_all_sides_tell_a_size(box, prior, pose_filter):
    belief, rivals = after(pose_filter, touches(box, prior, SIZES[0]))
    found = log_ratios(rivals, pose_filter.log_evidence(belief))
    assert found.keys() == set(RIVALS) and found["another size"] > 3.0
    smaller, larger = rivals[:2], rivals[2:]
    assert min(rival.log_evidence for rival in smaller) > max(rival.log_evidence for rival in larger) + 3.0
    belief, rivals = after(pose_filter, touches(box, prior, 1.0))
    assert log_ratios(rivals, pose_filter.log_evidence(belief))["another size"] < 1.0


def test_the_likeliest_size_and_no_fault_are_asked_again_by_others(box, prior, pose_filter):
    readings = touches(box, prior, SIZES[0])
    belief, rivals = after(pose_filter, readings)
    again = doubted(pose_filter, rivals, readings, generator(5))
    names = [rival.name for rival in again]
    best, islands = max(rivals, key=lambda rival: rival.log_evidence), pose_filter.own.islands
    assert names.count(NO_FAULT) == FURTHER and names.count("another size") == len(SIZES) - 1 + islands
    assert is_asked_again(again) and all(rival is not best for rival in again)
    alike = [rival for rival in again if rival.pose_filter is best.pose_filter]
    assert len(alike) == islands
    assert sum(math.exp(rival.log_share) for rival in alike) == pytest.approx(1.0 / len(SIZES))
    none = pose_filter.log_evidence(belief)
    copies = [rival.log_evidence for rival in again if rival.name == NO_FAULT]
    mean = float(torch.tensor([none, *copies], **DOUBLE).logsumexp(0)) - math.log(1 + FURTHER)
    assert log_none(again, none) == pytest.approx(mean)
    own = float(torch.tensor([r.log_evidence for r in again if r.name != NO_FAULT], **DOUBLE).logsumexp(0))
    assert log_ratios(again, none)["another size"] == pytest.approx(POWER * (own - mean))
    assert not left([rival for rival in again if rival.name == NO_FAULT], mean)


def test_populations_of_a_size_are_a_belief_of_its_filter(box, prior, pose_filter):
    readings = touches(box, prior, SIZES[0])
    belief, rivals = after(pose_filter, readings)
    alike = doubted(pose_filter, rivals[:1], readings, generator(5))[FURTHER:]
    best = alike[0]
    like = belief.world_T_attached, belief.log_weights
    mixture = best.pose_filter.mixture([best.pose_filter.belief_of(one.now, one.log_weights, *like) for one in alike])
    heights = mixture.world_T_object[:, 2, 3]
    torch.testing.assert_close(
        heights, torch.full_like(heights, SIZES[0] * float(prior.ways[1][2, 3])), atol=2e-3, rtol=0
    )
    assert len(islands_of(mixture)) == pose_filter.own.islands
    went, _, _ = best.pose_filter(mixture, begin(pose_filter, prior)[1], readings[0], generator=generator(6))
    assert bool(went.log_weights.isfinite().all())


def test_an_object_in_another_size_is_the_one_that_is_made_so(box, prior, pose_filter):
    model, factor = pose_filter.model, 1.07
    larger, made = model.resized(factor), resized(box.exact, factor)
    assert isinstance(made, Box)
    poses = torch.zeros(2, 6, **DOUBLE)
    poses[:, 0], poses[:, 2], poses[:, 3], poses[:, 4], poses[:, 5] = 0.1, 0.7, 1.0, -1.0, 0.0
    poses[1, 4:] = torch.tensor([0.0, 0.3], **DOUBLE)  # one leans about its first edge
    ahead = poses.clone()
    ahead[:, :2] *= factor
    own, other = model.world_T_object(poses), larger.world_T_object(ahead)
    torch.testing.assert_close(other[:, :3, :3], own[:, :3, :3])
    torch.testing.assert_close(other[:, :3, 3], factor * own[:, :3, 3])
    places = 0.2 * torch.rand(50, 3, generator=generator(7)) - 0.1
    off = larger.sdf.distance(places) - made.distance(places)
    assert float(off.abs().max()) < 2e-3
    rests, again = model.rests, model.resized(factor).resized(1.0 / factor)
    for field in ("height_m", "centre", "spread_m"):
        torch.testing.assert_close(getattr(again.rests, field), getattr(rests, field))
    torch.testing.assert_close(again.rests.edges.change, rests.edges.change)
    assert torch.equal(larger.rests.edges.tip_rad, rests.edges.tip_rad)
    assert larger.reach_m - model.reach_m == pytest.approx(0.07 * float(box.sdf.bounds.double().abs().amax(0).norm()))
    with pytest.raises(TypeError, match="tabulated"):
        replace(model, sdf=made).resized(factor)
