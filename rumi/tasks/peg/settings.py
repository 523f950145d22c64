"""Settings of the peg task."""

import math
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, get_args

import tyro

from rumi.errors import UsageError
from rumi.robot.motion_time import SpeedLimits
from rumi.tasks.peg.cell import Block
from sensors.touch.touch_likelihood import TouchNoise

Stop = Literal["mass", "contacts", "covariance", "entropy"]

_ABOVE_0 = (
    *("action_budget_s", "tolerance_m", "most_actions", "point_m", "normal_deg", "readings", "configurations"),
    "speed_m_s",
    *("acceleration_m_s2", "low_m", "lane_m", "radius_m", "length_m", "width_m", "height_m", "spread_m", "spread_deg"),
)
_NOT_NEGATIVE = (
    *("evaluation_s", "update_s", "contacts", "sides", "doublings", "retreat_m", "standoff_m", "beyond_m", "hole_m"),
)
_FEWEST = {"particles": 100, "search_particles": 300}
"""Fewer lose a side of the block sooner or later, and are sure of another."""
_APART_M, _APART_DEG = 1e-3, 2.0
"""About how far the poses that the second stage begins with are apart."""


@dataclass(frozen=True)
class PegSettings:
    """What the task and the robot are like, and how much it thinks.

    Attributes:
        action_budget_s: seconds for a decision and its motion together.
        evaluation_s: seconds that weighing one candidate is taken to last, 1 on a slow machine. They are added to a
            simulated clock, so that a run is the same on any machine. None for what it takes on this one, measured.
        update_s: seconds that the belief takes to follow a reading.
        stop: "mass" stops where both holes are within the tolerance of where they are thought to be with a
            probability, "contacts" after four contacts on two sides, as the paper does, "covariance" where the pose
            spreads by `spread_m` and `spread_deg` at most, "entropy" where its differential entropy is low.
        probability: to stop at.
        tolerance_m: of a hole: what is right, and in the hole, is measured by it too.
        contacts: on sides, before it may stop, whatever the rule.
        sides: different ones of them, for the paper's stop.
        most_actions: after which the run ends as it is.
        point_m, normal_deg: noise of the sensor, and as the belief has it.
        particles: of the second stage.
        search_particles: of the first.
        readings: drawn for each candidate's gain.
        sampled: whether they have noise.
        configurations: poses that candidates are made of, the likeliest first; twelve candidates each.
        doublings: of the time where there is nothing to do in it.
        speed_m_s, acceleration_m_s2: limits of all motion.
        standoff_m: distance in front of a side, from where the ball presses.
        beyond_m: how far it presses on behind where the side is thought to be.
        retreat_m: from a side after a touch.
        lift_m: height of the ball's centre over the table, in passing over the block.
        low_m: height of the centre in touching sides.
        clear: probability that a direct way must be clear with, else the ball goes over the top.
        lane_m: distance of the lanes of the search.
        table_m: size of the part of the table that the block's middle may be on.
        radius_m: of the ball.
        length_m, width_m, height_m, hole_m: of the block.
        spread_m, spread_deg: standard deviations of the block's place and yaw that "covariance" stops at.
        most_nats: differential entropy of (x, y, yaw), in metres and radians, that "entropy" stops at.
    """

    action_budget_s: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 10.0
    evaluation_s: float | None = 1.0
    update_s: float = 0.05
    stop: Stop = "mass"
    probability: float = 0.95
    tolerance_m: float = 0.005
    contacts: int = 4
    sides: int = 2
    most_actions: int = 80
    point_m: float = 0.005
    normal_deg: float = 6.0
    particles: int = 500
    search_particles: int = 2000
    readings: int = 50
    sampled: bool = True
    configurations: int = 5
    doublings: int = 6
    speed_m_s: float = 0.05
    acceleration_m_s2: float = 0.1
    standoff_m: float = 0.04
    beyond_m: float = 0.04
    retreat_m: float = 0.01
    lift_m: float = 0.1
    low_m: float = 0.03
    clear: float = 0.99
    lane_m: float = 0.125
    table_m: tuple[float, float] = (0.8, 0.5)
    radius_m: float = 0.0125
    length_m: float = 0.2
    width_m: float = 0.1
    height_m: float = 0.06
    hole_m: float = 0.06
    spread_m: float = 0.002
    spread_deg: float = 1.5
    most_nats: float = -12.0

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            UsageError: which setting, what was expected and what came.
        """
        _check(self)

    @property
    def block(self) -> Block:
        """The block."""
        return Block((0.5 * self.length_m, 0.5 * self.width_m), self.height_m, self.hole_m)

    @property
    def noise(self) -> TouchNoise:
        """Of the sensor."""
        return TouchNoise(self.point_m, math.radians(self.normal_deg))

    @property
    def power(self) -> float:
        """Of the likelihood where the stages meet: below 1 where the sensor is more exact than poses are apart."""
        return min(1.0, (self.point_m / _APART_M) ** 2, (self.normal_deg / _APART_DEG) ** 2)

    @property
    def limits(self) -> SpeedLimits:
        """Of all motion."""
        return SpeedLimits(self.speed_m_s, self.acceleration_m_s2)

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def _check(settings: PegSettings) -> None:
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


def _geometry(settings: PegSettings) -> None:
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
