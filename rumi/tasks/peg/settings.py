"""Settings of the peg task."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import tyro
from annotated_types import Ge, Interval

from rumi.errors import UsageError
from rumi.registry import Table
from rumi.robot.motion_time import SpeedLimits
from rumi.tasks.peg.cell import Block
from sdf.bounds import Checked, Count, CountOr0, Finite, NotNegative, OneOf, Positive, Share
from sensors.touch.touch_likelihood import TouchNoise

PEG_STOPS: Table[Callable[..., bool]] = Table("stop", "rumi.peg_stops")
"""Rules to stop, by name: whether one holds of a `StaticBelief`, all evidence, a `TargetEstimate` and the settings."""

PEG_STOPS.add("mass", "rumi.tasks.peg.selection:by_mass")
PEG_STOPS.add("contacts", "rumi.tasks.peg.selection:by_contacts")
PEG_STOPS.add("covariance", "rumi.tasks.peg.selection:by_covariance")
PEG_STOPS.add("entropy", "rumi.tasks.peg.selection:by_entropy")

_APART_M, _APART_DEG = 1e-3, 2.0
"""About how far the poses that the second stage begins with are apart."""


@dataclass(frozen=True)
class PegSettings(Checked, refusal=UsageError):
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
        particles: of the second stage. Too few lose a side of the block sooner or later, and are sure of another.
        search_particles: of the first, likewise.
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

    action_budget_s: Annotated[Positive, tyro.conf.arg(metavar="SECONDS")] = 10.0
    evaluation_s: NotNegative | None = 1.0
    update_s: NotNegative = 0.05
    stop: Annotated[str, OneOf(PEG_STOPS)] = "mass"
    probability: Annotated[float, Interval(gt=0.0, lt=1.0)] = 0.95
    tolerance_m: Positive = 0.005
    contacts: CountOr0 = 4
    sides: CountOr0 = 2
    most_actions: Count = 80
    point_m: Positive = 0.005
    normal_deg: Positive = 6.0
    particles: Annotated[int, Ge(100)] = 500
    search_particles: Annotated[int, Ge(300)] = 2000
    readings: Count = 50
    sampled: bool = True
    configurations: Count = 5
    doublings: CountOr0 = 6
    speed_m_s: Positive = 0.05
    acceleration_m_s2: Positive = 0.1
    standoff_m: NotNegative = 0.04
    beyond_m: NotNegative = 0.04
    retreat_m: NotNegative = 0.01
    lift_m: Finite = 0.1
    low_m: Positive = 0.03
    clear: Share = 0.99
    lane_m: Positive = 0.125
    table_m: tuple[Positive, Positive] = (0.8, 0.5)
    radius_m: Positive = 0.0125
    length_m: Positive = 0.2
    width_m: Positive = 0.1
    height_m: Positive = 0.06
    hole_m: NotNegative = 0.06
    spread_m: Positive = 0.002
    spread_deg: Positive = 1.5
    most_nats: Finite = -12.0

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            UsageError: which setting, what was expected and what came.
        """
        super().__post_init__()
        _check_geometry(self)

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


def _check_geometry(settings: PegSettings) -> None:
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
