"""What settings of the peg task must be."""

import math
from typing import TYPE_CHECKING, Literal, get_args

from rumi.errors import UsageError

if TYPE_CHECKING:
    from rumi.tasks.peg.settings import PegSettings

Stop = Literal["mass", "contacts", "covariance", "entropy"]

_ABOVE_0 = (
    *("t_max_s", "tolerance_m", "most_actions", "point_m", "normal_deg", "readings", "configurations", "speed_m_s"),
    *("acceleration_m_s2", "low_m", "lane_m", "radius_m", "length_m", "width_m", "height_m", "spread_m", "spread_deg"),
)
_NOT_NEGATIVE = (
    *("evaluation_s", "update_s", "contacts", "sides", "doublings", "retreat_m", "standoff_m", "beyond_m", "hole_m"),
)
_FEWEST = {"particles": 100, "search_particles": 300}
"""Fewer lose a side of the block sooner or later, and are sure of another."""


def check(settings: "PegSettings") -> None:
    """Refuse what cannot be.

    Raises:
        UsageError: which setting, what was expected and what came.
    """
    for name, value in vars(settings).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise UsageError(f"Expected {name} to be a finite number, got {value!r}")
    if settings.stop not in get_args(Stop):
        raise UsageError(f"Expected stop to be one of {', '.join(get_args(Stop))}, got {settings.stop!r}")
    for name in _ABOVE_0:
        if not getattr(settings, name) > 0:
            raise UsageError(f"Expected {name} above 0, got {getattr(settings, name)}")
    for name in _NOT_NEGATIVE:
        if (getattr(settings, name) or 0) < 0:
            raise UsageError(f"Expected {name} to be 0 or more, got {getattr(settings, name)}")
    for name, fewest in _FEWEST.items():
        if getattr(settings, name) < fewest:
            raise UsageError(
                f"Expected {name} of {fewest} or more, or the belief may be sure of what is wrong, got "
                f"{getattr(settings, name)}"
            )
    if not 0 < settings.probability < 1:
        raise UsageError(f"Expected probability between 0 and 1, got {settings.probability}")
    if not 0 <= settings.clear <= 1:
        raise UsageError(f"Expected clear, a probability, in [0, 1], got {settings.clear}")
    if not min(settings.table_m) > 0:
        raise UsageError(f"Expected table_m above 0 m, got {list(settings.table_m)}")
    _geometry(settings)


def _geometry(settings: "PegSettings") -> None:
    """Refuse a block that lanes miss, a ball that meets no side or not only sides, holes beside the block."""
    widest = min(settings.length_m, settings.width_m) + 2.0 * settings.radius_m
    if settings.lane_m > widest:
        raise UsageError(
            f"Expected lanes at most the block's width and the ball's apart, or some blocks are never met: "
            f"{widest:g} m, got {settings.lane_m:g}"
        )
    if settings.low_m > settings.height_m:
        raise UsageError(
            f"Expected low_m at most the block's height, or the ball meets no side: {settings.height_m:g} m, got "
            f"{settings.low_m:g}"
        )
    if settings.lift_m <= settings.height_m + settings.radius_m:
        raise UsageError(f"Expected lift_m above the block and the ball's radius, got {settings.lift_m:g}")
    if settings.hole_m >= 0.5 * settings.length_m:
        raise UsageError(
            f"Expected holes in the block, hole_m below half of its length, {0.5 * settings.length_m:g} m, got "
            f"{settings.hole_m:g}"
        )
