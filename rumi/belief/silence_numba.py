"""Likelihood of pads that felt nothing, for compiled versions; `trajectory_likelihood` has the definition."""

import math

from rumi.belief.trajectory_history import NODES, Kind
from sdf.compiled import bare

SILENT = NODES * int(Kind.PAD_SILENT)
"""Row of the points of such pads; they are the last of their instant."""


@bare
def told_by_silence(points, missed, power):
    """Log-likelihood of pads that felt nothing at an instant."""
    if missed == 0.0:
        return points
    return power * math.log(missed + (1.0 - missed) * math.exp(points / power))
