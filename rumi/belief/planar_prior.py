"""A prior over planar poses: a mixture of Gaussians in x, y and yaw."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.so3 import wrap


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
        mode = torch.multinomial(self.log_shares.exp(), max(1, count), True, generator=generator)[:count]
        noise = torch.randn(count, 3, generator=generator, dtype=self.means.dtype)
        return (self.means[mode] + noise * self.spread).reshape(*shape, 3)

    def log_density(self, poses: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Log of the density, yaw taken from each mode's by the shorter way."""
        apart = poses[..., None, :] - self.means
        turn = wrap(apart[..., 2])
        scaled = torch.cat((apart[..., :2], turn[..., None]), -1) / self.spread
        constant = 1.5 * math.log(2.0 * math.pi) + self.spread.log().sum()
        return torch.logsumexp(self.log_shares - 0.5 * scaled.square().sum(-1), -1) - constant
