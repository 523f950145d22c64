"""What a run knows of faults so far, from one step to the next."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from rumi.belief.change_test import ChangeEvidence
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.rival_filters import RIVALS, Rival

DOUBT = 1.0
"""Nats against no fault so far, above which a run is not sure."""

_BESIDE_M = 0.002  # a last contact this far off says that something is wrong, though little of what


@dataclass(frozen=True)
class Watch:
    """What is known of faults so far.

    Attributes:
        evidence: since the belief was last begun; None before the first reading.
        begun: number of the action after which that was.
        lost: whether an alarm was raised that no search came after, or the run ended with a last word.
        unseated: name of the remark by which an object that no belief has but upright may lie otherwise; None where
            none says so.
        nats: evidence against "no fault so far", after the last reading.
        p_value: of the last reading under the belief, an upper bound.
        explanations: posterior of "no fault" and of each fault after the last reading that was asked about; after an
            alarm that of the alarm, until the next.
        named: the fault of the last alarm, or of the last word.
        following: filter that the run goes on by since an alarm; None for its own.
        adopted: the rival that was right, by the last alarm, and its copies; none where that was no rival's.
        rivals: beliefs under faults that hold from the first view on; None before they are asked, none once all were
            given up.
        static: log-likelihood ratio of all readings so far of each such fault.
        beside_m: how far what was felt last is from where any particle has it felt.
        set_aside: whether the last reading is left out: something was felt falsely in it, which by itself is no fault.
        waited: actions since an alarm was due whose fault is not clear yet.
        unfelt_since: the action since which, by the last alarm, nothing is felt of an object that is searched for about
            where it was before; None where none is.
    """

    evidence: ChangeEvidence | None = None
    begun: int = 0
    lost: bool = False
    unseated: str | None = None
    nats: float = 0.0
    p_value: float = 1.0
    explanations: Mapping[str, float] = field(default_factory=dict)
    named: str | None = None
    following: PoseTrajectoryFilter | None = None
    adopted: tuple[Rival, ...] = ()
    rivals: tuple[Rival, ...] | None = None
    static: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(RIVALS, 0.0))
    beside_m: float = 0.0
    waited: int = 0
    set_aside: bool = False
    unfelt_since: int | None = None

    def doubt(self) -> str | None:
        """What speaks for a fault, though not enough for an alarm: no time to be sure."""
        if self.unseated is not None:
            return (
                f"the object may lie otherwise than any pose believed ({self.unseated!r} was remarked), and nothing "
                "measures how: look again, measure its motion, or push it lower (--tool-height)"
            )
        if self.evidence is not None and self.nats > DOUBT:
            return "the last readings fit a fault better than the belief"
        if self.beside_m > _BESIDE_M:
            return f"what was felt last is {1e3 * self.beside_m:.0f} mm beside every pose that is believed"
        return None
