"""The particle belief."""

import math

import pytest
import torch

from rumi.belief import particles
from rumi.belief.particles import PoseBelief
from rumi.errors import DegenerateBeliefError
from rumi.weights import boltzmann
from sdf import se3

F64 = torch.float64


def belief(count=6, batch=(), seed=0):
    random = torch.Generator().manual_seed(seed)
    poses = se3.exp(0.2 * torch.randn(*batch, count, 6, generator=random, dtype=F64))
    return PoseBelief.uniform(poses).reweighted(torch.randn(*batch, count, generator=random, dtype=F64))


def test_no_particles_are_refused():
    with pytest.raises(ValueError, match="at least one particle"):
        PoseBelief.uniform(torch.zeros(0, 4, 4))


@pytest.mark.parametrize(
    "log_weights", [[-1000.0, -1001.0, -1006.0], [0.0, -math.inf, -math.inf], [1e5, 1e5, 1e5], [-690.0, 0.0, 690.0]]
)
def test_extreme_weights_stay_normalised(log_weights):
    weights = belief(3).reweighted(torch.tensor(log_weights, dtype=F64)).weights
    assert torch.isfinite(weights).all()
    assert float(weights.sum()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "log_weights", [[-math.inf] * 3, [math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0], [-math.inf, math.nan, -math.inf]]
)
def test_weights_that_are_none_are_refused(log_weights):
    with pytest.raises(DegenerateBeliefError, match="finite log-weight"):
        belief(3).reweighted(torch.tensor(log_weights, dtype=F64))


def test_one_lost_scene_of_a_batch_is_refused():
    with pytest.raises(DegenerateBeliefError):
        belief(3, (2,)).reweighted(torch.tensor([[0.0, 0.0, 0.0], [-math.inf] * 3], dtype=F64))


def test_large_discrepancies_that_differ_little_are_told_apart_in_float32():
    cost = torch.tensor([208034.0, 208033.984375, 208033.96875])
    found = torch.softmax(boltzmann(cost, 1000.0), -1)
    wanted = torch.softmax(-1000.0 * cost.double(), -1)
    torch.testing.assert_close(found.double(), wanted, rtol=1e-5, atol=0)


def test_an_infinite_discrepancy_has_no_weight():
    log = boltzmann(torch.tensor([3.0, math.inf, 4.0]), 2.0)
    assert log.tolist() == [0.0, -math.inf, -2.0]


def test_ten_thousand_motions_leave_a_rotation(generator):
    motions = se3.exp(0.1 * torch.randn(100, 6, generator=generator))
    start = PoseBelief.uniform(se3.identity((1,)))
    for k in range(10_000):
        start = start.moved(motions[k % 100])
    rotation = start.world_T_attached[:3, :3].double()
    assert float((rotation.mT @ rotation - torch.eye(3, dtype=F64)).abs().max()) < 1e-6


def test_golden_large_discrepancies(golden):
    case = golden("rumi.weights_large")
    discrepancy = torch.tensor(case["inputs"]["l"], dtype=F64)
    weights = belief(3).reweighted(-case["inputs"]["lam"] * discrepancy).weights
    torch.testing.assert_close(weights, torch.tensor(case["expected"]["w"], dtype=F64), atol=1e-14, rtol=0)


def test_a_motion_moves_every_particle_in_the_world_and_none_in_the_attached_frame():
    start = belief(batch=(2,))
    motion = se3.exp(torch.randn(2, 6, generator=torch.Generator().manual_seed(1), dtype=F64))
    moved = start.moved(motion)
    torch.testing.assert_close(moved.world_T_object, motion[:, None] @ start.world_T_object)
    assert moved.attached_T_object is start.attached_T_object


def test_mode_is_the_mean_of_the_heaviest_cluster_not_the_heaviest_particle():
    planar = torch.tensor([[0.0, 0.0, 0.0], [0.002, 0.0, 0.0], [0.001, 0.001, 0.0], [0.3, 0.0, 0.0]], dtype=F64)
    start = PoseBelief.uniform(se3.from_planar(planar)).reweighted(
        torch.tensor([0.25, 0.2, 0.15, 0.4], dtype=F64).log()
    )
    expected = (0.25 * planar[0] + 0.2 * planar[1] + 0.15 * planar[2]) / 0.6
    torch.testing.assert_close(se3.to_planar(start.mode()), expected, atol=1e-9, rtol=0)


def test_resampling_gathers_poses_and_discrepancies():
    start = belief(4)
    index = torch.tensor([2, 2, 0, 3])
    fresh = start.resampled(index)
    torch.testing.assert_close(fresh.attached_T_object, start.attached_T_object[index])
    torch.testing.assert_close(fresh.weights, torch.full((4,), 0.25, dtype=F64))


def test_one_particle_and_coincident_particles():
    one = belief(1)
    torch.testing.assert_close(one.mode(), one.world_T_object[0], atol=1e-9, rtol=0)
    same = PoseBelief.uniform(one.attached_T_object.expand(8, 4, 4))
    torch.testing.assert_close(same.mean(), one.world_T_object[0], atol=1e-9, rtol=0)


def test_to_changes_dtype():
    assert belief().to(dtype=torch.float32).log_weights.dtype == torch.float32


@pytest.mark.parametrize("radii", [(0.05, 0.3), (0.0, 0.0), (0.2, 3.0), (0.1, math.pi), (10.0, 4.0)])
@pytest.mark.parametrize("away_m, kind", [(0.0, F64), (0.0, torch.float32), (1e4, F64)])
def test_the_mode_holds_all_within_both_radii_of_its_particle(radii, away_m, kind):
    start = belief(count=40)
    away = se3.make(torch.eye(3, dtype=F64), torch.tensor([away_m, -away_m, 0.0], dtype=F64))
    start = start.moved(away).to(dtype=kind)
    poses = start.world_T_object
    metres, radians = se3.distance(poses[:, None], poses[None])
    near = (metres <= radii[0] + 1e-9) & (radians <= radii[1] + 1e-6)
    near = near.to(kind) * start.weights
    best = near[(near.sum(-1) + 1e-6 * start.weights).argmax()]
    torch.testing.assert_close(start.mode(*radii), se3.mean(poses, best / best.sum()), rtol=0, atol=1e-6)


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("kind", ["random", "equal"])
def test_the_mode_by_chunks_is_the_mode(batch, kind, monkeypatch):
    start = belief(23, batch)
    if kind == "equal":  # every particle ties with every other
        start = PoseBelief.uniform(start.attached_T_object[..., :1, :, :].expand(*batch, 23, 4, 4))
    whole = start.mode(0.3, 0.3)
    monkeypatch.setattr(particles, "CHUNK_BYTES", 1)
    torch.testing.assert_close(start.mode(0.3, 0.3), whole, rtol=0, atol=0)
