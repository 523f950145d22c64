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
    data = np.asarray(values, dtype=float)
    if data.size == 0 or not np.isfinite(data).all():
        raise ValueError(f"Expected one or more finite values, got {data.size} with {np.isfinite(data).sum()} finite")
    random = np.random.default_rng(seed)
    medians = np.median(data[random.integers(0, data.size, (resamples, data.size))], axis=1)
    low, high = np.quantile(medians, [0.025, 0.975])
    return float(np.median(data)), float(low), float(high)


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
