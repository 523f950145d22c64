"""Systematic resampling."""

import pytest
import torch

from rumi.resampling import resample_systematic, systematic

F64 = torch.float64


def test_golden(golden):
    case = golden("pf.systematic")
    weights = torch.tensor(case["inputs"]["w"], dtype=F64)
    assert systematic(weights.log(), torch.tensor(case["inputs"]["u0"])).tolist() == case["expected"]["indices"]


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_counts_are_floor_or_ceil_of_the_expected(dtype):
    random = torch.Generator().manual_seed(0)
    for _ in range(20):
        log_weights = 3 * torch.randn(100, generator=random, dtype=dtype)
        counts = torch.bincount(systematic(log_weights, torch.rand((), generator=random)), minlength=100)
        expected = 100 * torch.softmax(log_weights.double(), -1)
        assert ((counts - expected).abs() < 1 + 1e-6).all()


def test_mean_count_is_unbiased():
    log_weights = torch.tensor([0.5, 0.25, 0.15, 0.1], dtype=F64).log()
    offsets = (torch.arange(1000, dtype=F64) + 0.5) / 1000
    counts = sum(torch.bincount(systematic(log_weights, u), minlength=4) for u in offsets)
    torch.testing.assert_close(counts.double() / 4000, log_weights.exp(), atol=1e-3, rtol=0)


def test_a_certain_particle_takes_all_and_a_dead_one_none():
    log_weights = torch.tensor([-float("inf"), 0.0, -float("inf")])
    assert systematic(log_weights, torch.tensor(0.999999)).tolist() == [1, 1, 1]


def test_rows_draw_from_their_own_generators():
    log_weights = torch.randn(3, 50, generator=torch.Generator().manual_seed(1))
    rows = [torch.Generator().manual_seed(s) for s in (10, 11, 12)]
    together = resample_systematic(log_weights, generator=rows)
    alone = resample_systematic(log_weights[1], generator=torch.Generator().manual_seed(11))
    assert together[1].tolist() == alone.tolist()
