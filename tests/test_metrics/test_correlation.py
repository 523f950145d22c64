"""Correlations against cases that are known in closed form."""

import math

import numpy as np
import pytest

from scripts.reproduce.correlation import pearson, rank_correlations, run_correlation, spearman


def test_pearson_by_hand():
    # deviations (-1, 0, 1) and (-1, 1, 0): 1 / sqrt(2 * 2)
    assert pearson([1, 2, 3], [1, 3, 2]) == pytest.approx(0.5)
    assert pearson([1, 2, 3], [10, 20, 30]) == pytest.approx(1.0)
    assert pearson([1, 2, 3], [5, 4, 3]) == pytest.approx(-1.0)
    # a constant that is large beside the changes costs no digits
    assert pearson([1e9 + 1, 1e9 + 2, 1e9 + 3], [1, 3, 2]) == pytest.approx(0.5)


def test_nothing_to_correlate():
    assert math.isnan(pearson([1, 1, 1], [1, 2, 3]))
    assert math.isnan(pearson([1], [2]))
    with pytest.raises(ValueError, match="as many values of both"):
        pearson([1, 2], [1, 2, 3])
    with pytest.raises(ValueError, match="finite"):
        pearson([1, math.nan], [1, 2])


def test_spearman_sees_order_alone():
    x = np.array([0.1, 0.5, 2.0, 7.0])
    assert spearman(x, np.exp(x)) == pytest.approx(1.0)
    assert spearman(x, -(x**3)) == pytest.approx(-1.0)
    # 1 - 6 sum d^2 / (n (n^2 - 1)) of d = (0, 1, -1, 0), where none are equal
    assert spearman([1, 2, 3, 4], [1, 3, 2, 4]) == pytest.approx(1 - 6 * 2 / (4 * 15))
    # equal values share the mean of their ranks, (5, 2, 4, 2, 2)
    assert spearman([30, 10, 20, 10, 10], [5, 2, 4, 2, 2]) == pytest.approx(1.0)


def test_ranks_of_samples_are_those_of_the_values_written_out():
    rankdata = pytest.importorskip("scipy.stats").rankdata
    random = np.random.default_rng(0)
    first, second = random.integers(0, 9, (2, 30)).astype(float)
    times = random.integers(0, 4, (20, 30))
    found = rank_correlations(first, second, times)
    for row, value in zip(times, found, strict=True):
        assert value == pytest.approx(pearson(*(rankdata(np.repeat(x, row)) for x in (first, second))))
        assert value == pytest.approx(spearman(np.repeat(first, row), np.repeat(second, row)))
    assert np.isnan(rank_correlations(first, second, np.eye(30)[:3])).all()
    assert math.isnan(spearman([], [])) and math.isnan(spearman([1, 1], [1, 2]))


def test_runs_are_pooled_and_drawn_whole():
    random = np.random.default_rng(0)
    runs = []
    for k in range(12):
        x = random.normal(size=5 + k)
        runs.append((x, 0.6 * x + 0.8 * random.normal(size=5 + k)))
    middle, low, high = run_correlation(runs)
    pooled = pearson(*(np.concatenate([run[k] for run in runs]) for k in (0, 1)))
    assert middle == pytest.approx(pooled)
    assert low < middle < high
    # what is said twice by every run is no more evidence: whole runs are drawn, not steps
    doubled = run_correlation([(np.tile(x, 50), np.tile(y, 50)) for x, y in runs])
    assert doubled == pytest.approx((middle, low, high))
    assert run_correlation(runs) == (middle, low, high)
    with pytest.raises(ValueError, match="one or more runs"):
        run_correlation([])


def test_one_run_gives_no_width():
    middle, low, high = run_correlation([([1, 2, 3], [1, 3, 2])])
    assert (middle, low, high) == pytest.approx((0.5, 0.5, 0.5))
    assert all(math.isnan(value) for value in run_correlation([([1, 1], [1, 2])]))
