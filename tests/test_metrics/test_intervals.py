"""Intervals against published and hand-computed values."""

import pytest

from rumi.metrics.intervals import bootstrap_median, mcnemar, wilson


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
