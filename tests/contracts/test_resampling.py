"""Contract of systematic resampling, of any number of teeth, and of beliefs with fewer particles."""

import math

import pytest
import torch

from rumi.belief.particles import PoseBelief, subsample
from rumi.resampling import resample_systematic, systematic
from rumi.weights import effective_sample_size
from sdf import se3

F64 = torch.float64
COUNTS = pytest.mark.parametrize("count", [None, 1, 37, 250])


def test_golden(golden):
    case = golden("pf.systematic")
    weights = torch.tensor(case["inputs"]["w"], dtype=F64)
    assert systematic(weights.log(), torch.tensor(case["inputs"]["u0"])).tolist() == case["expected"]["indices"]


@COUNTS
@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_counts_are_floor_or_ceil_of_the_expected(dtype, raw, count):
    random = torch.Generator().manual_seed(0)
    for _ in range(20):
        log_weights = 3 * torch.randn(100, generator=random, dtype=dtype)
        index = systematic(log_weights, torch.rand((), generator=random), count, raw=raw)
        assert bool((index.diff() >= 0).all())
        expected = (count or 100) * torch.softmax(log_weights.double(), -1)
        assert ((torch.bincount(index, minlength=100) - expected).abs() < 1 + 1e-6).all()


@COUNTS
def test_weights_need_not_be_normalised(count):
    log_weights = torch.randn(100, generator=torch.Generator().manual_seed(0), dtype=F64)
    assert torch.equal(systematic(log_weights + 300.0, 0.3, count), systematic(log_weights, 0.3, count))


def test_mean_count_is_unbiased():
    log_weights = torch.tensor([0.5, 0.25, 0.15, 0.1], dtype=F64).log()
    offsets = (torch.arange(1000, dtype=F64) + 0.5) / 1000
    counts = sum(torch.bincount(systematic(log_weights, u), minlength=4) for u in offsets)
    torch.testing.assert_close(counts.double() / 4000, log_weights.exp(), atol=1e-3, rtol=0)


@COUNTS
@pytest.mark.parametrize("raw", [False, True])
def test_a_certain_particle_takes_all_and_a_dead_one_none(raw, count):
    log_weights = torch.tensor([-math.inf, 0.0, -math.inf])
    assert set(systematic(log_weights, torch.tensor(0.999999), count, raw=raw).tolist()) == {1}


def test_raw_weights_give_a_tooth_on_a_border_to_the_particle_before():
    """Of four equal shares and two teeth in the middles of halves, which are borders."""
    log_weights = torch.zeros(4, dtype=F64)
    assert systematic(log_weights, 0.5, 2).tolist() == [1, 3]
    assert systematic(log_weights, 0.5, 2, raw=True).tolist() == [0, 2]


@COUNTS
def test_rows_draw_from_their_own_generators(count):
    log_weights = torch.randn(3, 50, generator=torch.Generator().manual_seed(1))
    rows = [torch.Generator().manual_seed(s) for s in (10, 11, 12)]
    together = resample_systematic(log_weights, count, generator=rows)
    alone = resample_systematic(log_weights[1], count, generator=torch.Generator().manual_seed(11))
    assert together.shape == (3, count or 50) and together[1].tolist() == alone.tolist()


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("count", [1, 3, 500, 100_000])
def test_the_effective_sample_size_is_between_one_and_the_number_of_particles(count, dtype):
    even = torch.zeros(count, dtype=dtype)
    for log in (even, even.log_softmax(-1), even - 700.0):
        assert count * (1.0 - 1e-9) <= float(effective_sample_size(log)) <= count
    certain = torch.full((count,), -math.inf, dtype=dtype)
    certain[-1] = 3.0
    assert float(effective_sample_size(certain)) == 1.0
    log = 5.0 * torch.randn(count, generator=torch.Generator().manual_seed(0), dtype=F64)
    weights = log.softmax(-1)
    found = effective_sample_size(log.to(dtype))
    assert found.dtype == dtype and float(found) == pytest.approx(float(1.0 / weights.square().sum()), rel=1e-4)


def belief(count: int = 100, spread: float = 1.0) -> PoseBelief:
    random = torch.Generator().manual_seed(0)
    uniform = PoseBelief.uniform(se3.from_planar(torch.randn(count, 3, generator=random, dtype=F64)))
    return uniform.reweighted(spread * torch.randn(count, generator=random, dtype=F64))


def test_a_subsample_keeps_the_mean():
    whole = belief(2000)
    fewer = subsample(whole, 200)
    assert len(fewer.log_weights) <= 200 and float(fewer.weights.sum()) == pytest.approx(1.0)
    means = [(one.weights[:, None] * one.world_T_object[:, :3, 3]).sum(0) for one in (fewer, whole)]
    torch.testing.assert_close(*means, atol=0.1, rtol=0)


def test_heavy_particles_of_a_subsample_stay_heavy():
    whole = belief(10).reweighted(torch.tensor([0.0] * 9 + [3.0], dtype=F64))
    fewer = subsample(whole, 5)
    torch.testing.assert_close(fewer.world_T_object[fewer.weights.argmax()], whole.world_T_object[9])
    # three of the five teeth fall on a share of e^3 / (9 + e^3)
    assert float(fewer.weights.max()) == pytest.approx(0.6)


def test_a_subsample_of_as_many_is_the_belief():
    whole = belief(7)
    assert subsample(whole, 7) is whole
    assert len(subsample(whole, 1).log_weights) == 1
    with pytest.raises(ValueError, match="count"):
        subsample(whole, 0)
