"""How two quantities go together, over values that come in runs."""

from collections.abc import Sequence

import numpy as np

Values = Sequence[float] | np.ndarray


def pearson(first: Values, second: Values) -> float:
    """Linear correlation in [-1, 1]; NaN for fewer than two values or where one quantity never changes."""
    a, b = _finite_pairs(first, second)
    if a.size < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    a, b = (a - a.mean()) / a.std(), (b - b.mean()) / b.std()
    return float(np.clip((a * b).mean(), -1.0, 1.0))


def spearman(first: Values, second: Values) -> float:
    """Rank correlation in [-1, 1]: `pearson` of the ranks, of which equal values share the mean."""
    a, b = _finite_pairs(first, second)
    return float(rank_correlations(a, b, np.ones((1, a.size)))[0])


def rank_correlations(first: np.ndarray, second: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Spearman's correlation of n pairs in B samples, in each of them `times` (B, n); NaN where one never changes."""
    count = times.sum(1, keepdims=True)
    centred = []
    with np.errstate(invalid="ignore"):
        for values in (first, second):
            _, place = np.unique(values, return_inverse=True)
            taken = np.zeros((place.max(initial=-1) + 1, len(times)))
            np.add.at(taken, place, times.T)
            ranks = (taken.cumsum(0) - (taken - 1) / 2)[place].T
            centred.append(ranks - (times * ranks).sum(1, keepdims=True) / count)
        x, y = centred
        found = (times * x * y).sum(1) / np.sqrt((times * x**2).sum(1) * (times * y**2).sum(1))
    return np.clip(found, -1.0, 1.0)


def run_correlation(
    runs: Sequence[tuple[Values, Values]], *, seed: int = 0, resamples: int = 500
) -> tuple[float, float, float]:
    """Linear correlation over the steps of all runs, with its 95 % bootstrap interval.

    Whole runs are drawn, since the steps of one hang together.

    Args:
        runs: both quantities over the steps of each run, finite.
        seed: of the resampling.
        resamples: how many.
    """
    if not runs:
        raise ValueError("Expected one or more runs, got none")
    pairs = [np.stack(_finite_pairs(*run)) for run in runs]
    # sums are all that is needed of a run
    sums = np.array([[p.shape[1], *p.sum(1), *(p**2).sum(1), p.prod(0).sum()] for p in _centred(pairs)])
    middle = _of_sums(sums.sum(0))
    random = np.random.default_rng(seed)
    drawn = sums[random.integers(0, len(runs), (resamples, len(runs)))].sum(1)
    found = [value for value in map(_of_sums, drawn) if np.isfinite(value)]
    if not found:
        return middle, float("nan"), float("nan")
    low, high = np.quantile(found, [0.025, 0.975])
    return middle, float(low), float(high)


def _centred(pairs: list[np.ndarray]) -> list[np.ndarray]:
    """The same, with means of 0 and deviations of 1 over all, so that sums of squares lose no digits."""
    every = np.concatenate(pairs, axis=1)
    spread = every.std(1, keepdims=True)
    return [(p - every.mean(1, keepdims=True)) / np.where(spread > 0, spread, 1.0) for p in pairs]


def _of_sums(sums: np.ndarray) -> float:
    n, x, y, xx, yy, xy = sums
    variance = (xx / n - (x / n) ** 2) * (yy / n - (y / n) ** 2)
    if n < 2 or not variance > 1e-24:
        return float("nan")
    return float(np.clip((xy / n - x * y / n**2) / np.sqrt(variance), -1.0, 1.0))


def _finite_pairs(first: Values, second: Values) -> list[np.ndarray]:
    a, b = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    if a.shape != b.shape or a.ndim != 1:
        raise ValueError(f"Expected as many values of both quantities, got shapes {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("Expected finite values")
    return [a, b]
