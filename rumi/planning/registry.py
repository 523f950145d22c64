"""Registry of policies by name: RUMI, its ablations and the baselines."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, runtime_checkable

from torch import Tensor

from rumi.planning.gpvr import GPVRPolicy, GPVRSettings
from rumi.planning.next_touch import NextTouchPolicy
from rumi.planning.policy import Policy
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.planning.slide import SlidePolicy, SlideSettings
from rumi.registry import Table


@runtime_checkable
class PolicySettings(Protocol):
    """Settings of all policies; each is made from its own."""

    @property
    def planner(self) -> RummagingSettings:
        """Of those that sample control sequences."""
        ...

    @property
    def slide(self) -> SlideSettings:
        """Of `slide`."""
        ...

    @property
    def gpvr(self) -> GPVRSettings:
        """Of the implicit surface."""
        ...


def _chosen(own: RummagingSettings, reach: Tensor) -> Policy:
    """RUMI's policy, or the choice of the next touch in its place."""
    return NextTouchPolicy(own.touches) if own.next_touch else RummagingPolicy(reach, own)


MakePolicy = Callable[[PolicySettings, Tensor], Policy]
"""Makes a policy from settings and the reachability r(x) of every workspace point, (V,) in [0, 1] (RUMI, Eq 30)."""

POLICIES: Table[MakePolicy] = Table("method", "rumi.policies")
"""All policies by the name of their method."""


POLICIES.add("rumi", lambda own, reach: _chosen(own.planner, reach))
POLICIES.add("info-only", lambda own, reach: RummagingPolicy(None, replace(own.planner, reachability_scale=0.0)))
POLICIES.add("reach-only", lambda own, reach: RummagingPolicy(reach, replace(own.planner, information_scale=0.0)))
POLICIES.add("slide", lambda own, reach: SlidePolicy(own.slide))
POLICIES.add("gpvr", lambda own, reach: GPVRPolicy(own.planner, own.gpvr, greedy=False))
POLICIES.add("gpvr-greedy", lambda own, reach: GPVRPolicy(own.planner, own.gpvr, greedy=True))
