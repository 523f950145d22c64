"""What a run of touch alone leaves behind: a record a step, and how it ended."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from rumi.agent import StopReason
from rumi.tasks.grasp_table import Grasp
from rumi.tasks.touch_box.robot import Touched
from rumi.tasks.touch_box.selection import Choice


@dataclass(frozen=True, eq=False)
class TouchStep:
    """The state after one poke; step 0 is before the first.

    Attributes:
        step: number of pokes so far.
        candidates: (C, K + 1, 3), that were weighed; None where nothing was chosen here.
        choice: their worth, and the best; None where nothing was chosen here.
        touched: what was done and felt; None at step 0.
        belief: poses (N, 3) and log-weights (N) after it.
        grasp: the best one then.
        sure: whether it is likely enough to succeed.
        truth: (3,), of the box then; for judging alone.
        timings_s: seconds by stage.
    """

    step: int
    candidates: Float[Tensor, "C K1 3"] | None
    choice: Choice | None
    touched: Touched | None
    belief: tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]
    grasp: Grasp
    sure: bool
    truth: Float[Tensor, "3"]
    timings_s: dict[str, float]


@dataclass(frozen=True, eq=False)
class TouchRun:
    """A whole run.

    Attributes:
        records: of all steps.
        stopped_by: why it ended.
        lifted: whether the grasp that was carried out lifted the box; None where none was.
    """

    records: tuple[TouchStep, ...]
    stopped_by: StopReason
    lifted: bool | None

    @property
    def first(self) -> TouchStep:
        """Before the first poke."""
        return self.records[0]

    @property
    def steps(self) -> tuple[TouchStep, ...]:
        """Of the pokes."""
        return self.records[1:]

    @property
    def end(self) -> TouchStep:
        """Before the grasp."""
        return self.records[-1]

    @property
    def timings_s(self) -> dict[str, float]:
        """Seconds by stage, in all."""
        names = dict.fromkeys(name for record in self.records for name in record.timings_s)
        return {name: sum(record.timings_s.get(name, 0.0) for record in self.records) for name in names}


def signals(contact: Bool[Tensor, "K"]) -> str:
    """Readings as a word of 0 and 1."""
    return "".join("1" if one else "0" for one in contact.tolist())
