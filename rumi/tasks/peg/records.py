"""What a run of the peg task leaves behind: a record a step, and how it ended."""

import statistics
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.agent import StopReason
from rumi.belief.static_filter import StaticBelief
from rumi.information.contact_gain import ContactKind
from rumi.information.state_rules import TargetEstimate
from rumi.planning.anytime import Candidate, Evaluated, Selection
from rumi.registration.pose_summary import PoseSummary, summarise_particles
from rumi.runs.folder import Run
from rumi.tasks.peg.cell import Felt, TimedPath
from rumi.tasks.peg.moves import Motion
from rumi.tasks.peg.selection import Thought
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.peg.simulated import Insertion
from sdf import se3
from sdf.symmetry import Symmetries


@dataclass(frozen=True, eq=False)
class PegStep:
    """The state after one motion; step 0 is before the first.

    Attributes:
        step: number of motions so far.
        thought: the decision that led here; None in the search, which needs none, and in a replay.
        felt: how the motion ended; at step 0 the ball at rest.
        belief: over (x, y) during the search, over (x, y, yaw) from the first touch on.
        aim: where the holes are thought to be; None while nothing was met.
        probability: of both holes within the tolerance of that, by the particles that it was chosen for.
        sure: whether the rule to stop holds.
        truth: (3,), pose of the block; for judging alone.
        timings_s: seconds by stage, on this machine's clock.
    """

    step: int
    thought: Thought | None
    felt: Felt
    belief: StaticBelief
    aim: TargetEstimate | None
    probability: float | None
    sure: bool
    truth: Float[Tensor, "3"]
    timings_s: dict[str, float] = field(default_factory=dict)
    kind: ClassVar[str] = "peg"

    @property
    def reading(self) -> Felt:
        """What was felt."""
        return self.felt

    @property
    def control(self) -> TimedPath | None:
        """The motion, as it was carried out."""
        return TimedPath(self.felt.path, self.felt.begun_s) if self.step else None

    @property
    def stamp(self) -> float:
        """Seconds on the run's clock."""
        return self.felt.ended_s

    @property
    def poses(self) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N"]] | None:
        """The belief in space, world_T_object and log-weights; None during the search, which knows no yaw."""
        if self.belief.states.shape[-1] != 3:
            return None
        return se3.from_planar(self.belief.states), self.belief.log_weights

    def numbers(self) -> dict[str, Any]:
        """What was felt in this motion, when, and how sure the belief is."""
        found = {"contact": self.felt.kind != ContactKind.NOTHING, "felt": ("nothing", "side", "top")[self.felt.kind]}
        times = {"begun_s": self.felt.begun_s, "ended_s": self.felt.ended_s}
        return {**found, **times, "probability": self.probability, "sure": self.sure}


@dataclass(frozen=True, eq=False)
class PegRun:
    """How a run went.

    Attributes:
        settings: of it.
        records: of all steps.
        thoughts: decisions of the second stage; the last one may have led to nothing.
        stopped_by: why it ended.
        inserted: where the peg was lowered; None where it was not.
        total_s: on the clock, the peg included.
    """

    settings: PegSettings
    records: tuple[PegStep, ...]
    thoughts: tuple[Thought, ...]
    stopped_by: StopReason
    inserted: Insertion | None
    total_s: float

    @classmethod
    def of(cls, run: Run, settings: PegSettings) -> "PegRun":
        """A recorded run, also one that goes on or was killed."""
        ended, records = run.ended or {}, tuple(run.steps)
        thoughts = tuple(record.thought for record in records if record.thought is not None)
        inserted = None
        if ended.get("inserted_m") is not None:
            at = torch.tensor(ended["inserted_m"], dtype=torch.float64)
            inserted = Insertion(at, ended["in_hole"], 1e-3 * ended["off_mm"], ended["total_s"])
        total_s = ended.get("total_s", records[-1].felt.ended_s)
        return cls(settings, records, thoughts, ended.get("stopped_by", "interrupted"), inserted, total_s)

    @property
    def pose(self) -> PoseSummary | None:
        """What the belief knows of the block's pose, the same after half a turn; None where nothing was met."""
        found = self.records[-1].poses
        return None if found is None else summarise_particles(*found, symmetries=Symmetries.parse("z2"))

    @property
    def why_not(self) -> str | None:
        """Why the belief is not sure; None where it is."""
        if self.stopped_by == "sure":
            return None
        if self.aim is None:
            return "the block was not met"
        return (
            f"both holes are known within {1e3 * self.settings.tolerance_m:g} mm with {self.aim.probability:.2f} only"
        )

    @property
    def truth(self) -> Float[Tensor, "3"]:
        """Pose of the block."""
        return self.records[0].truth

    @property
    def searched(self) -> list[Felt]:
        """Motions of the first stage; the last one met the block, if any did."""
        lanes = sum(record.aim is None for record in self.records)
        return [record.felt for record in self.records[1 : lanes + 1]]

    @property
    def search_s(self) -> float:
        """When the first stage ended; 0 where it never began."""
        return self.searched[-1].ended_s if self.searched else 0.0

    @property
    def felt(self) -> list[Felt]:
        """What each decision led to."""
        return [record.felt for record in self.records[len(self.searched) + 1 :]]

    @property
    def aim(self) -> TargetEstimate | None:
        """Where the holes were thought to be at the end."""
        return self.records[-1].aim

    @property
    def probabilities(self) -> list[float]:
        """Of both holes within the tolerance, after each reading since the first touch."""
        return [record.probability for record in self.records if record.probability is not None]

    @property
    def in_hole(self) -> bool:
        """Whether the peg was over a hole within the tolerance."""
        return self.inserted is not None and self.inserted.in_hole

    @property
    def off_m(self) -> float | None:
        """Distance from the nearer hole where the peg was lowered."""
        return None if self.inserted is None else self.inserted.off_m

    @property
    def hole_error_m(self) -> float | None:
        """Greatest distance of a hole from where it was thought to be."""
        if self.aim is None:
            return None
        holes = self.settings.block.holes(self.truth)
        return float(min((self.aim.points - order).norm(dim=-1).max() for order in (holes, holes.flip(0))))

    @property
    def middle_error_m(self) -> float | None:
        """Distance of the middle between the holes from where it was thought to be."""
        return None if self.aim is None else float((self.aim.points.mean(0) - self.truth[:2]).norm())

    @property
    def contact_times_s(self) -> list[float]:
        """When each side was touched."""
        return [felt.ended_s for felt in (*self.searched, *self.felt) if felt.kind == ContactKind.TOUCH]

    def as_dict(self) -> dict[str, Any]:
        """Plain values of how it ended."""
        thinking = sum(thought.ended_s - thought.begun_s for thought in self.thoughts)
        times = self.contact_times_s
        measured = [seconds for t in self.thoughts for _, seconds in t.selection.measured]
        late = [thought.selection.late_s for thought in self.thoughts if thought.selection.candidate is not None]
        return {
            "in_hole": self.in_hole,
            "right": self.hole_error_m is not None and self.hole_error_m < self.settings.tolerance_m,
            "pose": None if self.pose is None else self.pose.as_dict(),
            "why_not": self.why_not,
            "relies_on": RELIES_ON,
            "warnings": [],
            "off_mm": _mm(self.off_m),
            "hole_error_mm": _mm(self.hole_error_m),
            "middle_error_mm": _mm(self.middle_error_m),
            "stopped_by": self.stopped_by,
            "truth": self.truth.tolist(),
            "holes_m": None if self.aim is None else self.aim.points.tolist(),
            "inserted_m": None if self.inserted is None else self.inserted.at.tolist(),
            "probability": None if self.aim is None else self.aim.probability,
            "touches": len(times),
            "actions": len(self.felt),
            "misses": sum(felt.kind == ContactKind.NOTHING for felt in self.felt),
            "tops": sum(felt.kind not in (ContactKind.NOTHING, ContactKind.TOUCH) for felt in self.felt),
            "total_s": self.total_s,
            "search_s": self.search_s,
            "thinking_s": thinking,
            "contact_s": times,
            "evaluated": sum(thought.selection.evaluated for thought in self.thoughts),
            "doublings": sum(thought.selection.doublings for thought in self.thoughts),
            "direct": sum(t.selection.candidate.action.direct for t in self.thoughts if t.selection.candidate),
            "late_s": max(late, default=0.0),
            "evaluation_s": statistics.median_high(measured) if measured else None,
        }


RELIES_ON = "motion: none, the block is fixed; reach: none; push model: none; sensors: a force-torque sensor at a ball"
"""What a run takes for granted, in a line."""


def _mm(metres: float | None) -> float | None:
    return None if metres is None else 1e3 * metres


PARTS = (PegStep, Thought, Selection, Candidate, Motion, Evaluated, Felt, ContactKind, StaticBelief, TargetEstimate)
"""Classes that records are made of."""
