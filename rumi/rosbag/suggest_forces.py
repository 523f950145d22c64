"""Forces of a recording for a suggested mapping: their noise, and from which on they are a touch."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

_STILL_S = 0.3  # at the start, in which nothing touches
_LIFTED_M = 0.05  # over the lowest place of the tool, above which it touches nothing
SMOOTH_S = 0.1
"""Seconds over which suggested forces are averaged: a tool in motion shakes."""

_NOISES = 5.0  # that a touch is above what is measured at the start
_APART = 1.5  # times as strong as other forces are those of touches, in the median, where these are to be told
_MOVES_M = 0.001  # on the way of `SMOOTH_S`
_FEWEST = 3  # wrenches that tell anything
_LEAST_N = 0.01  # of a noise that is written down


class Forces(NamedTuple):
    """What a force sensor measures.

    Attributes:
        noise_n: standard deviation along each axis at rest.
        touch_n: size from which on a force that is averaged over `SMOOTH_S` is a touch.
        told: whether strong forces and faint ones stand apart; else it is by the noise alone.
        lifted_m: height over the tool's lowest place above which it touches nothing; None where it never gets there.
    """

    noise_n: float
    touch_n: float
    told: bool
    lifted_m: float | None = None


def forces_of(
    wrenches: list[tuple[int, np.ndarray]], stamps_ns: Int[Tensor, "n"], places: Float[Tensor, "n 3"]
) -> Forces | None:
    """By the wrenches from the tool's first pose to its last; None where these are few.

    Their zero is in the middle between what is measured at the start, where the tool may lean on something, and where
    it is lifted, as `WrenchMap.tare_above_m` has it.
    Touches are told from the rest, while the tool moves, where the sum of squares of log-sizes within both is least
    (Otsu 1979).

    Args:
        wrenches: stamps and rows, force and moment.
        stamps_ns: of the tool's poses, rising.
        places: of it.
    """
    known = stamps_ns.numpy()
    ordered = sorted(
        (one for one in wrenches if len(known) and known[0] <= one[0] <= known[-1]), key=lambda one: one[0]
    )
    if len(ordered) < _FEWEST:
        return None
    at = 1e-9 * (np.array([stamp for stamp, _ in ordered]) - known[0])
    begin, end = (
        np.stack([np.interp(at + off, 1e-9 * (known - known[0]), axis) for axis in places.numpy().T], -1)
        for off in (-0.5 * SMOOTH_S, 0.5 * SMOOTH_S)
    )
    moves = np.linalg.norm(end - begin, axis=-1) > _MOVES_M
    high = 0.5 * (begin + end)[:, 2] > places[:, 2].min().item() + _LIFTED_M
    stamps = 1e-9 * (np.array([stamp for stamp, _ in ordered]) - ordered[0][0])
    rows = np.stack([row[:3] for _, row in ordered])
    kept = np.isfinite(rows).all(-1)
    stamps, rows, moves, high = stamps[kept], rows[kept], moves[kept], high[kept]
    lifted_m = _LIFTED_M if high.sum() >= _FEWEST else None
    still = rows[stamps <= _STILL_S]
    if len(still) < _FEWEST:
        return None
    # of differences, which a touch that sets in early hardly changes
    noise = max(_LEAST_N, 1.4826 / math.sqrt(2.0) * float(np.median(np.abs(np.diff(still, axis=0)))))
    zero = np.median(still, 0)
    if lifted_m is not None:
        zero = 0.5 * (zero + np.median(rows[high], 0))
    size = np.linalg.norm(_averaged(stamps, rows - zero), axis=-1)
    size = np.sort(np.maximum(size[moves], noise))
    split = _split(np.log(size))
    if split and np.median(size[split:]) > _APART * np.median(size[:split]):
        return Forces(noise, float(max(_NOISES * noise, np.sqrt(size[split - 1] * size[split]))), True, lifted_m)
    return Forces(noise, _NOISES * noise, False, lifted_m)


def lines_of(forces: Forces | None, *, lowest_m: float, upright: bool) -> list[str]:
    """Lines of the table `[wrench]`: what a force is without a touch, when it is one, and where that is.

    Args:
        forces: of the recording.
        lowest_m: the tool's lowest place over the floor.
        upright: whether the rod is.
    """
    lines = []
    if forces is not None and forces.lifted_m is not None:
        above = lowest_m + forces.lifted_m
        lines.append(
            f"tare_above_m = {above:.3f}  # TODO a height over the floor from which on the tool touches nothing"
        )
    if forces is not None:
        why = "between strong forces and faint ones" if forces.told else "by the noise at rest"
        lines += [
            f"smooth_s = {SMOOTH_S:g}  # seconds over which forces are averaged: a tool in motion shakes",
            f"force_n = {forces.noise_n:.3f}  # noise along each axis, as at the start",
            f"least_force_n = {forces.touch_n:.2f}  # TODO from which on it touches, here {why}",
        ]
    if upright:
        lines.append("level = true  # the rod is upright: it touches at the height of the tool's frame")
    return [*lines, ""]


def _averaged(stamps: np.ndarray, rows: np.ndarray) -> np.ndarray:
    first = np.searchsorted(stamps, stamps - 0.5 * SMOOTH_S)
    behind = np.searchsorted(stamps, stamps + 0.5 * SMOOTH_S, side="right")
    total = np.concatenate((np.zeros_like(rows[:1]), rows.cumsum(0)))
    found: np.ndarray = (total[behind] - total[first]) / (behind - first)[:, None]
    return found


def _split(ordered: np.ndarray) -> int:
    """How many of some rising numbers are the lower ones of two groups."""
    count = np.arange(1, len(ordered))
    sums = ordered.cumsum()[:-1]
    low, high = sums / count, (ordered.sum() - sums) / (len(ordered) - count)
    return int(np.argmax(count * (len(ordered) - count) * (high - low) ** 2)) + 1 if len(count) else 0
