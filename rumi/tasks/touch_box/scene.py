"""The touch-alone task: a box that stands somewhere about one of two places, to be found by touch and lifted."""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.prior import PlanarPrior
from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline
from rumi.errors import UsageError
from rumi.seeding import split
from sdf.bounds import ASCENDING, Checked, Count, Finite, Law, NotNegative, Positive, Share, ShareBelow1

_CLEARANCE_M = 0.01  # of the open fingers about a box, both sides together


@dataclass(frozen=True)
class BoxTruth:
    """What is so in one run, and the filter does not know.

    Attributes:
        pose: (3,), (x, y, yaw) of the box at the start, metres and radians.
        friction: of the tool on the box.
        floor_friction: of the box on the floor.
        mass_kg: of the box.
    """

    pose: Float[Tensor, "3"]
    friction: float
    floor_friction: float
    mass_kg: float


_Places = Annotated[tuple[tuple[Finite, Finite, Finite], ...], Law("with one place (x, y, yaw) or more", bool)]


@dataclass(frozen=True)
class TouchTask(Checked, refusal=UsageError):
    """The scene and what is known of it; metres and radians, floor at z = 0.

    Attributes:
        half: half of the box's footprint along its x and y.
        height_m: of the box.
        modes: (x, y, yaw) of the places about which the box may stand, equally likely.
        spread: standard deviations of its pose about each.
        friction: range of the tool's friction on the box, uniform.
        floor_friction: range of the floor's.
        mass_kg: range of the mass.
        rates: true and false positive rate of a contact reading.
        correlation: chance that a reading errs as the one before did, instead of by a draw of its own.
        finger_m: radius of a finger.
        opening_m: between the open fingers.
        spacing_m: between readings along a poke.
        readings: of a poke that is not cut short.
        speed: of a poke, m/s.
    """

    half: tuple[Positive, Positive] = (0.03, 0.08)
    height_m: Positive = 0.10
    modes: _Places = (
        (0.45, 0.2, 0.0),
        (0.45, -0.2, 0.0),
    )
    spread: tuple[Positive, Positive, Positive] = (0.06, 0.06, 0.5)
    friction: Annotated[tuple[NotNegative, NotNegative], ASCENDING] = (0.2, 0.6)
    floor_friction: Annotated[tuple[NotNegative, NotNegative], ASCENDING] = (0.2, 0.6)
    mass_kg: Annotated[tuple[Positive, Positive], ASCENDING] = (0.3, 0.8)
    rates: tuple[Share, Share] = (0.5, 0.1)
    correlation: ShareBelow1 = 0.0
    finger_m: Positive = 0.01
    opening_m: Positive = 0.08
    spacing_m: Positive = 0.005
    readings: Count = 40
    speed: Positive = 0.08

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        super().__post_init__()
        high, low = self.rates
        if not low < high:
            raise UsageError(f"Expected rates as true > false positive rate, got {self.rates}")
        widest = self.opening_m - _CLEARANCE_M
        if 2.0 * self.half[0] > widest + 1e-9:
            raise UsageError(
                f"Expected a box of at most {max(widest, 0.0):.3g} m across, {_CLEARANCE_M:g} m less than the "
                f"gripper's opening of {self.opening_m} m, got {2 * self.half[0]:.3g} m: turn it, or open wider"
            )

    @property
    def prior(self) -> PlanarPrior:
        """Over the box's pose at the start."""
        return PlanarPrior(
            torch.tensor(self.modes, dtype=torch.float64), torch.tensor(self.spread, dtype=torch.float64)
        )

    @property
    def outline(self) -> RectangleOutline:
        """Of the box."""
        return RectangleOutline(self.half)

    @property
    def even_lever_m(self) -> float:
        """C of the limit surface of a box that presses evenly on the floor: mean distance of its base."""
        return mean_distance(self.half)

    @property
    def fingers(self) -> Pusher:
        """Footprint of the gripper's closed fingers: two discs side by side, across the tool's x."""
        return Pusher(torch.tensor([[0.0, self.finger_m], [0.0, -self.finger_m]], dtype=torch.float64), self.finger_m)


def mean_distance(half: tuple[float, float]) -> float:
    """Mean distance of a rectangle's points from its middle, in closed form."""
    a, b = half
    d = math.hypot(a, b)
    return (2.0 * d + a * a / b * math.log((b + d) / a) + b * b / a * math.log((a + d) / b)) / 6.0


def draw_truth(task: TouchTask, seed: int) -> BoxTruth:
    """What is so in the run of a seed."""
    generator = split(seed, "truth")
    pose = task.prior.sample(generator=generator)
    shares = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    ranges = (task.friction, task.floor_friction, task.mass_kg)
    friction, floor, mass = (low + share * (high - low) for share, (low, high) in zip(shares, ranges, strict=True))
    return BoxTruth(pose, friction, floor, mass)
