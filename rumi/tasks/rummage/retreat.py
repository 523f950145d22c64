"""Retreat: the tool goes back to where it felt nothing, from an object that leans on it, which then stands again."""

import math
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from sdf.so3 import wrap
from sensors.reading import Reading

_LEAST_RAD = math.radians(1.0)  # tilt from which on an object leans
_SHARE = 0.5  # of the belief that leans, from which on the tool goes back
_MOST_M = 0.04  # of the way back: by then what stands again touches the tool no more
_LEAST_M = 1e-3  # of it, below which there is none


def leans(pose_filter: PoseFilter, belief: PoseBelief) -> bool:
    """Whether most of a belief leans on the tool."""
    return isinstance(pose_filter, PoseTrajectoryFilter) and pose_filter.leaning(belief, _LEAST_RAD) > _SHARE


def holds(reading: Reading) -> bool:
    """Whether the tool touches the object at the end of an action."""
    return bool(reading.in_contact[-1:].any())


def way_back(readings: Sequence[Reading], scale: Float[Tensor, "Q"]) -> Float[Tensor, "Q"] | None:
    """Control that takes the tool to where it was last when it touched nothing, or a part of the way.

    Args:
        readings: of the run so far, the last one of where the tool is.
        scale: what a control of 1 asks for.

    Returns:
        the control; None where there is no such place, or the tool is there.
    """
    here = readings[-1].configuration
    way = next((last.configuration for last in reversed(readings[:-1]) if not holds(last)), here) - here
    way[-1] = wrap(way[-1])
    length = float(way[:-1].norm())
    if length < _LEAST_M:
        return None
    return (way * min(1.0, _MOST_M / length) / scale.to(way)).clamp(-1.0, 1.0)
