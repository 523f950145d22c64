"""Intervals against published and hand-computed values."""

import pytest

from scripts.reproduce.intervals import (
    bootstrap_median,
    bootstrap_total,
    bootstrap_total_difference,
    mcnemar,
    wilson,
)


@pytest.mark.parametrize(
    ("successes", "runs", "low", "high"),
    [(9, 10, 0.596, 0.982), (30, 30, 0.886, 1.0), (0, 18, 0.0, 0.176), (28, 30, 0.787, 0.982)],
)
def test_wilson(successes, runs, low, high):
    assert wilson(successes, runs) == pytest.approx((low, high), abs=1e-3)


def test_wilson_of_nothing_and_of_nonsense():
    assert wilson(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="successes"):
        wilson(5, 4)


def test_mcnemar_is_the_sign_test_of_the_discordant_pairs():
    first = [True] * 6 + [False] * 1 + [True] * 10
    second = [False] * 6 + [True] * 1 + [True] * 10
    assert mcnemar(first, second) == pytest.approx(2 * (1 + 7) / 2**7)
    assert mcnemar([True], [True]) == 1.0


def test_bootstrap_median_holds_the_median_and_narrows():
    median, low, high = bootstrap_median(range(101))
    assert median == 50
    assert low < 50 < high
    assert high - low < 30
    with pytest.raises(ValueError, match="finite"):
        bootstrap_median([])


def test_total_of_medians():
    total, low, high = bootstrap_total([[1, 2, 3], [10, 20, 60]])
    assert total == 22
    assert 11 <= low < 22 < high <= 63
    assert bootstrap_total([[5.0], [7.0]]) == (12.0, 12.0, 12.0)
    one = bootstrap_total([range(101)])
    assert one[0] == bootstrap_median(range(101))[0]
    assert one[1:] == pytest.approx(bootstrap_median(range(101))[1:], abs=3)
    for wrong in ([], [[1.0], []], [[float("nan")]]):
        with pytest.raises(ValueError, match="one or more"):
            bootstrap_total(wrong)


def test_difference_of_totals_knows_the_pairs():
    values = [[3.0, 100.0, 7.0, 45.0, 260.0], [1.0, 2.0, 300.0]]
    shifted = [[value + 5.0 for value in group] for group in values]
    # pair by pair the difference is 5: drawn together it is 5 each time, drawn apart it would not be
    assert bootstrap_total_difference(shifted, values) == (10.0, 10.0, 10.0)
    assert bootstrap_total_difference(values, shifted) == (-10.0, -10.0, -10.0)
    other = [[value * 2.0 for value in group] for group in values]
    middle, low, high = bootstrap_total_difference(other, values)
    assert middle == 45.0 + 2.0
    assert low < middle < high
    with pytest.raises(ValueError, match="pairs in each group"):
        bootstrap_total_difference([[1.0, 2.0]], [[1.0]])
