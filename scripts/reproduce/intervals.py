"""Intervals and paired comparisons for experiments."""

import math
from collections.abc import Sequence

import numpy as np


def wilson(successes: int, runs: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a success rate (95 % by default); (0, 1) for no runs."""
    if runs < 0 or not 0 <= successes <= max(runs, 0):
        raise ValueError(f"Expected 0 <= successes <= runs, got {successes} of {runs}")
    if runs == 0:
        return 0.0, 1.0
    rate = successes / runs
    centre = (rate + z * z / (2 * runs)) / (1 + z * z / runs)
    half = z / (1 + z * z / runs) * math.sqrt(rate * (1 - rate) / runs + z * z / (4 * runs * runs))
    return max(0.0, centre - half), min(1.0, centre + half)


def bootstrap_median(values: Sequence[float], *, seed: int = 0, resamples: int = 2000) -> tuple[float, float, float]:
    """Median of some values and its 95 % percentile-bootstrap interval; NaN-free values, at least one."""
    medians = np.median(_resampled(values, np.random.default_rng(seed), resamples), axis=1)
    return _with_interval([float(np.median(np.asarray(values, dtype=float)))], [medians])


def bootstrap_mean(values: Sequence[float], *, seed: int = 0, resamples: int = 2000) -> tuple[float, float, float]:
    """Mean of some values and its 95 % percentile-bootstrap interval; NaN-free values, at least one."""
    means = _resampled(values, np.random.default_rng(seed), resamples).mean(1)
    return _with_interval([float(np.mean(values))], [means])


def bootstrap_total(
    groups: Sequence[Sequence[float]], *, seed: int = 0, resamples: int = 2000
) -> tuple[float, float, float]:
    """Sum of the medians of some groups, and its 95 % interval by resampling within each; finite values."""
    drawn = [_resampled(group, np.random.default_rng([seed, k]), resamples) for k, group in enumerate(groups)]
    return _with_interval([float(np.median(group)) for group in groups], [np.median(d, axis=1) for d in drawn])


def bootstrap_total_difference(
    first: Sequence[Sequence[float]], second: Sequence[Sequence[float]], *, seed: int = 0, resamples: int = 2000
) -> tuple[float, float, float]:
    """How much larger the sum of the medians is for the first than for the second, with its 95 % interval.

    Args:
        first: finite values of each group.
        second: of the same groups; value k of a group belongs to value k of the first, and is drawn with it.
        seed: of the resampling.
        resamples: how many.
    """
    if [len(group) for group in first] != [len(group) for group in second]:
        raise ValueError(f"Expected pairs in each group, got {[*map(len, first)]} and {[*map(len, second)]} values")
    middles, drawn = [], []
    for k, (a, b) in enumerate(zip(first, second, strict=True)):
        pair = [_resampled(values, np.random.default_rng([seed, k]), resamples) for values in (a, b)]
        middles.append(float(np.median(a)) - float(np.median(b)))
        drawn.append(np.median(pair[0], axis=1) - np.median(pair[1], axis=1))
    return _with_interval(middles, drawn)


def _resampled(values: Sequence[float], random: np.random.Generator, resamples: int) -> np.ndarray:
    data = np.asarray(values, dtype=float)
    if data.size == 0 or not np.isfinite(data).all():
        raise ValueError(f"Expected one or more finite values, got {data.size} with {np.isfinite(data).sum()} finite")
    return np.asarray(data[random.integers(0, data.size, (resamples, data.size))])


def _with_interval(middles: Sequence[float], drawn: Sequence[np.ndarray]) -> tuple[float, float, float]:
    if not middles:
        raise ValueError("Expected one or more groups, got none")
    low, high = np.quantile(np.sum(drawn, axis=0), [0.025, 0.975])
    return float(sum(middles)), float(low), float(high)


def mcnemar(first: Sequence[bool], second: Sequence[bool]) -> float:
    """Exact two-sided McNemar p-value for paired successes."""
    if len(first) != len(second):
        raise ValueError(f"Expected pairs, got {len(first)} and {len(second)} runs")
    only_first = sum(a and not b for a, b in zip(first, second, strict=True))
    only_second = sum(b and not a for a, b in zip(first, second, strict=True))
    discordant = only_first + only_second
    if discordant == 0:
        return 1.0
    tail = sum(math.comb(discordant, k) for k in range(min(only_first, only_second) + 1)) / 2**discordant
    return min(1.0, 2 * tail)
