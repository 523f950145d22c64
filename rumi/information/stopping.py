"""Stopping rules of a run: when a belief is sure enough, by what it expects of itself (RUMI) or its own P(right).

`rumi.information.state_rules` has those by the spread of states.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

from annotated_types import Ge

from rumi.errors import UsageError
from rumi.registry import Table
from sdf.bounds import Checked, Count, CountOr0, OneOf, Share, ShareAbove0


class StopEvidence(NamedTuple):
    """Evidence for a stopping rule; nothing of the truth.

    Attributes:
        expected_nll: that the belief expects of itself, nats.
        fit: least discrepancy of a particle.
        apc: average pairwise chamfer distance of the particles, metres (RUMI, Eq 33).
        diagonal: of the object's bounding box, metres.
        contacts: actions so far that touched the object.
        p_right: probability that the belief's best pose is within the task's tolerance, modulo symmetry, as its
            particles count it.
        chance: of readings as unlikely as these where the best particle is right, at most; 1 where nobody knows.
        draws: effective number of these particles.
        let_go: whether the belief was sure before the last action too, and the tool has let go of the object since.
    """

    expected_nll: float
    fit: float
    apc: float
    diagonal: float
    contacts: int
    p_right: float = math.nan
    chance: float = 1.0
    draws: float = math.inf
    let_go: bool = False

    @property
    def least_p_right(self) -> float:
        """Lower bound of `p_right`: less two standard errors of a count of so many draws.

        Whoever stops as soon as a noisy estimate is high enough stops by its noise.
        """
        return self.p_right - 2.0 * math.sqrt(max(0.0, self.p_right * (1.0 - self.p_right)) / self.draws)


StopRule = Callable[["StopSettings", StopEvidence], bool]
"""Whether the belief is sure enough to stop."""

STOP_RULES: Table[StopRule] = Table("stop rule", "rumi.stop_rules")
"""All rules by name."""


@dataclass(frozen=True)
class StopSettings(Checked, refusal=UsageError):
    """The stopping rule; it never sees the truth.

    Attributes:
        rule: "auto" is "probability" where objects are followed in space and nothing measures their motion, since
            points then ride with no one motion, else "self"; "self" stops where the expected nll is below
            `expected_nll` and some particle fits all observations (`fit`); "apc" is the paper's, APC below `apc_ratio`
            of the object's diagonal, which a mug of unknown yaw meets at once, since its handle is 6 % of its surface;
            "probability" stops where the best pose is right with a `probability`; "never" does not stop.
        expected_nll: nats over 500 points.
        fit: least discrepancy allowed, of the best particle.
        fit_a_contact: by which more is allowed for each action that touched the object: errors of its measured motion
            add up, so that what was felt before them no longer fits what is felt after them.
        contacts: actions that must have touched the object.
        apc_ratio: beta_t.
        probability: that the best pose is within the task's tolerance, as the belief has it: two standard errors of
            what its particles count have to be above it too.
        leeway: times the chance of being wrong by which "probability" may miss once the tool has let go of an object
            that the belief was sure of while they touched: what was right stays so then, what was wrong shows (tuning
            drills: of 71 with .9 and more all are right, of 3 with less one). 1 for none.
        further: touches that a belief has to stay sure through before a run ends as sure: where few tell all, what they
            were taken for wrongly shows at the next. None for 1 where the next touch is chosen and the tool does not
            let go of the object (`retreats`), else 0.
        most_nll: expected nll beyond which "probability" does not stop: poses that are all within the tolerance may lie
            too far apart for the object to count as found. None for what counts as found where the object is followed
            in space, else any.
        points_in_turn: of the points by which the belief compares itself with itself each particle takes one in so
            many, in turns, while the rule "probability" would not stop whatever came out: what is told then of a
            belief of 1200 particles is off by 1.4 % (deviation; drills, boxes), in a tenth of the time. 1 for all.
        least_chance: p-value of the readings at the best particle below which no pose explains them, and no rule but
            "apc" stops; 0 asks for none.
    """

    rule: Annotated[str, OneOf(STOP_RULES)] = "auto"
    expected_nll: float = 5.0
    fit: float = 5.0
    fit_a_contact: float = 0.5
    contacts: int = 1
    apc_ratio: float = 0.03
    probability: ShareAbove0 = 0.95
    leeway: Annotated[float, Ge(1.0)] = 2.0
    further: CountOr0 | None = None
    most_nll: Annotated[float, Ge(0.0)] | None = None
    points_in_turn: Count = 32
    least_chance: Share = 0.01

    def probable(self, now: StopEvidence) -> float:
        """P(right) that "probability" asks for."""
        return 1.0 - (1.0 - self.probability) * (self.leeway if now.let_go else 1.0)


class Shortfall(NamedTuple):
    """A part of a stopping rule that does not hold.

    Attributes:
        part: "fit" and "chance", no pose explains the observations, by its discrepancy and by the p-value of the
            readings; "contacts", too few actions touched the object; "spread", poses that explain them differ too
            much; "nll", all are right, and differ too much; "rule", a rule without parts.
        value: of the belief.
        allowed: bound of it.
    """

    part: Literal["fit", "chance", "contacts", "spread", "nll", "rule"]
    value: float
    allowed: float


def shortfalls(settings: StopSettings, now: StopEvidence) -> tuple[Shortfall, ...]:
    """The parts of the rule of some settings that do not hold; none where it does."""
    unexplained = now.chance < settings.least_chance
    if unexplained and settings.rule in ("auto", "self", "probability"):
        return (Shortfall("chance", now.chance, settings.least_chance),)
    if settings.rule in ("auto", "self"):
        allowed = settings.fit + settings.fit_a_contact * now.contacts
        parts = (
            (now.fit < allowed, Shortfall("fit", now.fit, allowed)),
            (now.contacts >= settings.contacts, Shortfall("contacts", now.contacts, settings.contacts)),
            (now.expected_nll < settings.expected_nll, Shortfall("spread", now.expected_nll, settings.expected_nll)),
        )
        return tuple(part for holds, part in parts if not holds)
    if converged(settings, now):
        return ()
    if settings.rule == "probability":
        if now.contacts < settings.contacts:
            return (Shortfall("contacts", now.contacts, settings.contacts),)
        if now.least_p_right >= settings.probable(now):
            return (Shortfall("nll", now.expected_nll, math.inf if settings.most_nll is None else settings.most_nll),)
        return (Shortfall("spread", now.least_p_right, settings.probable(now)),)
    if settings.rule == "apc":
        return (Shortfall("spread", now.apc, settings.apc_ratio * now.diagonal),)
    return (Shortfall("rule", math.nan, math.nan),)


def _self_consistent(settings: StopSettings, now: StopEvidence) -> bool:
    return not shortfalls(settings, now)


STOP_RULES.add("auto", _self_consistent)
STOP_RULES.add("self", _self_consistent)
STOP_RULES.add("apc", lambda settings, now: now.apc < settings.apc_ratio * now.diagonal)
STOP_RULES.add(
    "probability",
    lambda settings, now: (
        now.least_p_right >= settings.probable(now)
        and (settings.most_nll is None or now.expected_nll <= settings.most_nll)
        and now.contacts >= settings.contacts
        and now.chance >= settings.least_chance
    ),
)
STOP_RULES.add("never", lambda settings, now: False)


def converged(settings: StopSettings, now: StopEvidence) -> bool:
    """Whether the rule of some settings holds."""
    return STOP_RULES[settings.rule](settings, now)


def turns(settings: StopSettings, best: StopEvidence) -> int:
    """By one of how many points each particle is compared: exactly where the stop may depend on it.

    Args:
        settings: of the rule.
        best: the evidence, were the belief to agree with itself in everything.
    """
    exact = settings.rule != "probability" or converged(settings, best)
    return 1 if exact else settings.points_in_turn
