"""What holds of every container of tensors: beliefs, observations, readings, evidence, episodes."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils.data import default_collate

from rumi.belief.contact_evidence import ContactPointEvidence, ContactSignalEvidence
from rumi.belief.particles import PoseBelief
from rumi.fields.information import information_field
from rumi.information.entropy import weights_entropy
from rumi.runs.dataset import Episode, collate_episodes
from rumi.task import StepResult
from sdf import se3
from sdf.containers import collate, detach, index, stack
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box
from sensors.contact_reading import ContactReading, WrenchTouch
from sensors.discrepancy import Discrepancy
from sensors.evidence import EvidenceSet, SemanticPoints
from sensors.log.reader import Taken
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics
from sensors.touch.contact_model import ContactModel

GRID = GridSDF.from_sdf(Box((0.03, 0.04, 0.05)), 0.01, outer=0.06)
DISCREPANCY, MODEL = Discrepancy(GRID, 0.1), ContactModel(0.9, 0.1, 20.0)


def draws(*shape: int, seed: int = 0) -> Tensor:
    return 0.05 * torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def poses(count: int, seed: int = 0) -> Tensor:
    return se3.from_planar(draws(count, 3, seed=seed), 0.0)


def observation(size: int) -> Observation:
    parts = [Observation.of(draws(size, 3, seed=kind), kind) for kind in (Semantics.FREE, Semantics.SURFACE)]
    return concatenate(parts)


def belief(size: int) -> PoseBelief:
    found = PoseBelief.uniform(poses(size)).reweighted(draws(size, seed=1))
    return replace(found, discrepancy=draws(size, seed=2).abs())


def reading(size: int, kind: type[Reading] = Reading, **more: Any) -> Reading:
    seen = observation(size)
    return kind(
        seen,
        torch.arange(len(seen)) % size,
        poses(size),
        torch.arange(size) % 2 == 0,
        poses(size, 1),
        draws(3),
        torch.zeros(()),
        float(size),
        {"current": draws(size, 2)},
        **more,
    )


def contact_reading(size: int) -> ContactReading:
    touch = WrenchTouch(draws(2, 3), draws(2, 3), draws(2).abs(), draws(2).abs(), torch.zeros(2).long())
    return reading(size, ContactReading, wrench=touch, signals=torch.ones(size, dtype=torch.bool))


def contact_points(size: int) -> ContactPointEvidence:
    return ContactPointEvidence(GRID, draws(4, 3), draws(4, 3, seed=1), draws(4).abs(), draws(4).abs(), 0.1)


def episode(size: int) -> Episode:
    first = Taken(reading(1), None, torch.eye(4), None)
    return Episode.of([first, *(Taken(reading(k + 1), draws(3), torch.eye(4), None) for k in range(size))])


class Member(NamedTuple):
    make: Callable[[int], Any]
    ragged: bool = True
    collate: Callable[[Any], Any] = collate


MEMBERS = {
    "Observation": Member(observation),
    "Reading": Member(reading),
    "ContactReading": Member(contact_reading),
    "StepResult": Member(lambda size: StepResult(reading(size), torch.eye(4))),
    "PoseBelief": Member(belief),
    "PoseBelief with evidence": Member(lambda size: replace(belief(size), evidence=EvidenceSet((contact_points(1),)))),
    "SemanticPoints": Member(lambda size: SemanticPoints(observation(size), DISCREPANCY)),
    "ContactPointEvidence": Member(contact_points, ragged=False),
    "ContactSignalEvidence": Member(lambda size: ContactSignalEvidence(GRID, draws(2, 5, 3), MODEL), ragged=False),
    "Episode": Member(episode, collate=collate_episodes),
}
EACH = pytest.mark.parametrize("member", MEMBERS.values(), ids=MEMBERS)


def plain(leaf):
    return torch.nan_to_num(torch.as_tensor(leaf, dtype=torch.float64), nan=-1.0)  # a sensor that gave nothing


def same(a, b):
    leaves = zip(pytree.tree_leaves(a), pytree.tree_leaves(b), strict=True)
    return all(torch.equal(plain(x), plain(y)) for x, y in leaves)


@EACH
def test_a_row_of_a_stack_is_the_item(member):
    one, other = member.make(3), pytree.tree_map_only(Tensor, lambda leaf: leaf.clone(), member.make(3))
    together = stack([one, other])
    assert type(together) is type(one)
    assert same(index(together, 0), one) and same(index(together, 1), other)
    assert same(detach(together), together)


@EACH
def test_what_differs_in_size_is_padded(member):
    items = [member.make(size) for size in ((2, 4) if member.ragged else (2, 2))]
    together = member.collate(items)
    for leaf in pytree.tree_leaves(together):
        assert leaf.shape[0] == 2
    if member.collate is collate:
        assert same(default_collate(items), together)
        assert same(index(together, 1), items[1]), "the longest is as it was"


@EACH
def test_it_maps_and_comes_back(member):
    item = member.make(3)
    leaves, spec = pytree.tree_flatten(item)
    assert all(isinstance(leaf, Tensor | float) for leaf in leaves)
    assert same(pytree.tree_unflatten(leaves, spec), item)
    assert len(pytree.tree_flatten_with_path(item)[0]) == len(leaves)


def test_padding_changes_no_result():
    small, large = belief(3), belief(5)
    both = collate([small, large])
    assert torch.equal(both.weights[0, 3:], torch.zeros(2))
    assert torch.allclose(both.ess()[0], small.ess())
    assert torch.allclose(both.mean()[0], small.mean(), atol=1e-6)
    assert torch.allclose(both.mode()[0], small.mode(), atol=1e-6)
    assert torch.allclose(weights_entropy(both.log_weights)[0], weights_entropy(small.log_weights), atol=1e-6)
    where = draws(6, 3)
    field = information_field(GRID, both.world_T_object, both.log_weights, where)
    alone = information_field(GRID, small.world_T_object, small.log_weights, where)
    assert torch.allclose(field.information[0], alone.information, atol=1e-6)
    seen = collate([observation(2), observation(4)])
    assert torch.allclose(DISCREPANCY(poses(3).expand(2, 3, 4, 4), seen)[0], DISCREPANCY(poses(3), observation(2)))


def test_beliefs_go_through_vmap():
    both = stack([belief(4), belief(4)])
    assert torch.allclose(torch.func.vmap(lambda one: one.mean())(both), both.mean())
    slope = torch.func.grad(lambda one: one.mean()[0, 3])(belief(4))
    assert isinstance(slope, PoseBelief) and slope.log_weights.abs().sum() > 0


def test_a_batch_of_readings_is_one():
    both = collate([reading(2), reading(4)])
    assert both.measurements["current"].shape == (2, 4, 2) and both.stamp.tolist() == [2.0, 4.0]
    replace(both)  # whatever is checked of a reading holds of it
    with pytest.raises(ValueError, match="Expected 4 measurements"):
        replace(both, measurements={"current": torch.zeros(2, 3)})


def test_padding_of_an_episode_repeats_its_last_step():
    both = collate_episodes([episode(1), episode(3)])
    assert both.valid.tolist() == [[True, True, False, False], [True] * 4]
    assert torch.equal(both.control[0, 1], both.control[0, 3]) and both.truth.shape == (2, 4, 4, 4)
    assert both.reading.observation.points.shape[:2] == (2, 4) and math.isfinite(float(both.control.sum()))
