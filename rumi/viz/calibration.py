"""Figure of calibration: coverage of regions, reliability of P(right), ranks of the truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rumi.metrics.calibration import covered, reliability
from rumi.viz import style


def calibration_figure(
    levels: Mapping[str, Sequence[float]],
    p_right: Sequence[float],
    right: Sequence[bool],
    ranks: Mapping[str, Sequence[float]],
    path: Path,
) -> Path:
    """Draw three panels and write them.

    Args:
        levels: by what they are of: place, turn, both.
        p_right: of the beliefs.
        right: whether each was.
        ranks: of the truth, by coordinate.
        path: of the picture.
    """
    shares = np.linspace(0.0, 1.0, 51)
    with style.figure(9.0, 3.0) as figure:
        left, middle, last = figure.subplots(1, 3)
        colours = (style.NLL, style.EXPECTED, style.INK)
        for colour, (name, own) in zip(colours, levels.items(), strict=True):
            left.plot(shares, [covered(own, share) for share in shares], color=colour, lw=1.6, label=name)
        left.set(xlabel="region", ylabel="holds the truth", title="regions")
        left.legend(loc="upper left")
        bins = reliability(p_right, right)
        size = [12.0 + 80.0 * own.beliefs / max(1, len(p_right)) for own in bins]
        middle.scatter([own.p_right for own in bins], [own.right for own in bins], s=size, color=style.SURFACE, lw=0)
        middle.set(xlabel="P(right)", ylabel="right", title="reliability")
        for axes in (left, middle):
            axes.plot((0, 1), (0, 1), color=style.QUIET, lw=0.8, ls=(0, (4, 3)), zorder=0)
            axes.set(xlim=(0, 1), ylim=(0, 1.02), aspect="equal")
        for name, own in ranks.items():
            counts, edges = np.histogram(own, bins=10, range=(0.0, 1.0))
            last.stairs(counts, edges, lw=1.4, label=name)
        last.axhline(np.mean([len(own) / 10 for own in ranks.values()]) if ranks else 0, color=style.QUIET, lw=0.8)
        last.set(xlabel="rank of the truth", ylabel="episodes", title="ranks, last beliefs")
        if ranks:
            last.legend(loc="upper right")
        return style.save(figure, path)
