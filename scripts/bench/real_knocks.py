"""Twelve real runs of a square slider pushed along a line, some knocked by hand: readings, and when it was knocked.

`RUMI_DATA/real_pushes/closed_loop.npz` is of github.com/mcubelab/cpush. Knocks are labelled from its poses by a rule:
within 0.1 s some corner of the slider goes further than twice the tip's way in that time, and twice the depth by which
the tip is within the slider before (a tracker that is late catches up), by 4 mm. What a tip pushes turns about a
point beyond its centre, so that no corner goes much further than the tip.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from scripts.bench.real_pushes import TIP_M, folder

HALF_M = 0.045
WINDOW_S, SHARE, EXCESS_M, APART_S = 0.1, 2.0, 4e-3, 0.3
LATE_M, STALE_S = 3e-3, 0.06
_STEP_S = 0.005
_WITHOUT_TIP = "StraightLineTargetBigPerturbations"  # its column of the tip's y repeats x


class Knock(NamedTuple):
    """A time span in which the slider was moved by something else than the tip, seconds from the run's start."""

    begin: float
    end: float


class Run(NamedTuple):
    """A run.

    Attributes:
        name: of it.
        time: (n), seconds from its start.
        pose: (n, 3), slider's x, y and yaw, metres and radians.
        tip: (n, 2), the tip's centre.
    """

    name: str
    time: np.ndarray
    pose: np.ndarray
    tip: np.ndarray

    def at(self, times: np.ndarray) -> "Run":
        """The last sample at or before each time."""
        rows = (np.searchsorted(self.time, times, side="right") - 1).clip(0)
        return Run(self.name, times, self.pose[rows], self.tip[rows])


@cache
def runs() -> dict[str, Run]:
    """All runs whose tip is known, by name."""
    found = {}
    with np.load(folder() / "closed_loop.npz") as data:
        for name in data:
            if name != _WITHOUT_TIP:
                rows = data[name]
                pose = np.concatenate((rows[:, 1:3], np.unwrap(rows[:, 3:4], axis=0)), 1)
                found[name] = Run(name, rows[:, 0] - rows[0, 0], pose, rows[:, 4:6])
    return found


def gap_m(run: Run) -> np.ndarray:
    """Distance of the tip's border from the slider at each sample, metres; below 0 within it."""
    off, yaw = run.tip - run.pose[:, :2], run.pose[:, 2]
    cos, sin = np.cos(yaw), np.sin(yaw)
    local = np.stack((cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]), -1)
    beyond = np.abs(local) - HALF_M
    return np.hypot(*np.maximum(beyond, 0.0).T) + np.minimum(beyond.max(1), 0.0) - TIP_M


def corners(pose: np.ndarray) -> np.ndarray:
    """(n, 4, 2), world frame, metres."""
    local = HALF_M * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    cos, sin = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    x, y = local.T
    return pose[:, None, :2] + np.stack((cos * x - sin * y, sin * x + cos * y), -1)


def knocks(run: Run) -> list[Knock]:
    """When the slider was knocked, by the rule."""
    own = run.at(np.arange(0.0, run.time[-1], _STEP_S))
    way = np.concatenate(([0.0], np.hypot(*np.diff(own.tip, axis=0).T).cumsum()))
    deep, place, count = np.maximum(0.0, -gap_m(own) - 1e-3), corners(own.pose), round(WINDOW_S / _STEP_S)
    found: list[Knock] = []
    for first in range(len(way) - count):
        after = slice(first + 1, first + count + 1)
        gone = np.linalg.norm(place[after] - place[first], axis=-1).max(1)
        excess = gone - SHARE * (way[after] - way[first] + deep[first])
        if excess[-1] <= EXCESS_M:
            continue
        begin = own.time[first + 1 + int(np.argmax(excess > 1e-3))]
        end = own.time[first + count]
        if found and begin - found[-1].end < APART_S:
            found[-1] = Knock(found[-1].begin, end)
        else:
            found.append(Knock(float(begin), float(end)))
    return found


def faultless(run: Run, times: np.ndarray, *, before_s: float = 0.05, after_s: float = 0.5) -> np.ndarray:
    """Whether nothing is wrong at some times: no knock near by, and a tracker that is neither late nor stale.

    It is late where the tip is more than 3 mm within the slider, and stale where its pose stays the same, to the last
    digit, over 60 ms; after all three a while is left out.
    """
    own = run.at(np.arange(0.0, run.time[-1], _STEP_S))
    same = np.concatenate(([False], (np.diff(own.pose, axis=0) == 0).all(1)))
    bad = gap_m(own) < -LATE_M
    since, stale = 0, np.zeros_like(bad)
    for row, still in enumerate(same):
        since = since + 1 if still else 0
        stale[row] = since * _STEP_S >= STALE_S
    bad |= stale
    spans = [(time - before_s - STALE_S, time + after_s) for time in own.time[bad]]
    spans += [(knock.begin - before_s, knock.end + after_s) for knock in knocks(run)]
    good = np.ones(len(times), dtype=bool)
    for begin, end in spans:
        good &= (times < begin) | (times > end)
    return good


def size(run: Run, knock: Knock) -> tuple[float, float]:
    """Motion over a knock, millimetres and degrees."""
    pose = run.at(np.array(knock)).pose
    off = pose[1] - pose[0]
    return 1e3 * float(np.hypot(*off[:2])), math.degrees(float(abs(off[2])))
