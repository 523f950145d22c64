"""A simulated cell: a ball on a force-torque sensor goes along straight ways and stops where it feels the object.

The object is fixed and all about a contact follows from geometry, so that contacts are cast exactly and no engine steps
through the motion: a ball against a rectangle from the side, against its top from above. Times are those of
trapezoidal speed profiles. What is left out: friction that turns the felt force away from the normal, a press that
yields, an arm that cannot reach.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.clock import SimulatedClock
from rumi.information.contact_gain import ContactKind, add_noise
from rumi.robot.motion_time import SpeedLimits, travel_time
from sdf.sweep import nearest_on_rectangle, sweep_rectangle, turned
from sensors.touch.touch_likelihood import TouchNoise


@dataclass(frozen=True)
class Block:
    """A rectangle on the table, with two holes in its top.

    Attributes:
        half_m: half of its edges.
        height_m: of its top over the table.
        hole_m: distance of each hole from the middle, along the longer edge.
    """

    half_m: tuple[float, float] = (0.1, 0.05)
    height_m: float = 0.06
    hole_m: float = 0.06

    def half(self) -> Float[Tensor, "2"]:
        """Half of its edges as a tensor."""
        return torch.tensor(self.half_m, dtype=torch.float64)

    def holes(self, poses: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2 2"]:
        """Where the holes are at poses (x, y, yaw), metres."""
        axis = torch.stack((poses[..., 2].cos(), poses[..., 2].sin()), -1)
        return torch.stack((poses[..., :2] + self.hole_m * axis, poses[..., :2] - self.hole_m * axis), -2)


@dataclass(frozen=True)
class Felt:
    """How a motion ended.

    Attributes:
        kind: of the contact, a `TOUCH` being one of a side.
        tip: (3,), where the ball's centre is then.
        point: (2,), touched, as the sensor has it; of no meaning where nothing was.
        normal: (2,), outward there, as the sensor has it; of no meaning but for a touch of a side.
        free: (K, 2, 2), ways at the low level on which nothing was met, the last cut off at the contact.
        leaving: whether the first of these ways began at a side that the ball rested against.
        path: (K, 3), what the centre went along.
        begun_s, ended_s: on the clock.
    """

    kind: ContactKind
    tip: Float[Tensor, "3"]
    point: Float[Tensor, "2"]
    normal: Float[Tensor, "2"]
    free: Float[Tensor, "W 2 2"]
    leaving: bool
    path: Float[Tensor, "K 3"]
    begun_s: float
    ended_s: float


class TimedPath(NamedTuple):
    """A motion to carry out.

    Attributes:
        points: (K, 3), of the ball's centre; the first is where it is.
        begins_s: on the clock.
    """

    points: Float[Tensor, "K 3"]
    begins_s: float


class TouchCell:
    """The table, the block on it and the ball.

    Args:
        truth: (3,), pose of the block.
        block: what it is like.
        radius: of the ball, metres.
        noise: of the sensor.
        limits: of the motion.
        tip: (3,), where the ball's centre begins.
        clock: that motions advance.
        generator: of the noise.
    """

    def __init__(
        self,
        truth: Float[Tensor, "3"],
        block: Block,
        radius: float,
        noise: TouchNoise,
        limits: SpeedLimits,
        tip: Float[Tensor, "3"],
        clock: SimulatedClock,
        generator: torch.Generator,
    ) -> None:
        self.truth, self.block, self.radius = truth, block, radius
        self.tip, self.clock = tip, clock
        self._noise, self._limits, self._generator = noise, limits, generator
        self._resting = self._leaving = False

    def follow(self, points: Float[Tensor, "K 3"]) -> Felt:
        """Go from point to point, with a rest at each, until something is felt.

        Ways go level or straight up and down. Those at or above the block's height plus the radius meet nothing.

        Args:
            points: of the ball's centre; the first is where it is.
        """
        if not torch.allclose(points[0], self.tip, atol=1e-9):
            raise ValueError(f"Expected a way from the tip at {self.tip.tolist()}, got {points[0].tolist()}")
        begun, path, free = self.clock(), [self.tip], []
        self._leaving = self._resting and bool((points[1] - points[0])[:2].norm() > 0)
        for start, end in pairwise(points):
            length = float((end - start).norm())
            if length == 0.0:
                continue
            level = bool((end - start)[:2].norm() > 0)
            if level and abs(float(end[2] - start[2])) > 1e-9:
                raise ValueError("Expected ways that go level or straight up and down")
            kind, gone, point, normal = self._level(start, end) if level else self._upright(start, end)
            self.clock.advance(time_to(gone, length, self._limits))
            self.tip = start + (end - start) * (gone / length)
            path.append(self.tip)
            if level and float(start[2]) < self.block.height_m + self.radius:
                free.append(torch.stack((start[:2], self.tip[:2])))
            if kind != ContactKind.NOTHING:
                point, normal = add_noise(point, normal, self._noise, generator=self._generator)
                return self._felt(kind, point, normal, free, path, begun)
        nowhere = self.tip.new_zeros(2)
        return self._felt(ContactKind.NOTHING, nowhere, nowhere, free, path, begun)

    def insert(self, at: Float[Tensor, "2"], low: float, tolerance_m: float = 0.005) -> tuple[bool, float]:
        """Lower the ball over a place: whether it is over a hole within a tolerance, and how far it is off.

        The ball of 25 mm goes down freely in a hole of 30 mm where it is off by 2.5 mm at most; the paper calls 5 mm
        good enough, where it meets the hole's rim at more than 53 degrees from below and slides in.

        Args:
            at: where it is lowered.
            low: height that it is lowered to.
            tolerance_m: distance from a hole's middle that will do; by default the paper's.
        """
        off = float((self.block.holes(self.truth) - at).norm(dim=-1).min())
        drop = float(self.tip[2]) - low
        self.clock.advance(float(travel_time(self.tip.new_tensor(drop), self._limits)))
        return off < tolerance_m, off

    def _level(self, start: Tensor, end: Tensor) -> tuple[ContactKind, float, Tensor, Tensor]:
        found = sweep_rectangle(self.truth, self.block.half(), start[:2], end[:2], self.radius)
        low = float(start[2]) < self.block.height_m + self.radius
        # a ball that rests against a side leaves it without touching it again
        leaving = float((found.normal * (end - start)[:2]).sum()) > 0 and float(found.distance) < 1e-9
        if not bool(found.hit) or not low or leaving:
            return ContactKind.NOTHING, float((end - start).norm()), found.point, found.normal
        return ContactKind.TOUCH, float(found.distance), found.point, found.normal

    def _upright(self, start: Tensor, end: Tensor) -> tuple[ContactKind, float, Tensor, Tensor]:
        back = turned(-self.truth[2])
        own = (back @ (start[:2] - self.truth[:2])[:, None])[:, 0]
        half = self.block.half()
        foot, out, gap = nearest_on_rectangle(own, half)
        drop, off = float(start[2] - end[2]), max(float(gap), 0.0)
        if drop <= 0 or off >= self.radius:
            return ContactKind.NOTHING, abs(drop), start[:2], start.new_tensor([1.0, 0.0])
        # the centre's height at contact with the top, or with its edge where it comes down beside it
        height = self.block.height_m + math.sqrt(self.radius**2 - off**2)
        gone = float(start[2]) - height
        if gone >= drop or gone < 0:
            return ContactKind.NOTHING, drop, start[:2], start.new_tensor([1.0, 0.0])
        touched = own if off == 0.0 else foot
        return (
            ContactKind.TOP,
            gone,
            (back.mT @ touched[:, None])[:, 0] + self.truth[:2],
            (back.mT @ out[:, None])[:, 0],
        )

    def _felt(
        self, kind: ContactKind, point: Tensor, normal: Tensor, free: list[Tensor], path: list[Tensor], begun: float
    ) -> Felt:
        ways = torch.stack(free) if free else self.tip.new_zeros(0, 2, 2)
        self._resting = kind == ContactKind.TOUCH
        return Felt(kind, self.tip, point, normal, ways, self._leaving, torch.stack(path), begun, self.clock())


def time_to(gone: float, length: float, limits: SpeedLimits) -> float:
    """Seconds until a motion from rest to rest (time allocation, Eqs. 9-16) has gone so far; all of it at its end.

    Args:
        gone: metres, up to the length.
        length: of the motion.
        limits: of it.
    """
    whole = float(travel_time(torch.tensor(length, dtype=torch.float64), limits))
    if gone >= length:
        return whole
    speed, acceleration = limits.speed_m_s, limits.acceleration_m_s2
    ramp = min(speed**2 / (2.0 * acceleration), 0.5 * length)
    if gone <= ramp:
        return math.sqrt(2.0 * gone / acceleration)
    if gone >= length - ramp:
        return whole - math.sqrt(2.0 * (length - gone) / acceleration)
    return math.sqrt(2.0 * ramp / acceleration) + (gone - ramp) / speed
