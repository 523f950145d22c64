"""Model of the duration of evaluations: a line on average and an upper bound, fitted to earlier ones."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from sdf.bounds import Checked, NotNegative, Positive

Times = Sequence[float] | np.ndarray

_FEW = 2.0
"""With too few measurements for a level, the bound is the slowest of them times this."""


@dataclass(frozen=True)
class DurationModel(Checked):
    """Seconds that work takes: a straight line on average, and a bound that is kept with a given probability.

    Attributes:
        fixed_s: c0, of the mean, which is c0 + c1 work.
        per_work_s: c1.
        margin: the bound over the mean.
        level: share of decisions that the bound is to keep in time.
        count: measurements that it rests on; 0 where it is known.
    """

    fixed_s: NotNegative
    per_work_s: NotNegative = 0.0
    margin: Positive = 1.0
    level: float = 1.0
    count: int = 0

    @classmethod
    def known(cls, seconds: float) -> Self:
        """Of work that always takes the same time."""
        return cls(seconds)

    @classmethod
    def fit(cls, work: Times, seconds: Times, level: float = 0.99) -> Self:
        """Fitted to measurements, which are to be like those to come.

        The margin is the least that meets both of two conditions. An evaluation takes longer than the bound with
        probability 1 - level at most: the order statistic that holds for exchangeable times of any distribution. And a
        row of evaluations, each begun only where the bound leaves time for it, ends late with that probability at
        most: E[(T - bound)+] / E[T], the chance that the last one spans what is left. For times with a heavy tail this
        is more than the first asks for. With too few measurements for the level, it is twice the slowest.
        Where some measurements are of no work, the line begins no lower than their mean, so that a margin can meet
        both of them too.

        Args:
            work: of each measurement, in any unit, such as readings times particles.
            seconds: that it took.
            level: share of decisions to be in time, below 1.

        Raises:
            ValueError: there are no measurements, or they are not times.
        """
        size, took = np.asarray(work, dtype=float), np.asarray(seconds, dtype=float)
        if len(size) == 0 or size.shape != took.shape:
            raise ValueError(f"Expected as many seconds as work, and at least one, got {len(took)} and {len(size)}")
        if not (np.isfinite(size).all() and np.isfinite(took).all() and size.min() >= 0 and took.min() >= 0):
            raise ValueError("Expected work and seconds to be finite and 0 or more")
        if not 0 < level < 1:
            raise ValueError(f"Expected level between 0 and 1, got {level}")
        fixed, slope = _line(size, took)
        mean = fixed + slope * size
        ratio = took / np.where(mean > 0, mean, 1.0)
        order = np.argsort(ratio, kind="stable")
        ratio, share = ratio[order], mean[order] / max(float(mean.max()), np.finfo(float).tiny)
        place = math.ceil((len(ratio) + 1) * level)
        if place > len(ratio):
            margin = _FEW * float(ratio[-1])
        else:
            margin = max(float(ratio[place - 1]), _excess_margin(ratio, share, 1.0 - level))
        return cls(fixed, slope, max(margin, 1.0), level, len(took))

    def mean(self, work: float = 1.0) -> float:
        """Seconds that work takes on average."""
        return self.fixed_s + self.per_work_s * work

    def bound(self, work: float = 1.0) -> float:
        """Seconds that work takes at most, but for 1 - level of the decisions."""
        return self.margin * self.mean(work)


def _line(size: np.ndarray, took: np.ndarray) -> tuple[float, float]:
    """Intercept and slope of least squares, neither below 0."""
    spread = size - size.mean()
    variance = float(spread @ spread)
    slope = float(spread @ took) / variance if variance > 0 else 0.0
    fixed = float(took.mean() - slope * size.mean())
    if slope < 0:
        return float(took.mean()), 0.0
    idle = took[size == 0]
    if variance > 0 and len(idle) and fixed <= 0 < idle.mean():
        # no margin is enough over a line that says that no work takes no time
        fixed = float(idle.mean())
        return fixed, max(float(size @ (took - fixed)) / float(size @ size), 0.0)
    if fixed < 0:
        return 0.0, float(size @ took) / float(size @ size)
    return fixed, slope


def _excess_margin(ratio: np.ndarray, share: np.ndarray, most: float) -> float:
    """Least margin m at which E[(T - m mean)+] / E[T] is `most`.

    Args:
        ratio: T over its mean, ascending.
        share: those means, up to a constant: by it each ratio's excess is as many seconds.
        most: see above.
    """
    if not share.any():
        return 1.0
    # the excess at each ratio, from the largest down: a straight line between neighbours
    seconds = share * ratio
    above = np.concatenate((np.cumsum(seconds[::-1])[::-1][1:], [0.0]))
    more = np.concatenate((np.cumsum(share[::-1])[::-1][1:], [0.0]))
    excess = (above - more * ratio) / len(ratio)
    allowed = most * float(seconds.mean())
    first = int(np.argmax(excess <= allowed))
    # between this one and the one before, excess falls by the share of ratios that lie above
    rate = (more[first] + share[first]) / len(ratio)
    return float(ratio[first] - (allowed - excess[first]) / rate)
