"""When to stop: what the belief expects of itself, or the paper's APC."""

from dataclasses import dataclass
from typing import Literal


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

    rule: Literal["self", "apc", "never"] = "self"
    expected_nll: float = 5.0
    fit: float = 5.0
    fit_a_contact: float = 0.5
    contacts: int = 1
    apc_ratio: float = 0.03

    def __post_init__(self) -> None:
        """Refuse unknown rules."""
        if self.rule not in ("self", "apc", "never"):
            raise ValueError(f"Expected stop rule self, apc or never, got {self.rule!r}")


def converged(
    settings: StopSettings, *, expected_nll: float, fit: float, apc: float, diagonal: float, contacts: int
) -> bool:
    """Whether the rule holds.

    Args:
        settings: the rule.
        expected_nll: of the belief, nats.
        fit: least discrepancy of a particle.
        apc: metres.
        diagonal: of the object's bounding box, metres.
        contacts: actions so far that touched the object.
    """
    if settings.rule == "apc":
        return apc < settings.apc_ratio * diagonal
    if settings.rule == "self":
        fits = fit < settings.fit + settings.fit_a_contact * contacts
        return expected_nll < settings.expected_nll and fits and contacts >= settings.contacts
    return False
