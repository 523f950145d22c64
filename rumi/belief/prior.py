"""Prior distributions of an object's pose, in space and in the plane."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.seeding import normal, uniform
from sdf import se3
from sdf.so3 import wrap

REACH = 2.5
"""Standard deviations up to which places are taken to be possible."""

_AXES = "xyz"
_R3 = 1.2207440846057596


def kronecker_sequence(rank: Float[Tensor, "N"], *, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """Points of a unit cube by their numbers: evenly at any count (Kronecker's R3 sequence), shifted at random."""
    draw = uniform((3,), generator=generator, dtype=rank.dtype, device=rank.device)
    return torch.stack([(draw[k] + (rank + 1) / _R3 ** (k + 1)) % 1.0 for k in range(3)], -1)


def lying(bounds: Float[Tensor, "2 3"], up: str = "z") -> Float[Tensor, "4 4"]:
    """Pose of an object above the world's origin that lies on the floor with one of its axes pointing up.

    Args:
        bounds: (2, 3), metres, the object's box in its own frame.
        up: "x", "y" or "z"; the other two axes follow in cyclic order.
    """
    if up not in _AXES or len(up) != 1:
        raise UsageError(f"Expected the axis that points up to be x, y or z, got {up!r}")
    axis = _AXES.index(up)
    # the last row, the world's z, is the object's axis that points up
    rotation = torch.eye(3, dtype=bounds.dtype, device=bounds.device).roll(2 - axis, 0)
    height = -bounds[0, axis]
    return se3.make(rotation, torch.stack((torch.zeros_like(height), torch.zeros_like(height), height)))


@dataclass(frozen=True, eq=False)
class PosePrior:
    """The object lies in one of some ways, as likely as each other; its place is normally distributed, its yaw any.

    RUMI, V.B, whose box is assumed upright.

    Attributes:
        mean: (2,), x and y of the object's origin, metres.
        spread_m: standard deviation along x and along y.
        ways: (R, 4, 4), poses above the world's origin in which the object may lie.
        yaw: mean and standard deviation, radians, of an object that lies in one way; None for any yaw.
    """

    mean: Float[Tensor, "2"]
    spread_m: float
    ways: Float[Tensor, "R 4 4"]
    yaw: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        if self.yaw is not None and (len(self.ways) != 1 or not self.yaw[1] > 0):
            raise UsageError(
                "Expected a yaw with a standard deviation above 0 of an object that lies in one way, got "
                f"{self.yaw} and {len(self.ways)} ways"
            )

    @classmethod
    def of(
        cls,
        mean: Sequence[float],
        spread_m: float,
        bounds: Float[Tensor, "2 3"],
        up: Sequence[str] = ("z",),
        yaw: tuple[float, float] | None = None,
    ) -> Self:
        """The prior of an object with a box `bounds` that lies with one of the axes `up` pointing up."""
        if not spread_m > 0:
            raise UsageError(f"Expected spread_m to be positive, got {spread_m}")
        return cls(bounds.new_tensor(tuple(mean)), spread_m, torch.stack([lying(bounds, axis) for axis in up]), yaw)

    def spread_poses(self, count: int, *, generator: torch.Generator) -> Float[Tensor, "count 4 4"]:
        """Poses evenly over all ways, yaws and places within `REACH` standard deviations: weigh them.

        Args:
            count: how many.
            generator: shifts the spread.
        """
        index = torch.arange(count, dtype=self.mean.dtype, device=self.mean.device)
        share = kronecker_sequence(torch.div(index, len(self.ways), rounding_mode="floor"), generator=generator)
        angle, radius = 2 * math.pi * share[:, 1], REACH * self.spread_m * share[:, 2].sqrt()
        place = self.mean + radius[:, None] * torch.stack((angle.cos(), angle.sin()), -1)
        yaw = 2 * math.pi * share[:, :1] - math.pi
        if self.yaw is not None:
            yaw = self.yaw[0] + min(1.0, REACH * self.yaw[1] / math.pi) * yaw
        planar = torch.cat((place, yaw), -1)
        return se3.from_planar(planar) @ self.ways[index.long() % len(self.ways)]

    def negative_log_density(self, world_T_object: Float[Tensor, "*b N 4 4"]) -> Float[Tensor, "*b N"]:
        """Minus the log-density of poses that lie in one of the ways, up to a constant."""
        off = (world_T_object[..., :2, 3] - self.mean.to(world_T_object)) / self.spread_m
        cost = 0.5 * off.square().sum(-1)
        if self.yaw is None:
            return cost
        turned = world_T_object[..., :3, :3] @ self.ways[0, :3, :3].mT.to(world_T_object)
        return cost + self._of_yaw(torch.atan2(turned[..., 1, 0], turned[..., 0, 0]))

    def planar_log_density(self, poses: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Log-density of poses (x, y, yaw) that lie in the first of the ways, up to a constant."""
        off = (poses[..., :2] - self.mean.to(poses)) / self.spread_m
        cost = 0.5 * off.square().sum(-1)
        return -cost if self.yaw is None else -(cost + self._of_yaw(poses[..., 2]))

    def _of_yaw(self, yaw: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Minus the log-density of yaws, of which there is one that is likeliest."""
        assert self.yaw is not None
        return 0.5 * (wrap(yaw - self.yaw[0]) / self.yaw[1]).square()

    def to(self, *targets: torch.device | torch.dtype | str) -> Self:
        """Move to devices or floating dtypes."""
        mean, ways = self.mean, self.ways
        for target in targets:
            mean, ways = mean.to(target), ways.to(target)
        return type(self)(mean, self.spread_m, ways, self.yaw)


@dataclass(frozen=True, eq=False)
class PlanarPrior:
    """Modes of one width, each a Gaussian in x, y (metres) and yaw (radians, wrapped).

    Attributes:
        means: (G, 3).
        spread: (3,), standard deviations.
        shares: (G), of each mode; equal if None.
    """

    means: Float[Tensor, "G 3"]
    spread: Float[Tensor, "3"]
    shares: Float[Tensor, "G"] | None = None

    @property
    def log_shares(self) -> Float[Tensor, "G"]:
        """Log of each mode's share, which sum to 1."""
        shares = torch.ones_like(self.means[:, 0]) if self.shares is None else self.shares
        return (shares / shares.sum()).log()

    def sample(self, *shape: int, generator: torch.Generator) -> Float[Tensor, "... 3"]:
        """Independent draws."""
        count = math.prod(shape)
        like, shares = self.means, self.log_shares.exp().to(generator.device)
        mode = torch.multinomial(shares, max(1, count), True, generator=generator)[:count]
        noise = normal((count, 3), generator=generator, dtype=like.dtype, device=like.device)
        return (like[mode.to(like.device)] + noise * self.spread).reshape(*shape, 3)

    def log_density(self, poses: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Log of the density, yaw taken from each mode's by the shorter way."""
        apart = poses[..., None, :] - self.means
        turn = wrap(apart[..., 2])
        scaled = torch.cat((apart[..., :2], turn[..., None]), -1) / self.spread
        constant = 1.5 * math.log(2.0 * math.pi) + self.spread.log().sum()
        return torch.logsumexp(self.log_shares - 0.5 * scaled.square().sum(-1), -1) - constant
