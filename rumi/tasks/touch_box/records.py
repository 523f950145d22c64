"""What a run of touch alone leaves behind: a record a step, and how it ended."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

from jaxtyping import Bool, Float
from torch import Tensor

from rumi.agent import StopReason
from rumi.registration.pose_summary import PoseSummary, summarise_particles
from rumi.runs.folder import Run
from rumi.tasks.grasp_table import Grasp
from rumi.tasks.touch_box.robot import Poke, Touched
from rumi.tasks.touch_box.selection import Choice
from sdf import se3
from sdf.symmetry import Symmetries


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
    timings_s: dict[str, float] = field(default_factory=dict)
    kind: ClassVar[str] = "touch-box"

    @property
    def reading(self) -> Touched | None:
        """What was felt."""
        return self.touched

    @property
    def control(self) -> Poke | None:
        """The poke, as it was carried out."""
        return None if self.touched is None else Poke(self.touched.path, lambda touched: True)

    @property
    def stamp(self) -> float:
        """Seconds of the pokes are not known to the agent."""
        return 0.0

    @property
    def poses(self) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N"]]:
        """The belief in space: world_T_object and log-weights."""
        return se3.from_planar(self.belief[0]), self.belief[1]

    def numbers(self) -> dict[str, Any]:
        """What was felt in this poke, what was thought of it, and the seconds."""
        own: dict[str, Any] = {"probability": round(self.grasp.probability, 4), "sure": self.sure}
        if self.touched is None:
            return {"contact": False, **own}
        choice, felt = self.choice, self.touched.contact
        value = None if choice is None else round(float(choice.value[choice.best]), 4)
        told = {"readings": signals(felt), "stopped": self.touched.stopped, "value": value}
        return {"contact": bool(felt.any()), **told, **own}


@dataclass(frozen=True, eq=False)
class TouchRun:
    """A whole run.

    Attributes:
        records: of all steps.
        stopped_by: why it ended.
        lifted: whether the grasp that was carried out lifted the box; None where none was.
        relies_on: what the run took for granted.
        warnings: what was not measured, and may have made the belief sure and wrong.
    """

    records: tuple[TouchStep, ...]
    stopped_by: StopReason
    lifted: bool | None
    relies_on: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def pose(self) -> PoseSummary:
        """What the belief knows of the box's pose; after half a turn it looks the same."""
        return summarise_particles(*self.end.poses, symmetries=Symmetries.parse("z2"))

    @property
    def why_not(self) -> str | None:
        """Why the belief is not sure; None where it is."""
        if self.stopped_by == "sure":
            return None
        return f"the best grasp lifts the box with {self.end.grasp.probability:.2f} only, by this belief"

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

    @classmethod
    def of(cls, run: Run) -> "TouchRun":
        """A recorded run, also one that goes on or was killed."""
        ended = run.ended or {"stopped_by": "interrupted", "lifted": None}
        told = ended.get("relies_on", ""), tuple(ended.get("warnings", ()))
        return cls(tuple(run.steps), ended["stopped_by"], ended["lifted"], *told)

    def as_dict(self) -> dict[str, Any]:
        """How the run ended and each of its pokes, as plain values."""
        grasp, start, truth = self.end.grasp, self.first.truth, self.end.truth
        apart = grasp.pose - truth
        turn = math.remainder(float(apart[2]), math.pi)
        return {
            "stopped_by": self.stopped_by,
            "lifted": self.lifted,
            "sure": self.end.sure,
            "actions": len(self.steps),
            "believed": round(grasp.probability, 4),
            "error_mm": round(1e3 * float(apart[:2].norm()), 1),
            "error_deg": round(math.degrees(abs(turn)), 1),
            "pose": self.pose.as_dict(),
            "why_not": self.why_not,
            "relies_on": self.relies_on,
            "warnings": list(self.warnings),
            "moved_mm": round(1e3 * float((truth - start)[:2].norm()), 1),
            "steps": [
                step.numbers() | {"seconds": {name: round(value, 4) for name, value in step.timings_s.items()}}
                for step in self.steps
            ],
        }

    @property
    def timings_s(self) -> dict[str, float]:
        """Seconds by stage, in all."""
        names = dict.fromkeys(name for record in self.records for name in record.timings_s)
        return {name: sum(record.timings_s.get(name, 0.0) for record in self.records) for name in names}


def signals(contact: Bool[Tensor, "K"]) -> str:
    """Readings as a word of 0 and 1."""
    return "".join("1" if one else "0" for one in contact.tolist())


PARTS = (TouchStep, Choice, Touched, Grasp)
"""Classes that records are made of."""
