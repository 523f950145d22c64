"""Registry of policies: members by name, and their settings."""

from collections.abc import Callable
from dataclasses import dataclass, field

from torch import Tensor

from rumi.errors import UsageError
from rumi.planning.gpvr import GPVRPolicy, GPVRSettings
from rumi.planning.policy import Policy
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings, info_only, reach_only
from rumi.planning.slide import SlidePolicy, SlideSettings
from rumi.registry import Table


@dataclass(frozen=True)
class PolicySettings:
    """Choice of a policy, and the settings of each.

    Attributes:
        method: "rumi" weighs information against reachability; "info-only" and "reach-only" are the paper's
            ablations with one of the two costs. "slide" goes to the object and along its surface; "gpvr" and
            "gpvr-greedy" go where a Gaussian-process implicit surface is least sure (extra `baselines`). An installed
            package may add others.
        planner: how actions are chosen.
        slide: how the method slide moves.
        gpvr: the process of the methods gpvr and gpvr-greedy, which plan by `planner`.
    """

    method: str = "rumi"
    planner: RummagingSettings = field(default_factory=RummagingSettings)
    slide: SlideSettings = field(default_factory=SlideSettings)
    gpvr: GPVRSettings = field(default_factory=GPVRSettings)

    def __post_init__(self) -> None:
        """Refuse a policy that there is not."""
        if self.method not in POLICIES:
            raise UsageError(f"There is no method {self.method!r}; there are {', '.join(POLICIES)}")


PolicyMaker = Callable[[PolicySettings, Tensor], Policy]
"""Makes a policy from settings and the reachability r(x), (V,), of every workspace point (RUMI, Eq 30)."""

POLICIES: Table[PolicyMaker] = Table("method", "rumi.policies")
"""Policies by name; a package from outside adds one by an entry point of the group "rumi.policies".

A maker raises UsageError where it needs a package that is not installed.
"""

POLICIES.add("rumi", lambda settings, reach: RummagingPolicy(reach, settings.planner))
POLICIES.add("info-only", lambda settings, reach: info_only(settings.planner))
POLICIES.add("reach-only", lambda settings, reach: reach_only(reach, settings.planner))
POLICIES.add("slide", lambda settings, reach: SlidePolicy(settings.slide))
POLICIES.add("gpvr", lambda settings, reach: GPVRPolicy(settings.planner, settings.gpvr))
POLICIES.add("gpvr-greedy", lambda settings, reach: GPVRPolicy(settings.planner, settings.gpvr, greedy=True))
