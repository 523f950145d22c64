"""What a run that ends without being sure was most likely lost by: its last word, though no alarm was due.

An alarm may come at any action, so that it takes much: little may be said too often. Silence where a touch was expected
speaks for an absent object, or for a hand that feels nothing, by several nats at first and by hardly any later, since
what is left of the belief lies where no touch reaches it: an alarm may never come. At the end there is nothing to wait
for, and the run has failed, as few do without a fault and all in which nothing can be felt: where a fault is likelier
than none by then, that is told.
"""

from dataclasses import replace

from rumi.belief.change_test import ChangeTest
from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_filter import PoseFilter
from rumi.belief.remarks import Remark
from rumi.records import StepRecord
from rumi.tasks.rummage.explanations import UNFELT, all_faults_of, chances_by_name, named
from rumi.tasks.rummage.fault_state import Watch

_LIKELIER = 0.5  # probability of a fault from which on it is told
_UNSURE = 0.2  # share of other runs that end without being sure, at most: 24 of 165 without a fault
_LEFT_OUT = "false contacts"  # which are left out, so that no run fails by them


def last_word(now: Watch, record: StepRecord, pose_filter: PoseFilter, own: MisfitSettings) -> tuple[Watch, StepRecord]:
    """What is known of faults at the end of a run that is not sure, and its last record with a remark of it.

    Args:
        now: what is known after the last reading.
        record: of the last step.
        pose_filter: that the belief is of.
        own: settings.
    """
    if own.alpha == 0 or now.lost or now.evidence is None:
        return now, record
    names, shares = all_faults_of(pose_filter)
    chances = chances_by_name(ChangeTest(shares, own.alpha), now.evidence, names)
    weighed = {name: chance * (1.0 if name in UNFELT else _UNSURE) for name, chance in chances.items()}
    chances = {name: chance / sum(weighed.values()) for name, chance in weighed.items()}
    name, chance = named(chances)
    if chance < _LIKELIER or name == _LEFT_OUT:
        return now, record
    said = f"the run ends without being sure, most likely for {name} (probability {chance:.2f})"
    remark = Remark(f"lost: {name}", record.step, said)
    record = replace(record, explanations=chances, remarks=(*record.remarks, remark))
    return replace(now, lost=True, named=name, explanations=chances), record
