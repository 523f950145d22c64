"""Push parameters of an object: what a particle's numbers are, and how the object slides by them."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.outline import Support
from rumi.dynamics.sliding import Sliding

PARAMETERS = (
    "log friction",
    "log lever ratio",
    "quartic",
    "quartic by elongation",
    "anisotropy xx",
    "anisotropy xy",
    "centre x",
    "centre y",
)
"""Of a particle: friction at the tool; lever as a multiple of even pressure's; quartic limit surface, its mean and what
the support's elongation adds; log anisotropy; centre of friction off the centre of mass, in mean radii of the base."""

QUARTIC = (-1.5, 4.0)
"""Eigenvalues of a limit surface that is convex, least and greatest."""


def sliding_of(parameters: Float[Tensor, "N 8"], support: Support) -> Sliding:
    """How an object slides that rests as it does, by each particle."""
    friction, lever, mean, slope, *rest = parameters.unbind(-1)
    elongation = support.elongation.to(parameters)
    size = elongation.norm().clamp_min(1e-12)
    spread = slope * size
    high = (mean + spread.abs()).clamp(*QUARTIC)
    low = (mean - spread.abs()).clamp(*QUARTIC)
    deviator = (0.5 * (high - low) * spread.sign())[:, None] * (elongation / size)
    quartic = torch.cat((torch.stack(rest[:2], -1), 0.5 * (high + low)[:, None], deviator), -1)
    centre = support.centre.to(parameters) + support.spread * torch.stack(rest[2:], -1)
    return Sliding(centre, support.spread * lever.exp(), friction.exp(), quartic)
