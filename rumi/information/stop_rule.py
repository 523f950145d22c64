"""When to stop: what the belief expects of itself, or the paper's APC."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from rumi.errors import UsageError
from rumi.registry import Table


class StopEvidence(NamedTuple):
    """What a rule may stop by; nothing of the truth.

    Attributes:
        expected_nll: that the belief expects of itself, nats.
        fit: least discrepancy of a particle.
        apc: average pairwise chamfer distance of the particles, metres (RUMI, Eq 33).
        diagonal: of the object's bounding box, metres.
        contacts: actions so far that touched the object.
    """

    expected_nll: float
    fit: float
    apc: float
    diagonal: float
    contacts: int


@dataclass(frozen=True)
class StopSettings:
    """The stopping rule; it never sees the truth.

    Attributes:
        rule: "self" stops where the expected nll is below `expected_nll` and some particle fits all
            observations (`fit`); "apc" is the paper's, APC below `apc_ratio` of the object's diagonal, which
            a mug of unknown yaw meets at once, since its handle is 6 % of its surface; "never" does not stop.
        expected_nll: nats over 500 points.
        fit: least discrepancy allowed, of the best particle.
        fit_a_contact: by which more is allowed for each action that touched the object: errors of its measured motion
            add up, so that what was felt before them no longer fits what is felt after them.
        contacts: actions that must have touched the object.
        apc_ratio: beta_t.
    """

    rule: str = "self"
    expected_nll: float = 5.0
    fit: float = 5.0
    fit_a_contact: float = 0.5
    contacts: int = 1
    apc_ratio: float = 0.03

    def __post_init__(self) -> None:
        """Refuse unknown rules."""
        if self.rule not in STOP_RULES:
            raise UsageError(f"There is no stop rule {self.rule!r}; there are {', '.join(STOP_RULES)}")


StopRule = Callable[[StopSettings, StopEvidence], bool]
"""Whether the belief is sure enough to stop."""

STOP_RULES: Table[StopRule] = Table("stop rule", "rumi.stop_rules")
"""All rules by name."""


def _self_consistent(settings: StopSettings, now: StopEvidence) -> bool:
    fits = now.fit < settings.fit + settings.fit_a_contact * now.contacts
    return now.expected_nll < settings.expected_nll and fits and now.contacts >= settings.contacts


STOP_RULES.add("self", _self_consistent)
STOP_RULES.add("apc", lambda settings, now: now.apc < settings.apc_ratio * now.diagonal)
STOP_RULES.add("never", lambda settings, now: False)


def converged(settings: StopSettings, now: StopEvidence) -> bool:
    """Whether the rule of some settings holds."""
    return STOP_RULES[settings.rule](settings, now)
