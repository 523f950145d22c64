"""RUMI with one of its two costs off: what each is good for."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from rumi.planning.rummaging import RummagingPolicy, RummagingSettings


def info_only(settings: RummagingSettings | None = None) -> RummagingPolicy:
    """RUMI that gathers information and does not care where it pushes the object."""
    return RummagingPolicy(None, replace(settings or RummagingSettings(), reachability_scale=0.0))


def reach_only(reachability: Float[Tensor, "V"], settings: RummagingSettings | None = None) -> RummagingPolicy:
    """RUMI that keeps the information within reach and does not care to gather it.

    Args:
        reachability: r(x) of every workspace point in [0, 1] (Eq 30).
        settings: the rest.
    """
    return RummagingPolicy(reachability, replace(settings or RummagingSettings(), information_scale=0.0))
